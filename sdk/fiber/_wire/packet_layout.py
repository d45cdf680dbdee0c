"""Layout of a packet in a frame between master and agent, and the repr of such frames.

Little endian: count:u32, payload length:u64, buffer length:u64 * count, the payload, and each
buffer at the next multiple of ALIGNMENT.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import ALIGNMENT, INLINE_LIMIT

PROTOCOL = 6
"""Version of the frames between master and agent, and of all that they carry: the messages of
``work.py`` and ``hub.protocol``, and pickles of Fiber's classes.  Raise it when one of these
changes."""

_PACKET = struct.Struct("<IQ")
_PADDING = bytes(ALIGNMENT)


def pieces_of(head: bytes, payload: BytesLike, buffers: Sequence[BytesLike]) -> Sequence[BytesLike]:
    """Return a frame with this head and packet, in pieces.  Large parts are not copied."""
    views = [memoryview(buffer).cast("B") for buffer in buffers]
    sizes = [view.nbytes for view in views]
    length = memoryview(payload).nbytes
    head += _PACKET.pack(len(sizes), length) + struct.pack(f"<{len(sizes)}Q", *sizes)
    # A small payload may be in borrowed memory, so it is copied.
    parts: list[BytesLike]
    parts = [head, payload] if length > INLINE_LIMIT else [b"".join((head, payload))]
    end = len(head) + length
    for view in views:
        start = _aligned(end)
        parts += [_PADDING[: start - end], view]
        end = start + view.nbytes
    return parts


def read_packet(view: memoryview, at: int) -> tuple[memoryview, list[memoryview]]:
    """Return the payload and the buffers of the packet at ``at``: views, not copies."""
    count, length = _PACKET.unpack_from(view, at)
    at += _PACKET.size
    if count > len(view) // 8:
        raise ValueError(f"it announces {count} buffers")
    sizes = struct.unpack_from(f"<{count}Q", view, at)
    at += 8 * count
    end = at + length
    payload, buffers = view[at:end], []
    for size in sizes:
        start = _aligned(end)
        end = start + size
        buffers.append(view[start:end])
    if end != len(view):
        raise ValueError(f"it announces a packet that ends after {end} bytes")
    return payload, buffers


def _aligned(offset: int) -> int:
    return -(-offset // ALIGNMENT) * ALIGNMENT


def redacted(message: tuple[Any, ...]) -> str:
    """Return the repr of a message with the user's data: sizes instead of values."""
    values = zip(message._fields, message, strict=True)  # type: ignore[attr-defined]  # a NamedTuple
    inner = ", ".join(f"{name}={_shown(value)}" for name, value in values)
    return f"{type(message).__name__}({inner})"


def _shown(value: Any) -> str:
    if isinstance(value, bytes | bytearray | memoryview):
        return f"<{memoryview(value).nbytes} bytes>"
    if isinstance(value, str):
        return f"<{len(value)} characters>"
    if isinstance(value, list | tuple) and not all(isinstance(item, int) for item in value):
        return f"<{len(value)} items>"
    return repr(value)
