"""Streams of messages to and from a hub, on the loop thread: over unix sockets, and in tunnels.

A tunnel is a stream between the hubs of two hosts, over the links between agents and master::

    process ── unix stream ── its hub ══ link ══ master ══ link ══ another hub
                                │ splice              │ splice         │ handler

A link carries many tunnels and all other messages; it lets large messages take turns.  At
most WINDOW bytes and one message of a tunnel are on the way: the receiver gives credit as it passes
messages on.
The payload of a frame begins with its kind:

    MESSAGE  the payload follows the kind; the frame's buffers are the message's
    CREDIT   how many more bytes may come

``Poller`` watches all descriptors of a hub through one descriptor that the loop reads.
"""

from __future__ import annotations

import itertools
import os
import select
import socket
import struct
from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

from fiber._hub import protocol
from fiber._transport.loop import Loop
from fiber._wire import messages, packet
from fiber._wire.memory_files import BytesLike, pass_on
from fiber._wire.messages import TunnelClose, TunnelData, TunnelOpen
from fiber._wire.packet import Message

CONGESTED = 1 << 20
"""Bytes that wait to be sent above which a stream is congested."""

_AT_ONCE = 16
"""Limit of messages of one stream in a turn.  Then other streams get their turn."""


class StreamHandler(Protocol):
    """Receiver of the messages of a stream."""

    def on_message(self, message: Message) -> None:
        """Take a message, which must not be used after the return."""

    def on_room(self) -> None:
        """Note that a congested stream has room again."""

    def on_closed(self, reason: str) -> None:
        """Note the end.  Called once, as the last call; ``reason`` is empty at an orderly end."""


class Stream(Protocol):
    """End of a stream between a hub and a client."""

    handler: StreamHandler
    passes_descriptors: bool

    @property
    def congested(self) -> bool:
        """True if many messages wait to be sent.  ``send`` still works."""

    def send(
        self,
        payload: BytesLike,
        buffers: Sequence[memoryview] = (),
        fds: Sequence[int] = (),
    ) -> None:
        """Send now or as soon as there is room; do nothing after the end.  Takes over ``fds``."""

    def pause(self) -> None:
        """Deliver no message until ``resume``."""

    def resume(self) -> None:
        """Deliver messages again."""

    def finish(self, reason: str = "") -> None:
        """End the stream after the messages that were sent, with a reason.

        The handler is not called again.
        """


class NullHandler:
    """Handler that ignores the messages of a stream."""

    def on_message(self, message: Message) -> None:
        """Do nothing."""

    def on_room(self) -> None:
        """Do nothing."""

    def on_closed(self, reason: str) -> None:
        """Do nothing."""


