"""Streams between the hubs of two hosts, over the links between agents and master.

::

    process ── unix stream ── its hub ══ link ══ master ══ link ══ another hub
                                │ splice              │ splice         │ handler

Many tunnels share a link with everything else that travels there.  So a message goes in pieces of
at most PIECE bytes, and a tunnel has at most WINDOW bytes under way: the receiver gives credit as
it passes them on.  A frame carries, the kind first in the payload and bytes in the buffers::

    WHOLE   a small message: its payload follows the kind, its buffers are the buffers
    FIRST   a large one: the sizes of payload and buffers follow; the first piece is the buffer
    MORE    the next piece
    CREDIT  how many more bytes may come
"""

from __future__ import annotations

import itertools
import struct
from collections import deque
from collections.abc import Callable, Iterator, Sequence

from fiber._hub.streams import Handler, NullHandler, Stream, splice
from fiber._wire import messages
from fiber._wire.messages import TunnelClose, TunnelData, TunnelOpen
from fiber._wire.packet import BytesLike, Message

PIECE = 1 << 20
"""More than packet.INLINE_LIMIT.  What is not larger arrives in one piece, and is not put together
from several.
"""

WINDOW = 2 * PIECE

_WHOLE, _FIRST, _MORE, _CREDIT = range(4)
_KINDS = [bytes([kind]) for kind in range(4)]
_SIZE = struct.Struct("<Q")

Frame = TunnelOpen | TunnelData | TunnelClose
Send = Callable[[Frame], None]


class TunnelStream:
    """One end of a tunnel, on the loop's thread."""

    passes_descriptors = False

    def __init__(self, number: int, send: Send, forget: Callable[[int], None]) -> None:
        self.handler: Handler = NullHandler()
        self._number = number
        self._send_frame = send
        self._forget = forget
        self._credit = WINDOW
        self._waiting: deque[tuple[TunnelData, int]] = deque()
        self._owed = 0
        self._paused = False
        self._early: deque[Message] = deque()
        self._assembly: _Assembly | None = None
        self._finishing: str | None = None
        self._closed = False

    @property
    def congested(self) -> bool:
        """Whether the other side takes less than comes."""
        return bool(self._waiting)

    def send(
        self,
        payload: BytesLike,
        buffers: Sequence[memoryview] = (),
        fds: Sequence[int] = (),
    ) -> None:
        """Send now or when there is credit."""
        assert not fds, "a descriptor cannot leave its host"
        if self._closed or self._finishing is not None:
            return
        for header, piece, size in _pieces(payload, buffers):
            frame = TunnelData(self._number, header, piece)
            if self._waiting or self._credit <= 0:
                self._waiting.append((frame, size))
            else:
                self._credit -= size
                self._send_frame(frame)

    def pause(self) -> None:
        """Give no more credit, and keep what still comes."""
        self._paused = True

    def resume(self) -> None:
        """Go on."""
        self._paused = False
        while self._early and not self._paused:
            self.handler.on_message(self._early.popleft())
        self._give_credit()

    def finish(self, reason: str = "") -> None:
        """End it once all is sent."""
        self.handler = NullHandler()
        if self._closed or self._finishing is not None:
            return
        self._finishing = reason
        if not self._waiting:
            self._end()

    # What comes over the link

    def on_data(self, header: memoryview, buffers: list[memoryview]) -> None:
        """A frame of this tunnel."""
        kind = header[0]
        if kind == _CREDIT:
            self._credit += _SIZE.unpack(header[1:])[0]
            self._pump()
            return
        if kind == _WHOLE:
            self._arrived(Message(header[1:], buffers, []))
            self._owe(len(header) + sum(view.nbytes for view in buffers))
            return
        (piece,) = buffers
        if kind == _FIRST:
            self._assembly = _Assembly(header[1:])
        if self._assembly is None:
            raise ValueError("a piece of no message")
        self._assembly.add(piece)
        if self._assembly.complete:
            message, self._assembly = self._assembly.message(), None
            self._arrived(message)
        self._owe(piece.nbytes)

    def on_close(self, reason: str) -> None:
        """The other side ended it, or the link is lost."""
        if not self._closed:
            self._closed = True
            self._waiting.clear()
            self._forget(self._number)
            handler, self.handler = self.handler, NullHandler()
            while self._early:  # sent before the end
                handler.on_message(self._early.popleft())
            handler.on_closed(reason)

    def _arrived(self, message: Message) -> None:
        if self._paused:
            self._early.append(message)
        else:
            self.handler.on_message(message)

    def _owe(self, size: int) -> None:
        self._owed += size
        self._give_credit()

    def _give_credit(self) -> None:
        if not self._paused and self._owed >= WINDOW // 2:
            credit, self._owed = self._owed, 0
            self._send_frame(TunnelData(self._number, _KINDS[_CREDIT] + _SIZE.pack(credit)))

    def _pump(self) -> None:
        if not self._waiting:
            return
        while self._waiting and self._credit > 0:
            frame, size = self._waiting.popleft()
            self._credit -= size
            self._send_frame(frame)
        if self._waiting:
            return
        if self._finishing is None:
            self.handler.on_room()
        else:
            self._end()

    def _end(self) -> None:
        self._closed = True
        self._forget(self._number)
        self._send_frame(TunnelClose(self._number, self._finishing or ""))


