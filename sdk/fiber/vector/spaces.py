"""The spaces of a vector environment from those of its environments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

from gymnasium import Space
from gymnasium.spaces.utils import is_space_dtype_shape_equiv
from gymnasium.vector.utils import batch_differing_spaces, batch_space

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
