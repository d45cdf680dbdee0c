"""Answers of workers: checked, and decoded as far as that runs none of the user's code.

A task can write to its worker's channel, by mistake or under the control of an attacker.  So each
message is checked before it is used.  The form of the messages is in ``fiber._wire.work``.

The loop thread never runs the user's code, and unpickling may.  So a value that is not plain stays
pickled until its reader asks for it, on the thread of the reader."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from fiber._engine.tasks import WrongAnswer
from fiber._wire import work
from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import Message

MessageFields: TypeAlias = tuple[Any, ...]
"""Content of a worker's message.  Results are (seq, offset, kept, seconds, values, mixed, size).
``mixed``: some values are ``Pickled``.  ``size``: bytes of the message."""

OTHER = object()
"""Mark in place of a result: the message is another one."""

_FORMS: dict[str, Callable[..., bool]] = {
    work.READY: lambda: True,
    work.INIT_FAILED: lambda text, module: type(text) is type(module) is str,
    work.UNKNOWN: lambda seq: type(seq) is int,
    work.BROKEN: lambda seq, error: type(seq) is int and type(error) is bytes,
    work.UNREADABLE: lambda seq, error: type(seq) is int and type(error) is bytes,
}


class TaskFailure:
    """Outcome of a task that raised ``error``, or that could not run."""

    __slots__ = ("error",)

    def __init__(self, error: BaseException) -> None:
        self.error = error


class Pickled:
    """Outcome of a task, a value or an error, that is still pickled."""

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
        """Return the value, or a TaskFailure."""
        try:
            value = pickle.loads(self.data, buffers=self.buffers)
        except Exception as error:
            return TaskFailure(_unreadable(error))
        return TaskFailure(value) if self.failed else value


def is_failure(outcome: Any) -> bool:
    """Tell whether a task failed.  A value that does not unpickle does not count."""
    kind = type(outcome)
    return kind is TaskFailure or (kind is Pickled and outcome.failed)


def decode(outcome: Any) -> Any:
    """Return the value of an outcome, or a TaskFailure."""
    return outcome.decode() if type(outcome) is Pickled else outcome


def outcomes(
    values: list[Any], odd: list[tuple[int, int, bytes | None, int]], buffers: list[memoryview]
) -> list[Any]:
    """Put the pickled values of an answer in their places; ValueError if they do not fit."""
    used = 0
    for position, kind, data, count in odd:
        if not (0 <= position < len(values) and 0 <= count <= len(buffers) - used):
            raise ValueError("a pickled value has no place, or not its buffers")
        if not (type(data) is bytes or (data is None and count)):
            raise ValueError("a pickled value is not there")
        values[position] = Pickled(kind, *work.take_beside(data, buffers[used : used + count]))
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


def single(message: Message, seq: int) -> tuple[Any, float]:
    """Return the result of the call that was sent alone as ``seq``, or OTHER; and its seconds."""
    try:
        number, offset, kept, seconds, values, odd = pickle.loads(message.payload)
        if number == seq and offset == 0 and kept is None and len(values) == 1:
            if not 0.0 <= seconds < math.inf:
                return OTHER, 0.0
            return outcomes(values, odd, message.buffers)[0] if odd else values[0], seconds
    except Exception:  # any bytes may be there
        pass
    return OTHER, 0.0


def read(message: Message) -> MessageFields:
    """Read and check a message.  All but results keep the form of ``fiber._wire.work``.

    Raise WrongAnswer for a message that no worker sends.  It can be read again until its release.
    """
    try:
        fields = pickle.loads(message.payload)
        if type(fields[0]) is not int:
            if type(fields) is tuple and _FORMS[fields[0]](*fields[1:]):
                return fields
            raise ValueError("it has another form")
        seq, offset, kept, seconds, values, odd = fields
        if (
            type(offset) is not int
            or offset < 0
            or not (kept is None or type(kept) is int)
            or type(seconds) is not float
            or not 0.0 <= seconds < math.inf
            or type(values) is not list
        ):
            raise ValueError("a field has an impossible value")
        size = len(message.payload)
        if odd:
            size += sum([buffer.nbytes for buffer in message.buffers])
            outcomes(values, odd, message.buffers)
        return seq, offset, kept, seconds, values, bool(odd), size
    except Exception as error:  # any bytes may be there
        raise WrongAnswer(f"it sent a malformed message ({error!r})") from None
