"""The spaces of a vector environment from those of its environments, and actions for each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from gymnasium import Space
from gymnasium.spaces.utils import is_space_dtype_shape_equiv
from gymnasium.vector.utils import batch_differing_spaces, batch_space, iterate


class Spaces(NamedTuple):
    """As ``gymnasium.vector.VectorEnv`` calls them."""

    single_observation_space: Space[Any]
    observation_space: Space[Any]
    single_action_space: Space[Any]
    action_space: Space[Any]


def spaces_of(
    pairs: Sequence[tuple[Space[Any], Space[Any]]],
    mode: str | tuple[Space[Any], Space[Any]],
    name: Callable[[int], str],
) -> Spaces:
    """Batch the observation and action spaces of environments, as Gymnasium's ``observation_mode``
    says; ``name`` says how to call one of them in an error.

    RuntimeError if they differ in what they must have in common.
    """
    first, action_space = pairs[0]
    if mode == "same":
        single, batched = first, batch_space(first, len(pairs))
    elif mode == "different":
        single = first
        _check(pairs, 0, first, is_space_dtype_shape_equiv, _DIFFERENT, name)
        batched = batch_differing_spaces([observation for observation, _ in pairs])
    elif isinstance(mode, tuple) and len(mode) == 2:
        batched, single = mode
        if not (isinstance(batched, Space) and isinstance(single, Space)):
            raise TypeError(
                "observation_mode is a pair of Spaces, that of the batch first, not of "
                f"{type(batched).__name__} and {type(single).__name__}"
            )
    else:
        raise ValueError(
            f"observation_mode is 'same', 'different' or a pair of Spaces, not {mode!r}"
        )
    if mode == "same":
        _check(pairs, 0, single, _equal, _SAME, name)
    else:
        _check(pairs, 0, single, is_space_dtype_shape_equiv, _DIFFERENT, name)
    _check(pairs, 1, action_space, _equal, _ACTIONS, name)
    return Spaces(single, batched, action_space, batch_space(action_space, len(pairs)))


def each(space: Space[Any], actions: Any, count: int) -> list[Any]:
    """One action for each of ``count`` environments; ``space`` is that of a batch."""
    chosen = list(iterate(space, actions))
    if len(chosen) != count:
        raise ValueError(
            f"actions for {count} environments are needed, one for each, not {len(chosen)}"
        )
    return chosen


def _equal(one: Space[Any], other: Space[Any]) -> bool:
    return one == other


def _check(
    pairs: Sequence[tuple[Space[Any], Space[Any]]],
    which: int,
    expected: Space[Any],
    agree: Callable[[Space[Any], Space[Any]], bool],
    message: str,
    name: Callable[[int], str],
) -> None:
    for number, pair in enumerate(pairs):
        # Those of one worker are often one object, as pickling keeps them.
        if pair[which] is not expected and not agree(expected, pair[which]):
            raise RuntimeError(f"{name(number)}, has {pair[which]}, not {expected}. {message}")


_SAME = (
    "The observation spaces of all environments must be equal: if they are meant to differ, pass "
    "observation_mode='different'"
)
_DIFFERENT = "The observation spaces of all environments must have one shape and dtype"
_ACTIONS = "The action spaces of all environments must be equal, so that actions can be batched"
