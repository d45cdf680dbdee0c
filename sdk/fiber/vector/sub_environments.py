"""Base of both vector environments, Gymnasium's and stable-baselines3's."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from gymnasium.vector import AutoresetMode

import fiber
from fiber import config, cpu
from fiber.vector.arrays import (
    ArrayLayout,
    ArrayMemory,
    ObservationMode,
    Spaces,
    StepArrays,
    check_mode,
)
from fiber.vector.dispatcher import Dispatcher
from fiber.vector.slot import MakeEnv
from fiber.vector.worker import Setup
from fiber.vector.worker_process import WorkerGroup, WorkerProcess


class SubEnvironments:
    """Workers with their environments, their spaces, and the arrays of a step."""

    def __init__(
        self,
        env_fns: Sequence[MakeEnv],
        *,
        owner: str,
        num_workers: int | None,
        shared_memory: bool,
        context: str | None,
        observation_mode: ObservationMode,
        autoreset: AutoresetMode,
        on_error: str,
        timeout: float | None,
    ) -> None:
        self._owner = os.getpid()
        if not env_fns:
            raise ValueError("a vector environment has at least one environment: env_fns is empty")
        if on_error not in ("raise", "restart"):
            raise ValueError(f"on_error is 'raise' or 'restart', not {on_error!r}")
        if timeout is not None and timeout <= 0:
            raise ValueError(f"timeout is a number of seconds above 0, not {timeout!r}")
        if num_workers is not None and num_workers < 1:
            raise ValueError(f"num_workers is at least 1, not {num_workers}")
        check_mode(observation_mode)
        count = len(env_fns)
        wanted = cpu.cpu_count() if num_workers is None else num_workers
        setups = [
            Setup(index, rows.start, env_fns[rows], autoreset, on_error == "restart", timeout)
            for index, rows in enumerate(_slices(count, min(wanted, count)))
        ]
        chosen = fiber.get_context(context)
        workers = [WorkerProcess(setup, chosen, owner) for setup in setups]
        self.dispatcher = Dispatcher(
            WorkerGroup(workers),
            restart=on_error == "restart",
            disruptions=config.current().disruptions,
        )
        try:
            self.dispatcher.start()
            hellos = [worker.hello for worker in workers if worker.hello is not None]
            self.metadata = hellos[0].metadata
            self.render_mode = hellos[0].render_mode
            self.spaces = Spaces.of(
                [pair for hello in hellos for pair in hello.spaces],
                observation_mode,
                self.dispatcher.name,
            )
            shape = ArrayLayout(
                self.spaces.single_observation_space,
                self.spaces.single_action_space,
                count,
                len(setups),
            )
            memory = ArrayMemory.allocate(shape.size()) if shared_memory else None
            self.arrays = (
                StepArrays.of_memory(shape, memory.view) if memory else StepArrays.private(shape)
            )
            self.dispatcher.begin(shape, self.arrays, memory)
        except BaseException:
            self.close(0)
            raise

    def step(
        self,
        numbers: Sequence[int] | None,
        actions: Any,
        split: Callable[[Any], list[Any]],
        *,
        together: bool,
    ) -> None:
        """Begin to step some environments, or all, with a batch of actions for them.

        ``split`` makes a list of the batch.  ``together``: the caller waits for all of them.
        """
        count = len(self.arrays.rewards) if numbers is None else len(numbers)
        columns = self.arrays.actions
        if columns.fits(actions, count) and not self.dispatcher.reads_old_actions():
            columns.fill(slice(None) if numbers is None else numbers, actions)
            self.dispatcher.step(numbers, None, together=together)
            return
        chosen = split(actions)
        if len(chosen) != count:
            raise ValueError(
                f"actions for {count} environments are needed, one for each, not {len(chosen)}"
            )
        self.dispatcher.step(numbers, chosen, together=together)

    def close(self, timeout: float | None) -> None:
        """End the workers; kill those that have not ended when ``timeout`` is over."""
        if os.getpid() == self._owner:  # a forked copy has no workers
            self.dispatcher.close(timeout)

    def discard(self) -> None:
        """End the workers at once, from a finalizer."""
        with contextlib.suppress(RuntimeError):  # Fiber's own thread cannot wait for their ends
            self.close(0)

    def check_owner(self) -> None:
        """Raise RuntimeError in another process than the one that made this object."""
        if os.getpid() != self._owner:
            raise RuntimeError(
                f"this vector environment belongs to process {self._owner}: its copy in a forked "
                "process has no workers. Make one in this process"
            )


def _slices(count: int, parts: int) -> Iterator[slice]:
    """Yield ``parts`` slices of ``count`` environments, as equal as possible."""
    for part in range(parts):
        yield slice(count * part // parts, count * (part + 1) // parts)
