"""Streams of messages between a hub and its clients, on the loop thread.

``Poller`` watches all descriptors of a hub through one descriptor that the loop reads.
"""

from __future__ import annotations

import os
import select
import socket
import struct
from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

from fiber._hub import protocol
from fiber._transport.loop import Loop
from fiber._wire import packet
from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import Message

CONGESTED = 1 << 20
"""Bytes waiting to be sent above which a stream asks for patience."""

_AT_ONCE = 16
"""Messages of one stream before the others get their turn."""


class Handler(Protocol):
    """Hears what comes on a stream."""

    def on_message(self, message: Message) -> None:
        """A message; borrowed until this returns."""

    def on_room(self) -> None:
        """Note that a congested stream has room again."""

    def on_closed(self, reason: str) -> None:
        """Note the end.  Called once, and last; ``reason`` is empty at an orderly end."""


class Stream(Protocol):
    """End of a stream."""

    handler: Handler
    passes_descriptors: bool

    @property
    def congested(self) -> bool:
        """True if messages pile up.  Sending more still works."""

    def send(
        self,
        payload: BytesLike,
        buffers: Sequence[memoryview] = (),
        fds: Sequence[int] = (),
    ) -> None:
        """Send now or as soon as there is room.  After the end it does nothing.  Takes ``fds``."""

    def pause(self) -> None:
        """Let nothing come until ``resume``."""

    def resume(self) -> None:
        """Go on."""

    def finish(self, reason: str = "") -> None:
        """End it, once what was sent has left, and say why.  The handler hears nothing more."""


class NullHandler:
    """The handler of a stream that nobody listens to any more."""

    def on_message(self, message: Message) -> None:
        """Ignore it."""

    def on_room(self) -> None:
        """Ignore it."""

    def on_closed(self, reason: str) -> None:
        """Ignore it."""


class SocketStream:
    """A stream over a unix socket."""

    passes_descriptors = True

    def __init__(self, poller: Poller, sock: socket.socket) -> None:
        sock.setblocking(False)
        self.handler: Handler = NullHandler()
        self._poller = poller
        self._sock = sock
        self._waiting: deque[tuple[BytesLike, Sequence[memoryview], Sequence[int]]] = deque()
        self._waiting_bytes = 0
        self._paused = False
        self._finishing = False
        self._watch()

    @property
    def congested(self) -> bool:
        """True if messages pile up."""
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
            # The payload may be borrowed; buffers are their message's own.
            self._waiting.append((bytes(payload), buffers, fds))
            self._waiting_bytes += _size(payload, buffers)
            self._watch()

    def pause(self) -> None:
        """Read nothing."""
        self._paused = True
        self._watch()

    def resume(self) -> None:
        """Read on."""
        self._paused = False
        self._watch()

    def finish(self, reason: str = "") -> None:
        """End it once all is sent."""
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

    def _event(self, events: int) -> None:
        if events & OUT:
            self._flush()
        if events & ~OUT and self._sock.fileno() >= 0:
            if self._paused or self._finishing:
                # Only its end is reported then.  Whoever is gone waits for no answer.
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
                # No descriptor or memory free for what it sent, or no packet of ours.
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
            # The reading side will say so, after what it still has for us.
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
    """Passes on what comes from one stream to another, no faster than that one takes it."""

    def __init__(self, source: Stream, sink: Stream) -> None:
        self._source = source
        self._sink = sink

    def on_message(self, message: Message) -> None:
        """Pass it on."""
        self._sink.send(message.payload, message.buffers)
        if self._sink.congested:
            self._source.pause()

    def on_room(self) -> None:
        """Our source takes messages again: the other direction may go on."""
        self._sink.resume()

    def on_closed(self, reason: str) -> None:
        """Pass the end on."""
        self._sink.finish(reason)


def splice(one: Stream, other: Stream) -> None:
    """Make one stream of two."""
    one.handler, other.handler = _Forwarder(one, other), _Forwarder(other, one)


def _size(payload: BytesLike, buffers: Sequence[memoryview]) -> int:
    return memoryview(payload).nbytes + sum(view.nbytes for view in buffers)


def _close_all(fds: Sequence[int]) -> None:
    for fd in fds:
        os.close(fd)


IN, OUT, EDGE = select.EPOLLIN, select.EPOLLOUT, select.EPOLLET


class Poller:
    """Calls back on the loop's thread with what is ready, for masks that change all the time."""

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self._epoll = select.epoll()
        self._watched: dict[int, tuple[int, Callable[[int], None]]] = {}
        loop.register(self._epoll.fileno(), self._ready)

    def watch(self, fd: int, mask: int, callback: Callable[[int], None]) -> None:
        """Call back when ``fd`` is ready as ``mask`` says, or at its end; 0 forgets it."""
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
        """Watch it no more; do it before it is closed."""
        if self._watched.pop(fd, None) is not None:
            self._epoll.unregister(fd)

    def close(self) -> None:
        """Watch nothing more."""
        self._loop.unregister(self._epoll.fileno())
        self._epoll.close()
        self._watched.clear()

    def _ready(self) -> None:
        for fd, events in self._epoll.poll(0):
            watched = self._watched.get(fd)
            if watched is not None:  # otherwise forgotten by an earlier one of these events
                watched[1](events)