class SocketStream:
    """Stream over a unix socket."""

    passes_descriptors = True

    def __init__(self, poller: Poller, sock: socket.socket) -> None:
        sock.setblocking(False)
        self.handler: StreamHandler = NullHandler()
        self._poller = poller
        self._sock = sock
        self._waiting: deque[tuple[BytesLike, Sequence[memoryview], Sequence[int]]] = deque()
        self._waiting_bytes = 0
        self._paused = False
        self._finishing = False
        self._watch()

    @property
    def congested(self) -> bool:
        """True if many messages wait to be sent."""
        return self._waiting_bytes > CONGESTED

    def send(
        self,
        payload: BytesLike,
        buffers: Sequence[memoryview] = (),
        fds: Sequence[int] = (),
    ) -> None:
        """Send now or later."""
        if self._sock.fileno() < 0 or self._finishing:
            _close_all(fds)
        elif self._waiting or not self._try(payload, buffers, fds):
            # The payload may be in borrowed memory; the buffers belong to the message.
            self._waiting.append((bytes(payload), buffers, fds))
            self._waiting_bytes += _size(payload, buffers)
            self._watch()

    def pause(self) -> None:
        """Stop reading."""
        self._paused = True
        self._watch()

    def resume(self) -> None:
        """Read again."""
        self._paused = False
        self._watch()

    def finish(self, reason: str = "") -> None:
        """End the stream when all messages are sent."""
        self.handler = NullHandler()
        if reason:
            self.send(protocol.gone(reason))
        self._finishing = True
        if self._waiting:
            self._watch()
        else:
            self._close("")

    def _watch(self) -> None:
        if self._sock.fileno() >= 0:
            mask = OUT if self._waiting else 0
            if not (self._paused or self._finishing):
                mask |= IN
            self._poller.watch(self._sock.fileno(), mask, self._event)

    def read_rest(self) -> None:
        """Read all that the other side, which has ended, has sent."""
        while self._sock.fileno() >= 0 and not (self._paused or self._finishing):
            self._read()

    def fileno(self) -> int:
        """Return the socket's descriptor; -1 after the end."""
        return self._sock.fileno()

    def _event(self, events: int) -> None:
        if events & OUT:
            self._flush()
        if events & ~OUT and self._sock.fileno() >= 0:
            if self._paused or self._finishing:
                # The poller reports only the end now.  The client has ended and waits for no reply.
                self._close("")
            else:
                self._read()

    def _read(self) -> None:
        for _ in range(_AT_ONCE):
            try:
                message = packet.receive(self._sock, descriptors=True, passing=True)
            except BlockingIOError:
                return
            except (EOFError, ConnectionError):
                self._close("")
                return
            except (OSError, MemoryError, struct.error, ValueError, IndexError) as error:
                # No descriptor or memory is free for the message, or the packet is malformed.
                handler = self.handler
                self.finish(str(error))
                handler.on_closed(str(error))
                return
            try:
                self.handler.on_message(message)
            finally:
                message.close_descriptors()
                message.release()
            if self._paused or self._finishing:
                return

    def _try(self, payload: BytesLike, buffers: Sequence[memoryview], fds: Sequence[int]) -> bool:
        try:
            packet.send(self._sock, payload, buffers, fds)
        except BlockingIOError:
            return False
        except BrokenPipeError:
            # The reader of this socket reports the end, after the last messages.
            pass
        except BaseException:
            _close_all(fds)
            raise
        _close_all(fds)
        return True

    def _flush(self) -> None:
        was_congested = self.congested
        while self._waiting:
            payload, buffers, fds = self._waiting[0]
            if not self._try(payload, buffers, fds):
                break
            self._waiting.popleft()
            self._waiting_bytes -= _size(payload, buffers)
        if self._finishing and not self._waiting:
            self._close("")
            return
        self._watch()
        if was_congested and not self.congested:
            self.handler.on_room()

    def _close(self, reason: str) -> None:
        if self._sock.fileno() < 0:
            return
        self._poller.forget(self._sock.fileno())
        self._sock.close()
        for _, _, fds in self._waiting:
            _close_all(fds)
        self._waiting.clear()
        handler, self.handler = self.handler, NullHandler()
        handler.on_closed(reason)


class _Forwarder:
    """Handler that forwards messages of one stream to another, as fast as that takes them."""

    def __init__(self, source: Stream, sink: Stream) -> None:
        self._source = source
        self._sink = sink

    def on_message(self, message: Message) -> None:
        """Forward a message."""
        self._sink.send(message.payload, message.buffers)
        if self._sink.congested:
            self._source.pause()

    def on_room(self) -> None:
        """Resume the other direction, as this stream has room again."""
        self._sink.resume()

    def on_closed(self, reason: str) -> None:
        """Forward the end."""
        self._sink.finish(reason)


def splice(one: Stream, other: Stream) -> None:
    """Connect two streams: forward the messages of each to the other."""
    one.handler, other.handler = _Forwarder(one, other), _Forwarder(other, one)


def _size(payload: BytesLike, buffers: Sequence[memoryview]) -> int:
    return memoryview(payload).nbytes + sum(view.nbytes for view in buffers)


