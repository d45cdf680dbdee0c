"""Channels and counters, the two primitives under every connection, queue, event and semaphore.

The protocols have two implementations.  Holders on the host where the object lives use kernel
objects: sockets and eventfds, shared by descriptor (``UnixChannel`` and ``UnixCounter`` here, with
``fiber._hub.local`` on top).  All other holders send requests to that host's hub
(``fiber._hub.remote``).

``Outbox`` sends packets without blocking: the loop sends later what the kernel does not take now.
"""

from __future__ import annotations

import errno
import functools
import os
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Protocol, Self

from fiber._transport.loop import LONGEST_POLL, Loop
from fiber._unconfirmed import flush_all, unconfirmed
from fiber._wire import packet
from fiber._wire.descriptor import Descriptor, own
from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import Message
from fiber.errors import FiberError, FileTooLarge, TooManyOpenFiles


class Channel(Protocol):
    """End of a message pipe.

    Messages arrive whole; holders may share an end without a lock.
    """

    def send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message; BrokenPipeError if the other end has no holder left."""

    def send_surely(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message.  Return when the channel has taken it, also on another host."""

    def send_unconfirmed(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message.  Do not wait until a large one has arrived at another host."""

    def recv(self, *, passing: bool = False) -> Message:
        """Return the next message; ConnectionClosed if the other end has no holder left.

        ``passing``: the caller soon copies or releases the large parts of the message.
        """

    def exchange(
        self, payload: BytesLike, buffers: Sequence[memoryview] = (), *, soon: bool = False
    ) -> Message:
        """Send one message; return the next one, on another host by the same request.

        ``soon``: the next message probably comes soon.  BrokenPipeError or ConnectionClosed at the
        end.  The message may have been sent or not.
        """

    def recv_object(self) -> Any:
        """Return the next message, unpickled."""

    def try_recv(self) -> Message | None:
        """Return the next message if one is there."""

    def poll(self, timeout: float | None) -> bool:
        """Wait until ``recv`` would return or raise at once; None waits for ever.

        Return False after ``timeout`` seconds.
        """

    def fileno(self) -> int:
        """Return a descriptor that is readable whenever ``recv`` would not block."""

    def close(self) -> None:
        """Close this holder's end.  The other end sees EOF after the last holder has closed it."""


class Counter(Protocol):
    """Count that never falls below zero, and that callers can wait for."""

    def add(self, n: int = 1) -> None:
        """Raise the count and wake the waiters."""

    def take(self, timeout: float | None) -> bool:
        """Lower the count by one once it is above zero; False when ``timeout`` is over."""

    def clear(self) -> int:
        """Set the count to zero and return the count before."""

    def value(self) -> int:
        """Return the count."""

    def wait(self, timeout: float | None) -> bool:
        """Wait until the count is above zero, without lowering it."""

    def close(self) -> None:
        """Close this holder's end of the counter."""


class SendingChannel(Channel, Protocol):
    """Channel by which a queue sends its items."""

    @property
    def can_try_send(self) -> bool:
        """True if ``try_send_directly`` can succeed."""

    def post(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message, waiting for room but not until it is read."""

    def try_send_directly(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send one message if there is room for it now, and no other message waits for some."""


class ReceivingChannel(Channel, Protocol):
    """Channel by which a queue receives its items."""

    def recv_counting(self, counter: Any, claims: Claimant, *, wait: bool) -> Message | None:
        """Receive a message and raise ``counter``, a ``SharedCounter`` of the same host.

        Both happen or none, also if this process is interrupted.  If it dies in between, ``claims``
        has a record of that.  Return None if there is no message.
        """

    def recv_uncounting(self, counter: Any, *, wait: bool) -> Message | None:
        """Receive a message, then lower ``counter``; None if there is no message."""


class Claimant(Protocol):
    """Record of how many units of a counter a process holds.

    ``fiber._hub.queue_delivery.SlotClaims`` implements it, in a layer above this one.
    """

    def add(self) -> None:
        """Record one more unit."""

    def drop(self) -> None:
        """Record one unit less."""


class SharedCounter(Counter, Protocol):
    """Counter that also lets callers wait for each change."""

    def claim(self, timeout: float | None, taken: list[Any], claims: Claimant) -> bool:
        """Take one as ``take`` does, and record it in ``claims``.

        ``taken`` gets an entry when the count is lowered: an interrupted caller can give it back.
        A process that dies in between has not taken one, or has a claim.
        """

    def changed(self, since: int, timeout: float | None) -> bool:
        """Wait until the count is not ``since``; False when ``timeout`` is over."""


class naming_the_limit:
    """Context that turns "no more descriptors" and "too large" into errors that name the limit.

    These errors say which setting to raise.
    """

    # No generator: contextlib leaves the frames of a translated error in a cycle.  They would keep
    # the descriptors on the program's stack open until a garbage collection.

    def __init__(self, doing: str) -> None:
        self._doing = doing

    def __enter__(self) -> None:
        pass

    def __exit__(self, _kind: Any, error: BaseException | None, _trace: Any) -> None:
        if not isinstance(error, OSError) or isinstance(error, FiberError):
            return
        if error.errno in (errno.EMFILE, errno.ENFILE):
            raise TooManyOpenFiles(self._doing) from error
        if error.errno == errno.EFBIG:
            raise FileTooLarge(self._doing) from error


def socketpair(doing: str) -> tuple[socket.socket, socket.socket]:
    """Return two connected packet sockets that block, without the program's default timeout."""
    with naming_the_limit(doing):
        pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for sock in pair:
        _block(sock)
    return pair


def connected() -> tuple[Descriptor, Descriptor]:
    """Open two connected packet sockets, and return their owners."""
    one, other = socketpair("opening a pipe")
    return own(one.detach()), own(other.detach())


def _block(sock: socket.socket) -> None:
    if sock.gettimeout() is not None:  # socket.setdefaulttimeout() is for the user's sockets
        sock.settimeout(None)


class BorrowedSocket(socket.socket):
    """Blocking packet socket over a descriptor that another object owns."""

    __slots__ = ()

    def __init__(self, owner: Descriptor) -> None:
        super().__init__(socket.AF_UNIX, socket.SOCK_SEQPACKET, 0, owner.fileno())
        _block(self)

    def __del__(self) -> None:
        self.detach()


@functools.cache
def _usual_room() -> int:
    """Return the default size of a socket's buffer: net.core.wmem_default."""
    one, other = socketpair("opening a pipe")
    with one, other:
        return one.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)


def grow(sock: socket.socket) -> None:
    """Double the buffer of a socket that is full.  A second call changes nothing.

    It is done only when needed: a larger buffer takes a larger ballast (``packet.send``).
    """
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _usual_room())  # the kernel doubles it


