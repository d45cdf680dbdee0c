"""Channels and counters of this host with many holders, of which some can wait and some cannot."""

from __future__ import annotations

import os
import select
import socket
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, TypeVar

from fiber._transport.channels import Claimant, UnixChannel, UnixCounter, grow
from fiber._transport.loop import LONGEST_POLL
from fiber._wire import packet
from fiber._wire.descriptor import Descriptor
from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import Message

_Socket = TypeVar("_Socket", bound=socket.socket)


class QuietSocket(socket.socket):
    """A socket that closes without a warning when nobody holds it any more.

    Queues and connections may be forgotten, as in multiprocessing, and garbage in cycles ends in
    any order: the socket perhaps before whoever would close it.
    """

    __slots__ = ()

    def __del__(self) -> None:
        self._real_close()  # type: ignore[attr-defined]  # ``close`` needs a finished ``__init__``


def without_timeout(sock: _Socket) -> _Socket:
    """Free ``sock`` of the program's default timeout, which is for the user's own sockets."""
    if sock.gettimeout() is not None:
        sock.settimeout(None)
    return sock


class LocalChannel(UnixChannel):
    """A channel that can also be asked not to wait, whoever else uses the same end."""

    __slots__ = ()

    can_try_send = True

    def post(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message, waiting for room but not, as ``send``, until a bulky one is read."""
        packet.send(self._sock, payload, buffers, ballast=True)

    def try_send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send one message if there is room for it now."""
        # The descriptor's own mode will not do: O_NONBLOCK is shared by all that hold the socket.
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

    def recv_counting(self, counter: LocalCounter, *, wait: bool) -> Message | None:
        """Receive a message, raising ``counter`` in the same step; None if there is none."""
        try:
            return packet.receive(self._sock, wait=wait, then=counter.raising)
        except BlockingIOError:
            return None

    @property
    def room_events(self) -> int:
        """Event of ``fileno()`` after which ``try_send`` is worth another try."""
        return select.POLLOUT


class LocalCounter(UnixCounter):
    """A counter whose every change can be waited for."""

    __slots__ = ("raising",)

    def __init__(self, owner: Descriptor) -> None:
        super().__init__(owner)
        self.raising = partial(os.eventfd_write, owner.fileno(), 1)
        """``add``, as a function of C."""

    def claim(self, timeout: float | None, taken: list[Any], claims: Claimant) -> bool:
        """Take one as ``take`` does, and record it in ``claims``."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            claims.add()  # first: who dies in between has noted one too many, not one too few
            try:
                if self.take(0, taken):
                    return True
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
            # Edge-triggered: each write wakes every waiter once, and none has to consume it.
            poller.register(self._fd, select.EPOLLIN | select.EPOLLET)
            while self.value() == since:
                left = None if deadline is None else deadline - time.monotonic()
                if left is not None and left <= 0:
                    return False
                poller.poll(None if left is None else min(left, LONGEST_POLL))
        return True