def _close_all(fds: Sequence[int]) -> None:
    for fd in fds:
        os.close(fd)


IN, OUT, EDGE = select.EPOLLIN, select.EPOLLOUT, select.EPOLLET


class Poller:
    """Watcher of the hub's descriptors, whose masks change often.  Runs on the loop thread."""

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self._epoll = select.epoll()
        self._watched: dict[int, tuple[int, Callable[[int], None]]] = {}
        loop.register(self._epoll.fileno(), self._ready)

    def watch(self, fd: int, mask: int, callback: Callable[[int], None]) -> None:
        """Call back with the events when ``fd`` is ready as in ``mask``, or at its end.

        A mask of 0 forgets ``fd``.
        """
        before, _ = self._watched.get(fd, (0, None))
        if not mask:
            if self._watched.pop(fd, None) is not None:
                self._epoll.unregister(fd)
            return
        self._watched[fd] = mask, callback
        if not before:
            self._epoll.register(fd, mask)
        elif before != mask or mask & EDGE:
            self._epoll.modify(fd, mask)

    def forget(self, fd: int) -> None:
        """Forget ``fd``.  Call it before the descriptor is closed."""
        if self._watched.pop(fd, None) is not None:
            self._epoll.unregister(fd)

    def close(self) -> None:
        """Forget all descriptors."""
        self._loop.unregister(self._epoll.fileno())
        self._epoll.close()
        self._watched.clear()

    def _ready(self) -> None:
        for fd, events in self._epoll.poll(0):
            watched = self._watched.get(fd)
            if watched is not None:  # otherwise an earlier event has forgotten it
                watched[1](events)


# Tunnels

WINDOW = 1 << 21
"""Bytes that a tunnel may have on the way before another message."""

_MESSAGE, _CREDIT = range(2)
_KINDS = [bytes([kind]) for kind in range(2)]
_SIZE = struct.Struct("<Q")

TunnelFrame = TunnelOpen | TunnelData | TunnelClose
SendTunnelFrame = Callable[[TunnelFrame], None]