class Tunnels:
    """The tunnels of one link.

    ``send`` takes a frame for the link and does not block.  Whoever has the link calls ``on_frame``
    with each tunnel frame that comes and ``lost`` at its end, on the loop's thread.  Exactly one
    side of a link is its ``dialer``: both open tunnels, and their numbers must not meet.
    """

    def __init__(self, send: Send, *, dialer: bool, arrived: Callable[[str, Stream], None]) -> None:
        self._send = send
        self._arrived = arrived
        self._numbers = itertools.count(1 if dialer else 2, 2)
        self._streams: dict[int, TunnelStream] = {}
        self._lost: str | None = None

    def open(self, host: str) -> TunnelStream:
        """A tunnel to the hub of ``host``, to be used at once."""
        stream = self._new(next(self._numbers))
        self._send(TunnelOpen(stream._number, host))
        return stream

    def on_frame(self, frame: messages.Message) -> None:
        """A frame that came over the link."""
        if isinstance(frame, TunnelOpen):
            self._arrived(frame.target, self._new(frame.tunnel))
            return
        assert isinstance(frame, TunnelData | TunnelClose)
        stream = self._streams.get(frame.tunnel)
        if stream is None:
            return  # it ended here while the frame was under way
        if isinstance(frame, TunnelClose):
            stream.on_close(frame.reason)
            return
        try:
            stream.on_data(memoryview(frame.payload), [memoryview(b) for b in frame.buffers])
        except (struct.error, ValueError, IndexError, OverflowError, MemoryError) as error:
            # Not what the other side's tunnel writes.
            self._send(TunnelClose(frame.tunnel, "malformed data in a tunnel"))
            stream.on_close(f"malformed data in a tunnel: {error}")

    def lost(self, reason: str) -> None:
        """The link is over, and all its tunnels with it."""
        self._lost = reason
        for stream in list(self._streams.values()):
            stream.on_close(reason)

    def _new(self, number: int) -> TunnelStream:
        stream = TunnelStream(number, self._send_unless_lost, self._forget)
        self._streams[number] = stream
        return stream

    def _send_unless_lost(self, frame: Frame) -> None:
        if self._lost is None:
            self._send(frame)

    def _forget(self, number: int) -> None:
        self._streams.pop(number, None)


class Router:
    """Knows over which link each host is reached."""

    def __init__(self, host: str, accept: Callable[[Stream], None]) -> None:
        self._host = host
        self._accept = accept
        self._links: dict[str | None, Tunnels] = {}

    def link(self, host: str | None, send: Send, *, dialer: bool) -> Tunnels:
        """A new link to ``host``; with None it leads to every host that no other link leads to."""
        tunnels = Tunnels(send, dialer=dialer, arrived=self.connect)
        self._links[host] = tunnels
        return tunnels

    def unlink(self, host: str | None, reason: str) -> None:
        """The link is over."""
        tunnels = self._links.pop(host, None)
        if tunnels is not None:
            tunnels.lost(reason)

    def connect(self, host: str, stream: Stream) -> None:
        """Lead ``stream`` to the hub of ``host``."""
        if host == self._host:
            self._accept(stream)
            return
        tunnels = self._links.get(host, self._links.get(None))
        if tunnels is None:
            stream.finish(f"host {host!r} cannot be reached: no agent of that name is there")
            return
        splice(stream, tunnels.open(host))


class _Assembly:
    """A message of which the pieces come one by one."""

    def __init__(self, table: memoryview) -> None:
        sizes = [size for (size,) in _SIZE.iter_unpack(table)]
        self._parts = [memoryview(bytearray(size)) for size in sizes]
        self._index = self._offset = 0

    def add(self, piece: memoryview) -> None:
        """The next piece: it may end one part and begin others."""
        while piece.nbytes:
            part = self._parts[self._index]
            taken = min(part.nbytes - self._offset, piece.nbytes)
            part[self._offset : self._offset + taken] = piece[:taken]
            piece = piece[taken:]
            self._offset += taken
            self._skip_full()

    def _skip_full(self) -> None:
        while self._index < len(self._parts) and self._offset == self._parts[self._index].nbytes:
            self._index += 1
            self._offset = 0

    @property
    def complete(self) -> bool:
        """Whether nothing is missing."""
        return self._index == len(self._parts)

    def message(self) -> Message:
        """The message."""
        return Message(self._parts[0], self._parts[1:], [])


def _pieces(
    payload: BytesLike, buffers: Sequence[memoryview]
) -> Iterator[tuple[bytes, Sequence[memoryview], int]]:
    """Header, buffers and size of each frame that a message takes.

    They may be kept: only the payload of a small message is ever borrowed, and it is copied.
    """
    parts = [memoryview(payload).cast("B"), *(view.cast("B") for view in buffers)]
    total = sum(part.nbytes for part in parts)
    if total <= PIECE:
        yield _KINDS[_WHOLE] + bytes(parts[0]), parts[1:], total + 1
        return
    table = b"".join(_SIZE.pack(part.nbytes) for part in parts)
    header = _KINDS[_FIRST] + table
    for piece in _cut(parts):
        yield header, [piece], piece.nbytes
        header = _KINDS[_MORE]


def _cut(parts: Sequence[memoryview]) -> Iterator[memoryview]:
    for part in parts:
        for start in range(0, part.nbytes, PIECE):
            yield part[start : start + PIECE]
