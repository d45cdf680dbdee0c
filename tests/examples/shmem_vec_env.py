"""A vector environment in the manner of OpenAI Baselines' ShmemVecEnv: each environment writes what
it sees into an array of its own and answers through its pipe; nothing else is sent.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

import fiber as mp

ENVS, STEPS, SHAPE = 3, 30, (4, 84)


def observe(index: int, step: int) -> npt.NDArray[np.float32]:
    """Return the observation of environment ``index`` after ``step`` steps."""
    return np.random.default_rng([index, step]).random(SHAPE, dtype=np.float32)


def work(index: int, pipe: Any, buffer: Any) -> None:
    """Step one environment until the command to end."""
    view = np.frombuffer(buffer.get_obj(), dtype=np.float32).reshape(SHAPE)
    step = 0
    while True:
        command, action = pipe.recv()
        if command == "close":
            break
        step = 0 if command == "reset" else step + action
        view[:] = observe(index, step)
        pipe.send(None)


class ShmemVecEnv:
    """The environments, each in a process."""

    def __init__(self) -> None:
        context = mp.get_context("spawn")
        self._buffers = [context.Array("f", int(np.prod(SHAPE))) for _ in range(ENVS)]
        self._pipes = []
        self._processes = []
        for index, buffer in enumerate(self._buffers):
            ours, theirs = context.Pipe()
            process = context.Process(target=work, args=(index, theirs, buffer), daemon=True)
            process.start()
            theirs.close()
            self._pipes.append(ours)
            self._processes.append(process)

    def ask(self, command: str, action: int = 0) -> npt.NDArray[np.float32]:
        """Step all environments and return their observations."""
        for pipe in self._pipes:
            pipe.send((command, action))
        for pipe in self._pipes:
            pipe.recv()
        arrays: list[Any] = [
            buffer.get_obj() for buffer in self._buffers
        ]  # buffers, by the protocol
        views = [np.frombuffer(array, dtype=np.float32) for array in arrays]
        return np.stack([view.reshape(SHAPE) for view in views])

    def close(self) -> None:
        """End them."""
        for pipe in self._pipes:
            pipe.send(("close", 0))
        for process in self._processes:
            process.join()


def main() -> None:
    """Compare each observation with the expected one."""
    envs = ShmemVecEnv()
    seen = [envs.ask("reset")] + [envs.ask("step", 1) for _ in range(STEPS)]
    envs.close()
    expected = [np.stack([observe(i, step) for i in range(ENVS)]) for step in range(STEPS + 1)]
    same = all(map(np.array_equal, seen, expected))
    print("observations:", "the same" if same else "something else")


if __name__ == "__main__":
    main()
