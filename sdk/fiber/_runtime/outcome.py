"""Outcome of a task, as the executor hands it on.

The loop's thread never runs the user's code, and unpickling may: so what is not plain stays pickled
until whoever wants it asks, in a thread of theirs.
"""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from typing import Any

from fiber._wire import work
from fiber._wire.packet import BytesLike


class Failure:
    """The task raised, or could not run."""

    __slots__ = ("error",)

    def __init__(self, error: BaseException) -> None:
        self.error = error


class Pickled:
    """A value or an error, still pickled."""

    __slots__ = ("buffers", "data", "kind")

    def __init__(self, kind: int, data: BytesLike, buffers: Sequence[memoryview]) -> None:
        self.kind = kind
        self.data = data
        self.buffers = buffers

    @property
    def failed(self) -> bool:
        """True if the outcome is an error."""
        return self.kind != work.VALUE

    def decode(self) -> Any:
        """Return the value, or the Failure."""
        try:
            value = pickle.loads(self.data, buffers=self.buffers)
        except Exception as error:
            return Failure(_unreadable(error))
        return Failure(value) if self.failed else value


def is_failure(outcome: Any) -> bool:
    """Tell whether a task failed.  A value that does not unpickle does not count."""
    kind = type(outcome)
    return kind is Failure or (kind is Pickled and outcome.failed)


def decode(outcome: Any) -> Any:
    """A plain value as it is; what is pickled as its value or a Failure."""
    return outcome.decode() if type(outcome) is Pickled else outcome


def outcomes(
    values: list[Any], odd: list[tuple[int, int, bytes | None, int]], buffers: list[memoryview]
) -> list[Any]:
    """A worker's answer with what is pickled in its place; ValueError if it does not fit."""
    used = 0
    for position, kind, data, count in odd:
        if not (0 <= position < len(values) and 0 <= count <= len(buffers) - used):
            raise ValueError("a pickled value has no place, or not its buffers")
        if not (type(data) is bytes or (data is None and count)):
            raise ValueError("a pickled value is not there")
        values[position] = Pickled(kind, *work.found(data, buffers[used : used + count]))
        used += count
    return values


def _unreadable(reason: Exception) -> Exception:
    from multiprocessing.pool import MaybeEncodingError  # type: ignore[attr-defined]

    error: Exception = MaybeEncodingError(reason, _UNREADABLE)
    error.__cause__ = reason
    return error


class _Unreadable:
    def __repr__(self) -> str:
        return "a result that was sent but does not unpickle here"


_UNREADABLE = _Unreadable()
