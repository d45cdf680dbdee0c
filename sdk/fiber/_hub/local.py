"""Channels and counters of this host with many holders, of which some can wait and some cannot."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

from fiber._transport.loop import LONGEST_POLL
from fiber._transport.unix import BorrowedSocket, UnixChannel, UnixCounter
from fiber._wire import packet
from fiber._wire.descriptor import Descriptor
from fiber._wire.packet import BytesLike

_Socket = TypeVar("_Socket", bound=socket.socket)

_DONTWAIT = int(socket.MSG_DONTWAIT)  # the enum member is slow to combine


class QuietSocket(socket.socket):
    """A socket that closes without a warning when nobody holds it any more.

    Queues and connections may be forgotten, as in multiprocessing, and garbage in cycles ends in
    any order: the socket perhaps before whoever would close it.
    """

    __slots__ = ()

    def __del__(self) -> None:
        self._real_close()  # type: ignore[attr-defined]  # ``close`` needs a finished ``__init__``


class NonWaitingSocket(BorrowedSocket):
    """One whose sends never wait.

    The descriptor's own mode will not do: O_NONBLOCK is shared by all that hold the socket.
    """

    __slots__ = ()

    def send(self, data: Any, flags: int = 0, /) -> int:
        """Send or raise BlockingIOError."""
        return super().send(data, flags | _DONTWAIT)

    def sendmsg(
        self,
        buffers: Iterable[Any],
        ancdata: Iterable[Any] = (),
        flags: int = 0,
        address: Any = None,
        /,
    ) -> int:
        """Send or raise BlockingIOError."""
        return super().sendmsg(buffers, ancdata, flags | _DONTWAIT)


def without_timeout(sock: _Socket) -> _Socket:
    """Free ``sock`` of the program's default timeout, which is for the user's own sockets."""
    if sock.gettimeout() is not None:
        sock.settimeout(None)
    return sock


class LocalChannel(UnixChannel):
    """A channel that can also be asked not to wait, whoever else uses the same end."""

    __slots__ = ("_non_waiting",)

    can_try_send = True

    def __init__(self, owner: Descriptor) -> None:
        super().__init__(owner)
        self._non_waiting: NonWaitingSocket | None = None

    def post(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message, waiting for room but not, as ``send``, until a bulky one is read."""
        packet.send(self._sock, payload, buffers, ballast=True)

    def try_send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send one message if there is room for it now."""
        sock = self._non_waiting
        if sock is None:
            sock = self._non_waiting = NonWaitingSocket(self._owner)
        try:
            packet.send(sock, payload, buffers, ballast=True)
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Close this holder's descriptor."""
        non_waiting, self._non_waiting = self._non_waiting, None
        if non_waiting is not None:
            non_waiting.detach()  # the same descriptor
        super().close()


class LocalCounter(UnixCounter):
    """A counter whose every change can be waited for."""

    __slots__ = ()

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