# How a receiver looks for an answer before it sleeps (decision 4)

_LOOK = 200e-6
"""Seconds of looking: longer than it takes to wake the processor of the other end."""

_SOON = 30e-6
"""Seconds within which an answer has to come to make it worth looking for the next one."""

_TRIES = 8
"""Number of answers in a row that may come later, while the other end wakes up."""

_SLEEPS = 255
"""Number of answers for which the receiver sleeps at once, after looking was not worth it."""

_last_asked = 0
"""Id of the channel on which this process sent last."""


class UnixChannel:
    """Channel over a ``SOCK_SEQPACKET`` socket; its messages are packets."""

    __slots__ = ("_owner", "_sleeps", "_sock", "_tries")

    def __init__(self, owner: Descriptor) -> None:
        self._owner = owner
        self._sock = BorrowedSocket(owner)
        self._tries = _TRIES
        self._sleeps = 0

    @classmethod
    def pair(cls) -> tuple[Self, Self]:
        """Return two connected ends."""
        one, other = connected()
        return cls(one), cls(other)

    @classmethod
    def from_fd(cls, fd: int) -> Self:
        """Take over a descriptor."""
        return cls(own(fd))

    @property
    def sock(self) -> socket.socket:
        """Socket of the channel, for event loops."""
        return self._sock

    @property
    def owner(self) -> Descriptor:
        """Owner of the socket's descriptor, for another channel over the same socket."""
        return self._owner

    def send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message.  Wait for room; after a bulky message, wait until it is read."""
        global _last_asked
        _last_asked = id(self)
        if unconfirmed:
            flush_all()
        try:
            bulky = packet.send(self._sock, payload, buffers, ballast=True, wait=False)
        except BlockingIOError:
            if not packet.is_bulky(payload, buffers):
                grow(self._sock)
            bulky = packet.send(self._sock, payload, buffers, ballast=True)
        if bulky:
            wait_until(self._sock.fileno(), select.POLLOUT)

    send_unconfirmed = send_surely = send

    def recv(self, *, passing: bool = False) -> Message:
        """Return the next message; ConnectionClosed at the end."""
        return packet.receive(self._sock, passing=passing)

    def recv_object(self) -> Any:
        """Return the next message, unpickled; ConnectionClosed at the end."""
        message = self._looked_for()
        if message is None:
            return packet.receive_object(self._sock)
        return packet.loads(message)

    def recv_answer(self) -> Message:
        """Receive a message that probably comes soon, as ``recv`` does."""
        message = self._looked_for()
        return packet.receive(self._sock) if message is None else message

    def exchange(
        self, payload: BytesLike, buffers: Sequence[memoryview] = (), *, soon: bool = False
    ) -> Message:
        """Send one message; return the next one."""
        self.send(payload, buffers)
        return self.recv_answer() if soon else self.recv()

    def _looked_for(self) -> Message | None:
        if _last_asked == id(self):
            if not self._sleeps:
                return self._look()
            self._sleeps -= 1
        return None

    def _look(self) -> Message | None:
        """Return the answer if it comes soon, else None."""
        begin = time.perf_counter()
        while (message := self.try_recv()) is None:
            if time.perf_counter() - begin > _LOOK:
                self._tries = 0
                break
        else:
            soon = time.perf_counter() - begin < _SOON
            self._tries = _TRIES if soon else self._tries - 1
        if not self._tries:
            self._tries, self._sleeps = _TRIES, _SLEEPS
        return message

    def try_recv(self) -> Message | None:
        """Return the next message if one is there; ConnectionClosed at the end."""
        try:
            return packet.receive(self._sock, wait=False)
        except BlockingIOError:
            return None

    def poll(self, timeout: float | None) -> bool:
        """Wait until ``recv`` would return or raise at once; False after ``timeout`` seconds."""
        return wait_readable(self._sock.fileno(), timeout)

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._sock.fileno()

    def close(self) -> None:
        """Close this holder's descriptor."""
        try:
            if unconfirmed:
                flush_all()
        finally:
            self._sock.detach()
            self._owner.close()


