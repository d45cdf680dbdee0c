"""Channels and counters of this host that several processes hold."""

from __future__ import annotations

import fcntl
import os
import select
import socket
import termios
import time
from array import array
from collections.abc import Sequence
from functools import partial
from typing import Any, TypeVar

from fiber._transport.channels import (
    Claimant,
    UnixChannel,
    UnixCounter,
    grow,
)
from fiber._transport.loop import LONGEST_POLL
from fiber._unconfirmed import flush_all, unconfirmed
from fiber._wire import packet
from fiber._wire.descriptor import Descriptor
from fiber._wire.memory_files import BytesLike

_Socket = TypeVar("_Socket", bound=socket.socket)


class QuietSocket(socket.socket):
    """Socket that is closed without a warning when its last reference is gone.

    As in multiprocessing, a program need not close queues and connections.  The garbage collector
    may end a socket before the object that would close it.
    """

    __slots__ = ()

    def __del__(self) -> None:
        self._real_close()  # type: ignore[attr-defined]  # ``close`` needs a finished ``__init__``


def without_timeout(sock: _Socket) -> _Socket:
    """Remove the program's default timeout, which is for the user's sockets, from ``sock``."""
    if sock.gettimeout() is not None:
        sock.settimeout(None)
    return sock


class LocalChannel(UnixChannel):
    """Channel that can send and receive without waiting, also if others share its end."""

    __slots__ = ()

    def try_send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send one message if there is room for it now."""
        if unconfirmed:
            flush_all()
        # O_NONBLOCK would not do: all holders of the socket share it.
        try:
            packet.send(self._sock, payload, buffers, ballast=True, wait=False)
            return True
        except BlockingIOError:
            if packet.is_bulky(payload, buffers):
                return False
            grow(self._sock)
        try:
            packet.send(self._sock, payload, buffers, ballast=True, wait=False)
        except BlockingIOError:
            return False
        return True

    def is_half_full(self) -> bool:
        """Return whether unread messages take half of the room or more."""
        unread = array("i", [0])
        fcntl.ioctl(self._sock, termios.TIOCOUTQ, unread)
        return unread[0] >= self._sock.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) // 2

    def send_within(self, payload: BytesLike, seconds: float) -> bool:
        """Send one message if there is room for it within ``seconds``."""
        deadline = time.monotonic() + seconds
        while not self.try_send(payload):
            poller = select.poll()
            poller.register(self.fileno(), self.room_events)
            left = deadline - time.monotonic()
            if left <= 0 or not poller.poll(left * 1000):
                return False
        return True

    def all_taken_within(self, seconds: float) -> bool:
        """Return True: what was sent can be received."""
        return True

    def confirm(self) -> None:
        """Do nothing: the object is on this host."""

    @property
    def room_events(self) -> int:
        """Event of ``fileno()`` after which ``try_send`` may succeed."""
        return select.POLLOUT


class LocalCounter(UnixCounter):
    """Counter that also lets callers wait for each change."""

    __slots__ = ("raising",)

    def __init__(self, owner: Descriptor) -> None:
        super().__init__(owner)
        self.raising = partial(os.eventfd_write, owner.fileno(), 1)
        """``add(1)``, as a C function."""

    def lower(self, n: int) -> None:
        """Lower the count by ``n``, or to zero."""
        for _ in range(n):
            self.take(0)

    def claim(self, timeout: float | None, taken: list[Any], claims: Claimant) -> bool:
        """Take one as ``take`` does, and record it in ``claims``."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            claims.add()  # first: after a death in between there is a note too many, not too few
            try:
                taken.extend(map(os.eventfd_read, (self._fd,)))  # no handler runs in between
                return True
            except BlockingIOError:
                pass
            finally:
                if not taken:
                    claims.drop()
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0:
                return False
            self.wait(left)

    def changed(self, since: int, timeout: float | None) -> bool:
        """Wait until the count is not ``since``; False when ``timeout`` is over."""
        deadline = None if timeout is None else time.monotonic() + timeout
        with select.epoll() as poller:
            # Edge-triggered: each write wakes every waiter once, and no waiter has to consume it.
            poller.register(self._fd, select.EPOLLIN | select.EPOLLET)
            while self.value() == since:
                left = None if deadline is None else deadline - time.monotonic()
                if left is not None and left <= 0:
                    return False
                poller.poll(None if left is None else min(left, LONGEST_POLL))
        return True