class TunnelStream:
    """End of a tunnel, as a ``Stream``.  Runs on the loop thread."""

    passes_descriptors = False

    def __init__(self, number: int, send: SendTunnelFrame, forget: Callable[[int], None]) -> None:
        self.handler: StreamHandler = NullHandler()
        self._number = number
        self._send_frame = send
        self._forget = forget
        self._credit = WINDOW
        self._waiting: deque[tuple[TunnelData, int]] = deque()
        self._consumed = 0
        self._paused = False
        self._early: deque[Message] = deque()
        self._finishing: str | None = None
        self._closed = False

    @property
    def congested(self) -> bool:
        """True if there is no credit left."""
        return self._credit <= 0

    def send(
        self,
        payload: BytesLike,
        buffers: Sequence[memoryview] = (),
        fds: Sequence[int] = (),
    ) -> None:
        """Send now or as soon as there is credit."""
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
        """Give no more credit, and keep the messages that still come."""
        self._paused = True

    def resume(self) -> None:
        """Deliver messages again."""
        self._paused = False
        while self._early and not self._paused:
            self.handler.on_message(self._early.popleft())
        self._give_credit()

    def finish(self, reason: str = "") -> None:
        """End the stream when all messages are sent."""
        self.handler = NullHandler()
        if self._closed or self._finishing is not None:
            return
        self._finishing = reason
        if not self._waiting:
            self._end()

    # Frames from the link

    def on_data(self, header: memoryview, buffers: list[memoryview]) -> None:
        """Take a frame of this tunnel."""
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
        self._count_consumed(_size(header, buffers))

    def on_close(self, reason: str) -> None:
        """Note that the other side ended the tunnel, or that the link is lost."""
        if not self._closed:
            self._closed = True
            self._waiting.clear()
            self._forget(self._number)
            handler, self.handler = self.handler, NullHandler()
            while self._early:  # they were sent before the end
                handler.on_message(self._early.popleft())
            handler.on_closed(reason)

    def _arrived(self, message: Message) -> None:
        if self._paused:
            self._early.append(message)
        else:
            self.handler.on_message(message)

    def _count_consumed(self, size: int) -> None:
        self._consumed += size
        self._give_credit()

    def _give_credit(self) -> None:
        if not self._paused and self._consumed >= WINDOW // 2:
            credit, self._consumed = self._consumed, 0
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
    """Tunnels of one link.

    ``send`` takes a frame for the link and does not block.  The hub calls ``on_frame`` with each
    tunnel frame that comes, and ``lost`` at the end of the link, on the loop thread.  Exactly one
    side of a link is its ``dialer``: both sides open tunnels, and their numbers must differ.
    """

    def __init__(
        self,
        send: SendTunnelFrame,
        *,
        dialer: bool,
        arrived: Callable[[str, Stream], None],
    ) -> None:
        self._send = send
        self._arrived = arrived
        self._numbers = itertools.count(1 if dialer else 2, 2)
        self._streams: dict[int, TunnelStream] = {}
        self._lost: str | None = None

    def open(self, host: str) -> TunnelStream:
        """Open a tunnel to the hub of ``host``.  It can be used at once."""
        stream = self._new(next(self._numbers))
        self._send(TunnelOpen(stream._number, host))
        return stream

    def on_frame(self, frame: messages.LinkMessage) -> None:
        """Take a frame from the link."""
        if isinstance(frame, TunnelOpen):
            self._arrived(frame.target, self._new(frame.tunnel))
            return
        assert isinstance(frame, TunnelData | TunnelClose)
        stream = self._streams.get(frame.tunnel)
        if stream is None:
            return  # this side ended it while the frame was on its way
        if isinstance(frame, TunnelClose):
            stream.on_close(frame.reason)
            return
        try:
            stream.on_data(memoryview(frame.payload), [memoryview(b) for b in frame.buffers])
        except (struct.error, ValueError, IndexError, OverflowError, MemoryError) as error:
            # No tunnel writes such a frame.
            self._send(TunnelClose(frame.tunnel, "malformed data in a tunnel"))
            stream.on_close(f"malformed data in a tunnel: {error}")

    def lost(self, reason: str) -> None:
        """Note that the link has ended, and all its tunnels with it."""
        self._lost = reason
        for stream in list(self._streams.values()):
            stream.on_close(reason)

    def _new(self, number: int) -> TunnelStream:
        stream = TunnelStream(number, self._send_unless_lost, self._forget)
        self._streams[number] = stream
        return stream

    def _send_unless_lost(self, frame: TunnelFrame) -> None:
        if self._lost is None:
            self._send(frame)

    def _forget(self, number: int) -> None:
        self._streams.pop(number, None)


class Router:
    """Routes of one hub: the link to each other host."""

    def __init__(self, host: str, accept: Callable[[Stream], None]) -> None:
        self._host = host
        self._accept = accept
        self._links: dict[str | None, Tunnels] = {}

    def link(self, host: str | None, send: SendTunnelFrame, *, dialer: bool) -> Tunnels:
        """Add a link to ``host``.  None stands for every host without another link."""
        tunnels = Tunnels(send, dialer=dialer, arrived=self.connect)
        self._links[host] = tunnels
        return tunnels

    def unlink(self, host: str | None, reason: str) -> None:
        """Remove a link that has ended."""
        tunnels = self._links.pop(host, None)
        if tunnels is not None:
            tunnels.lost(reason)

    def connect(self, host: str, stream: Stream) -> None:
        """Connect ``stream`` to the hub of ``host``."""
        if host == self._host:
            self._accept(stream)
            return
        tunnels = self._links.get(host, self._links.get(None))
        if tunnels is None:
            stream.finish(f"host {host!r} cannot be reached: no agent of that name is there")
            return
        splice(stream, tunnels.open(host))
