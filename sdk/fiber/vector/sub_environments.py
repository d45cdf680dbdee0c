"""Base of both vector environments, Gymnasium's and stable-baselines3's, and their spaces."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

from gymnasium import Space
from gymnasium.spaces.utils import is_space_dtype_shape_equiv
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_differing_spaces, batch_space

import fiber
from fiber import config, cpu
from fiber.vector.arrays import Shape, SharedMemory, StepArrays
from fiber.vector.dispatcher import Dispatcher
from fiber.vector.slot import MakeEnv
from fiber.vector.worker import Setup
from fiber.vector.worker_process import WorkerProcess, WorkerSet


class SubEnvironments:
    """Workers with their environments, the arrays of a step, and the spaces of both."""

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
            for index, rows in enumerate(_divided(count, min(wanted, count)))
        ]
        chosen = fiber.get_context(context)
        workers = [WorkerProcess(setup, chosen, owner) for setup in setups]
        self.dispatcher = Dispatcher(
            WorkerSet(workers),
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
            shape = Shape(
                self.spaces.single_observation_space,
                self.spaces.single_action_space,
                count,
                len(setups),
            )
            memory = SharedMemory.allocate(shape.size()) if shared_memory else None
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
        if columns.fits(actions, count):
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
        if os.getpid() == self._owner:  # else nothing of the workers is here to end
            self.dispatcher.close(timeout)

    def discard(self) -> None:
        """End the workers at once, from a finalizer."""
        with contextlib.suppress(RuntimeError):  # Fiber's own thread cannot wait for their ends
            self.close(0)

    def check_owner(self) -> None:
        """RuntimeError in another process than that which made them."""
        if os.getpid() != self._owner:
            raise RuntimeError(
                f"this vector environment belongs to process {self._owner}: a copy of it that came "
                "here by a fork has no workers; make one in this process"
            )


def _divided(count: int, parts: int) -> Iterator[slice]:
    """So many pieces, as equal as can be, of so many environments."""
    for part in range(parts):
        yield slice(count * part // parts, count * (part + 1) // parts)


_NOT_EQUIVALENT = (
    "the sub-environments observation spaces are not equivalent. {}. If this is intentional, use "
    "`observation_mode='different'` instead."
)
_NOT_ALIKE = (
    "the sub-environments observation spaces do not share a common shape and dtype, which one "
    "batch of them needs. {}."
)

ObservationMode: TypeAlias = str | tuple[Space[Any], Space[Any]]
"""``same``, ``different``, or the space of a batch and that of one environment."""


class Spaces(NamedTuple):
    """Spaces by their names in ``gymnasium.vector.VectorEnv``."""

    single_observation_space: Space[Any]
    observation_space: Space[Any]
    single_action_space: Space[Any]
    action_space: Space[Any]

    @classmethod
    def of(
        cls,
        pairs: Sequence[tuple[Space[Any], Space[Any]]],
        mode: ObservationMode,
        name: Callable[[int], str],
    ) -> Spaces:
        """Batch the observation and action space of each environment.

        RuntimeError if they differ in what they must have in common; ``name`` says how an
        environment is called in it.
        """
        observations, actions = zip(*pairs, strict=True)
        single = mode[1] if isinstance(mode, tuple) else observations[0]
        equivalent = _equal if mode == "same" else _alike
        for number, (observation, action) in enumerate(pairs):
            # Those of one worker are often one object, as pickling keeps them.
            if observation is not single and not equivalent(observation, single):
                differs = f"{name(number)}, has {observation}, not {single}"
                message = _NOT_EQUIVALENT if mode == "same" else _NOT_ALIKE
                raise RuntimeError(message.format(differs))
            if action is not actions[0] and action != actions[0]:
                raise RuntimeError(
                    "the sub-environments action spaces are not equivalent, and one batch of "
                    f"actions is for all. {name(number)}, has {action}, not {actions[0]}"
                )
        batch = _batch_space(observations, mode)
        return cls(single, batch, actions[0], batch_space(actions[0], len(actions)))


def check_mode(mode: ObservationMode) -> None:
    """TypeError or ValueError if there is no such mode."""
    if isinstance(mode, tuple):
        kinds = [type(part) for part in mode]
        if not all(issubclass(kind, Space) for kind in kinds):
            raise TypeError(f"Expected both elements of observation_mode to be Spaces, got {kinds}")
    elif mode not in ("same", "different"):
        raise ValueError(
            "Invalid `observation_mode`, expected: 'same' or 'different' or tuple of single and "
            f"batch observation space, actual got {mode}"
        )


def _batch_space(observations: Sequence[Space[Any]], mode: ObservationMode) -> Space[Any]:
    if isinstance(mode, tuple):
        return mode[0]
    first = observations[0]
    # Equal ones can be batched, of whatever kind they are; "same" was compared already.
    if mode == "same" or all(each is first or each == first for each in observations):
        return batch_space(first, len(observations))
    return batch_differing_spaces(list(observations))


def _equal(one: Space[Any], other: Space[Any]) -> bool:
    return one == other


def _alike(one: Space[Any], other: Space[Any]) -> bool:
    # Gymnasium compares the shapes of its own kinds of space alone.
    return one == other or is_space_dtype_shape_equiv(one, other)
