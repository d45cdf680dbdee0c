"""Messages between the executor and a pool worker.

To a worker (behind the sequence number that its agent put in front)::

    MAP, STAR   head, pickled function (once for each worker), pickled items
    CALLS       head, (size:u64, buffers:u32) * count, a pickled (function, args, kwargs) each
    STOP        head

A large pickle is the first of its buffers instead, with BESIDE as its size.  The size of the items
is not sent, as they are the rest of the message.

From a worker, pickled tuples of plain values, so that reading one never runs the user's code::

    (seq, offset, kept, seconds, values, odd)   results of batch seq, its tasks from offset on
    (UNREADABLE, seq, error)                    its message does not unpickle
    (UNKNOWN, seq)                              the worker does not have its function
    (BROKEN, seq, error)                        its function does not unpickle
    (READY,)                                    the initializer returned
    (INIT_FAILED, text, module)                 it failed, since it lacks a module if one is named

``kept`` is the number of tasks of the batch that the worker keeps, one at least, or None for all.
The worker gives the other tasks back.
``values`` holds plain values.  In place of any other value it holds None, and ``odd`` holds
(position in values, VALUE | ERROR | AGAIN, pickle, number of buffers).  AGAIN is an error after
which the pool runs the task again.  A large pickle is the first of its buffers, and None here.
``error`` is such a pickle.

A change of this format raises ``packet_layout.PROTOCOL``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Any, NamedTuple

from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import INLINE_LIMIT

MAP, STAR, CALLS, STOP = range(4)
UNREADABLE, UNKNOWN, BROKEN, READY = "unreadable", "unknown", "broken", "ready"
INIT_FAILED = "init failed"
VALUE, ERROR, AGAIN = range(3)

SEQ = struct.Struct("<Q")
CALL = struct.Struct("<QI")

NUMBERS = frozenset({int, float, complex, bool, type(None)})
_TEXTS = frozenset({str, bytes})
PLAIN = NUMBERS | _TEXTS
"""Immutable types that pickle and unpickle without running the user's code."""

_ROWS = frozenset({tuple, list})


class Head(NamedTuple):
    """Fixed part of a message to a worker."""

    kind: int
    stride: int = 0
    """Tasks between two notes of the worker's progress.  0: the worker prepares each result as soon
    as it has it."""
    unit: int = 1
    """Number of tasks that stay together."""
    function: int = 0
    size: int = 0
    """Bytes of the pickled function, 0 if the worker has it; for CALLS the number of calls."""
    buffers: int = 0
    """Number of the message's buffers that belong to the function."""

    def pack(self) -> bytes:
        """Return the bytes of this head."""
        return HEAD_FORMAT.pack(*self)

    @classmethod
    def unpack_from(cls, message: BytesLike, offset: int = 0) -> Head:
        """Return the head that begins at ``offset`` of ``message``."""
        return cls._make(HEAD_FORMAT.unpack_from(message, offset))


HEAD_FORMAT = struct.Struct("<BHIQQI")
"""Format of the fields of ``Head``, in their order."""

BESIDE = (1 << 64) - 1
"""Value in place of the size of a pickle.  The pickle is then the first of its buffers."""

BODY = SEQ.size + HEAD_FORMAT.size
"""Offset of the part after the head."""

BUFFERS = 256
"""Limit of large buffers.  An object with more is pickled as a whole."""

STOP_MESSAGE = Head(STOP).pack()
_ONE_CALL = Head(CALLS, size=1).pack()


Pickle = tuple[bytes, Sequence[memoryview]]
"""Pickle, and the buffers beside it."""


def move_beside(pickle: Pickle) -> Pickle:
    """Move a large pickle to its buffers, so that it is not copied on its way."""
    data, buffers = pickle
    if len(data) <= INLINE_LIMIT:
        return pickle
    return b"", [memoryview(data), *buffers]


def take_beside(
    data: BytesLike | None, buffers: list[memoryview]
) -> tuple[BytesLike, list[memoryview]]:
    """Undo ``move_beside``: return a pickle and its other buffers."""
    return (buffers[0], buffers[1:]) if data is None else (data, buffers)


def pack_calls(calls: Sequence[Pickle]) -> bytes:
    """Return a message of pickled calls that went through ``move_beside``."""
    if len(calls) == 1:
        data, buffers = calls[0]
        return _ONE_CALL + _entry(data, buffers) + data
    table = b"".join([_entry(data, buffers) for data, buffers in calls])
    body = b"".join([data for data, _ in calls])
    return Head(CALLS, size=len(calls)).pack() + table + body


def _entry(data: bytes, buffers: Sequence[memoryview]) -> bytes:
    return CALL.pack(len(data) or BESIDE, len(buffers))


def unpack_calls(body: memoryview, count: int) -> Iterable[tuple[memoryview | None, int]]:
    """Yield the pickles in a message of calls, each with its number of buffers.

    None stands for a pickle that is the first of its buffers.
    """
    start = CALL.size * count
    for size, buffers in CALL.iter_unpack(body[:start]):
        if size == BESIDE:
            yield None, buffers
        else:
            yield body[start : start + size], buffers
            start += size


def pack_batch(head: Head, function: bytes, items: BytesLike) -> bytes:
    """Return a message of one function and the items to apply it to."""
    return b"".join((head.pack(), function, items))


def is_plain(items: Sequence[Any]) -> bool:
    """Tell whether pickling ``items`` is fast and runs none of the user's code.

    That holds for plain values that are not large, and for rows of them.
    """
    if type(items) is range:
        return True
    kinds = set(map(type, items))
    if kinds <= PLAIN:
        return kinds <= NUMBERS or not _has_large(items)
    if not kinds <= _ROWS:
        return False
    kinds = set(map(type, chain.from_iterable(items)))
    return kinds <= PLAIN and (kinds <= NUMBERS or not _has_large(chain.from_iterable(items)))


def is_plain_value(value: Any) -> bool:
    """Tell whether ``value`` is plain: it may be kept, pickled later, and unpickled anywhere."""
    kind = type(value)
    if kind is tuple:
        return PLAIN.issuperset(map(type, value)) and not _has_large(value)
    return kind in NUMBERS or (kind in _TEXTS and len(value) <= INLINE_LIMIT)


def _has_large(values: Iterable[Any]) -> bool:
    return any(len(value) > INLINE_LIMIT for value in values if type(value) in _TEXTS)
