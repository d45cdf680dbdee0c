"""Frames by which many streams share one connection, between a relay and a master.

::

    kind (1 byte) | stream (4 bytes) | length (4 bytes) | payload

A stream is a TCP connection of an agent that the relay forwards.  The relay opens it and chooses
its number.  Stream 0 is the connection itself.

=======  ======  ===========================================================
kind     stream  payload
=======  ======  ===========================================================
HELLO    0       JSON: the master's first frame, and the relay's answer
OPEN     any     address of the agent, ``host:port``
DATA     any     bytes of the stream, at most ``MOST_DATA``
CREDIT   any     4 bytes: how many more bytes of this stream may be sent
END      any     none: the sender sends no more bytes, and still receives
ABORT    any     none: the stream is broken; after END, it is closed
PING     0       none
PONG     0       none
=======  ======  ===========================================================

Each stream begins with a credit of ``FIRST_CREDIT`` bytes in both directions.  DATA uses it up, and
CREDIT adds to it, as in HTTP/2 (RFC 9113, section 5.2).  So a stream whose reader is slow holds up
no other stream, and the receiver's memory is bounded.
"""

from __future__ import annotations

import enum
import json
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

from fiber._wire.messages import ProtocolError

VERSION = 1
"""Version of this protocol, in both HELLO frames."""

FIRST_CREDIT = 64 << 10
MOST_DATA = 64 << 10

_HEAD = struct.Struct(">BII")
_COUNT = struct.Struct(">I")
_MOST_CREDIT = 1 << 30
_MOST_ORIGIN = 100


class Kind(enum.IntEnum):
    """Kind of a frame."""

    HELLO = 1
    OPEN = 2
    DATA = 3
    CREDIT = 4
    END = 5
    ABORT = 6
    PING = 7
    PONG = 8


class StreamFrame(NamedTuple):
    """Frame on the connection."""

    kind: Kind
    stream: int = 0
    payload: bytes = b""

    def encode(self) -> bytes:
        """Return the frame's bytes."""
        return _HEAD.pack(self.kind, self.stream, len(self.payload)) + self.payload

    @property
    def credit(self) -> int:
        """Number of bytes that a CREDIT frame grants."""
        if len(self.payload) != _COUNT.size:
            raise ProtocolError("a CREDIT frame has no number")
        (count,) = _COUNT.unpack(self.payload)
        if count > _MOST_CREDIT:
            raise ProtocolError(f"a CREDIT frame grants {count} bytes")
        return int(count)

    @property
    def origin(self) -> str:
        """Address in an OPEN frame.  It is fit to be printed."""
        found = self.payload.decode(errors="replace")
        if not found.isascii() or not found.isprintable() or len(found) > _MOST_ORIGIN:
            raise ProtocolError("an OPEN frame has no address")
        return found

    @property
    def hello(self) -> dict[str, Any]:
        """Content of a HELLO frame."""
        try:
            found = json.loads(self.payload)
        except (ValueError, RecursionError) as error:
            raise ProtocolError("a HELLO frame is no JSON") from error
        if not isinstance(found, dict) or found.get("version") != VERSION:
            raise ProtocolError(
                f"the other side speaks another version of the relay's protocol than {VERSION}. "
                "Give the program and the pool's image the same version of Fiber"
            )
        return found


def credit(stream: int, count: int) -> StreamFrame:
    """Return a frame that grants ``count`` more bytes."""
    return StreamFrame(Kind.CREDIT, stream, _COUNT.pack(count))


def hello(**content: Any) -> StreamFrame:
    """Return a HELLO frame with this content and the version."""
    return StreamFrame(Kind.HELLO, 0, json.dumps({"version": VERSION, **content}).encode())


class FrameDecoder:
    """Decoder of frames from pieces of any size."""

    def __init__(self) -> None:
        self._rest = bytearray()

    def feed(self, piece: bytes) -> Iterator[StreamFrame]:
        """Yield the frames that are complete with ``piece``; ProtocolError if one cannot be."""
        rest = self._rest
        rest += piece
        start = 0
        try:
            while len(rest) - start >= _HEAD.size:
                number, stream, length = _HEAD.unpack_from(rest, start)
                if length > MOST_DATA:
                    raise ProtocolError(f"a frame has {length} bytes")
                end = start + _HEAD.size + length
                if len(rest) < end:
                    return
                payload = bytes(memoryview(rest)[start + _HEAD.size : end])
                start = end
                yield StreamFrame(_kind(number), stream, payload)
        finally:
            del rest[:start]


def _kind(number: int) -> Kind:
    try:
        return Kind(number)
    except ValueError:
        raise ProtocolError(f"a frame has the unknown kind {number}") from None