_COUNTER = os.EFD_CLOEXEC | os.EFD_NONBLOCK | os.EFD_SEMAPHORE


class UnixCounter:
    """Counter over an eventfd in semaphore mode."""

    __slots__ = ("_fd", "_owner")

    def __init__(self, owner: Descriptor) -> None:
        self._owner = owner
        self._fd = owner.fileno()

    @classmethod
    def create(cls, value: int = 0) -> Self:
        """Return a new counter that starts at ``value``."""
        with naming_the_limit("making a counter"):
            return cls(own(os.eventfd(value, _COUNTER)))

    @classmethod
    def from_fd(cls, fd: int) -> Self:
        """Take over a descriptor."""
        return cls(own(fd))

    def add(self, n: int = 1) -> None:
        """Raise the count."""
        try:
            if unconfirmed:
                flush_all()
        finally:  # also after an interrupt, as callers do not add twice
            os.eventfd_write(self._fd, n)

    def take(self, timeout: float | None) -> bool:
        """Lower the count by one once it is above zero; False when ``timeout`` is over."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                os.eventfd_read(self._fd)
                return True
            except BlockingIOError:
                left = None if deadline is None else deadline - time.monotonic()
                if left is not None and left <= 0:
                    return False
                wait_readable(self._fd, left)

    def clear(self) -> int:
        """Set the count to zero and return the count before."""
        taken = 0
        while self.take(0):
            taken += 1
        return taken

    def value(self) -> int:
        """Return the count, as the kernel shows it."""
        with open(f"/proc/self/fdinfo/{self._fd}", "rb") as info:
            for line in info:
                if line.startswith(b"eventfd-count:"):
                    return int(line.split()[1], 16)
        raise OSError(f"descriptor {self._fd} is not an event counter")

    def wait(self, timeout: float | None) -> bool:
        """Wait until the count is above zero, without lowering it."""
        return wait_readable(self._fd, timeout)

    def fileno(self) -> int:
        """Return the eventfd, which is readable while the count is above zero."""
        return self._fd

    def close(self) -> None:
        """Close this holder's descriptor."""
        self._fd = -1
        self._owner.close()


