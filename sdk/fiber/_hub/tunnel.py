"""Streams between the hubs of two hosts, over the links between agents and master.

::

    process ── unix stream ── its hub ══ link ══ master ══ link ══ another hub
                                │ splice              │ splice         │ handler

Many tunnels share a link with everything else that travels there; the link sees to it that large
messages take turns.  A tunnel has at most WINDOW bytes and a message under way: the receiver gives
credit as it passes messages on.  A frame carries, the kind first in the payload::

    MESSAGE  its payload follows the kind, its buffers are the buffers
    CREDIT   how many more bytes may come
"""

from __future__ import annotations

import itertools
import struct
from collections import deque
from collections.abc import Callable, Sequence

from fiber._hub.streams import Handler, NullHandler, Stream, splice
from fiber._wire import messages
from fiber._wire.memory_files import BytesLike, pass_on
from fiber._wire.messages import TunnelClose, TunnelData, TunnelOpen
from fiber._wire.packet import Message

WINDOW = 1 << 21
"""Bytes that one tunnel may have under way before another message."""

_MESSAGE, _CREDIT = range(2)
_KINDS = [bytes([kind]) for kind in range(2)]
_SIZE = struct.Struct("<Q")

Frame = TunnelOpen | TunnelData | TunnelClose
Send = Callable[[Frame], None]


class TunnelStream:
    """End of a tunnel.  Runs on the loop's thread."""

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
        self._finishing: str | None = None
        self._closed = False

    @property
    def congested(self) -> bool:
        """True if the other side takes less than is sent."""
        return self._credit <= 0

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
        # The payload may be borrowed; the buffers are their message's own.
        frame = TunnelData(self._number, _KINDS[_MESSAGE] + payload, buffers)
        size = _size(frame.payload, buffers)
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
            was_congested = self.congested
            self._credit += _SIZE.unpack(header[1:])[0]
            self._pump()
            if was_congested and not self.congested:
                self.handler.on_room()
            return
        if kind != _MESSAGE:
            raise ValueError(f"a frame of unknown kind {kind}")
        for buffer in buffers:
            pass_on(buffer)
        self._arrived(Message(header[1:], buffers, []))
        self._owe(_size(header, buffers))

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
        while self._waiting and self._credit > 0:
            frame, size = self._waiting.popleft()
            self._credit -= size
            self._send_frame(frame)
        if self._finishing is not None and not self._waiting:
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

    def on_frame(self, frame: messages.LinkMessage) -> None:
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


def _size(payload: BytesLike, buffers: Sequence[memoryview]) -> int:
    return len(payload) + sum(view.nbytes for view in buffers)
