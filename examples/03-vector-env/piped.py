"""Vector environment from Process and Pipe, as in the PPO of OpenAI Baselines and the paper.

Each environment has its own process and keeps its state there. The parent sends actions down the
pipes and collects the environments' answers, in the same order.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt
from environments import MakeEnv, makers, parse, rate

import fiber

Array = npt.NDArray[Any]


def serve(connection: Any, parents_end: Any, make_env: MakeEnv) -> None:
    """Run the child: one environment, driven by the messages of `connection`."""
    # This copy would hold the pipe open, and the parent's end would never be seen.
    parents_end.close()
    env = make_env()
    try:
        while True:
            command, argument = connection.recv()
            if command == "step":
                observation, reward, terminated, truncated, _ = env.step(argument)
                if over := terminated or truncated:
                    observation, _ = env.reset()
                connection.send((observation, reward, over))
            elif command == "reset":
                connection.send(env.reset(seed=argument)[0])
            elif command == "close":
                break
    except EOFError:
        pass  # the parent has ended
    finally:
        env.close()
        connection.close()


class VecEnv:
    """Vector that steps many environments at once, each in its own process.

    An environment that ends is reset at once: its next observation is the first of a new episode.
    """

    def __init__(self, make_functions: Sequence[MakeEnv]) -> None:
        pipes = [fiber.Pipe() for _ in make_functions]
        self._pipes = [parents_end for parents_end, _ in pipes]
        self._processes = []
        for (parents_end, childs_end), make_env in zip(pipes, make_functions, strict=True):
            process = fiber.Process(target=serve, args=(childs_end, parents_end, make_env))
            process.daemon = True  # ends with the parent, however that ends
            process.start()
            childs_end.close()
            self._processes.append(process)

    def reset(self, seed: int) -> Array:
        """Return first observations; environment i starts from `seed` + i."""
        for offset, pipe in enumerate(self._pipes):
            pipe.send(("reset", seed + offset))
        return np.stack([pipe.recv() for pipe in self._pipes])

    def step(self, actions: Sequence[Any] | Array) -> tuple[Array, Array, Array]:
        """Return observations, rewards and which episodes ended, after one action for each."""
        for pipe, action in zip(self._pipes, actions, strict=True):
            pipe.send(("step", action))
        observations, rewards, over = zip(*[pipe.recv() for pipe in self._pipes], strict=True)
        return np.stack(observations), np.array(rewards), np.array(over)

    def close(self) -> None:
        """End the processes and wait for them."""
        for pipe in self._pipes:
            try:
                pipe.send(("close", None))
            except OSError:
                pass  # this one has ended already
            pipe.close()
        for process in self._processes:
            process.join()

    def __enter__(self) -> VecEnv:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def main() -> None:
    """Play random actions in all of the environments, as PPO does to collect experience."""
    options = parse(str(__doc__))
    probe = makers(options, 0)[0]()
    probe.action_space.seed(0)
    returns = Returns(options.envs)
    with VecEnv(makers(options, options.ms)) as envs:
        envs.reset(seed=0)

        def step() -> None:
            actions = [probe.action_space.sample() for _ in range(options.envs)]
            _, rewards, over = envs.step(actions)
            returns.add(rewards, over)

        speed = rate(step, options)
    print(f"{options.envs} x {options.env}: {speed:,.0f} environment steps a second")
    print(f"{len(returns.finished)} episodes ended, mean return {returns.mean:.1f}")


class Returns:
    """Sums of the rewards of each environment's episodes."""

    def __init__(self, envs: int) -> None:
        self._running = np.zeros(envs)
        self.finished: list[float] = []

    def add(self, rewards: Array, over: Array) -> None:
        """Take in one step of all environments."""
        self._running += rewards
        self.finished += self._running[over].tolist()
        self._running[over] = 0

    @property
    def mean(self) -> float:
        """Return the mean return of the episodes that ended; nan if none did."""
        return sum(self.finished) / len(self.finished) if self.finished else float("nan")


if __name__ == "__main__":
    main()