def wait_until(fd: int, events: int, timeout: float | None = None) -> None:
    """Wait for one of ``events`` of ``fd``, or for its end, for at most ``timeout`` seconds."""
    poller = select.poll()
    poller.register(fd, events)
    poller.poll(None if timeout is None else timeout * 1000)


def wait_readable(fd: int, timeout: float | None) -> bool:
    """Wait until ``fd`` is readable or at its end; return False after ``timeout`` seconds."""
    if fd < 0:
        raise OSError("handle is closed")
    poller = select.poll()
    poller.register(fd, select.POLLIN)
    while timeout is not None and timeout > LONGEST_POLL:
        if poller.poll(LONGEST_POLL * 1000):
            return True
        timeout -= LONGEST_POLL
    return bool(poller.poll(None if timeout is None else max(0.0, timeout) * 1000))


_PAUSE = 0.05
"""Seconds until a message that the system refused is tried again."""

_Waiting = tuple[BytesLike, Sequence[memoryview], tuple[int, ...]]


class Outbox:
    """Sending side of a non-blocking socket that the loop already reads.

    Runs on the loop thread.
    """

    def __init__(self, loop: Loop, sock: socket.socket) -> None:
        self._loop = loop
        self._sock = sock
        self._waiting: deque[_Waiting] = deque()
        self._closed = False
        self._stalled = False

    def send(
        self, payload: BytesLike, buffers: Sequence[memoryview] = (), fds: Sequence[int] = ()
    ) -> bool:
        """Send now or as soon as there is room, in order; False if this outbox is closed.

        Takes over ``fds``.  If the peer has ended, the message is lost without an error.
        """
        if self._closed:
            _close_all(fds)
            return False
        try:
            packet.check_buffers(buffers)
            if not self._waiting and self._try(payload, buffers, fds):
                return True
        except BaseException:
            _close_all(fds)
            raise
        self._waiting.append((payload, buffers, tuple(fds)))
        if len(self._waiting) == 1:
            self._watch(self._flush)
        return True

    def recall(self) -> list[BytesLike]:
        """Take back the payloads that have not left."""
        payloads = [payload for payload, _, _ in self._waiting]
        self._drop()
        return payloads

    def close(self) -> None:
        """Drop all messages that have not left.  Call it before the socket is closed."""
        self._closed = True
        self._drop()

    def _drop(self) -> None:
        for _, _, fds in self._waiting:
            _close_all(fds)
        self._waiting.clear()

    def _try(self, payload: BytesLike, buffers: Sequence[memoryview], fds: Sequence[int]) -> bool:
        try:
            packet.send(self._sock, payload, buffers, fds)
        except BlockingIOError:
            return False
        except BrokenPipeError:
            # The peer has ended; the reader of the socket reports that.
            pass
        _close_all(fds)
        return True

    def _flush(self) -> None:
        while self._waiting:
            try:
                if not self._try(*self._waiting[0]):
                    return
            except OSError:
                # No descriptor or no memory is free.  The sender has gone on, so try again later,
                # when other processes may have freed some.
                self._watch(None)
                self._loop.call_later(_PAUSE, self._watch, self._flush)
                if self._stalled:
                    return
                self._stalled = True
                raise
            self._stalled = False
            self._waiting.popleft()
        self._watch(None)

    def _watch(self, callback: Callable[[], None] | None) -> None:
        if not self._closed:
            self._loop.want_write(self._sock.fileno(), callback)


def _close_all(fds: Sequence[int]) -> None:
    for fd in fds:
        os.close(fd)
