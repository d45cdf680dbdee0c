"""An event loop whose clock stands still while anything happens and leaps over the rest.

A minute in which nothing happens takes no time, so tests of timeouts, back-off and resync need no
sleep.  Real sockets within the process work: the clock leaps to the next timer only when nothing
is to be read and no socket has sent what the other side's kernel has not confirmed.
"""

from __future__ import annotations

import asyncio
import fcntl
import selectors
import struct
import termios
from collections.abc import Coroutine
from typing import Any, TypeVar

from patience import PATIENCE

T = TypeVar("T")

IN_FLIGHT = 0.001
"""Seconds within which sent bytes, or their confirmation, arrive."""
STUCK = PATIENCE


class _Selector(selectors.EpollSelector):
    now = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if ready or (timeout is not None and timeout <= 0):
            return ready
        if self._in_flight() and (ready := super().select(IN_FLIGHT)):
            return ready
        if timeout is None:
            ready = super().select(STUCK)
            if not ready:
                raise RuntimeError("nothing will ever happen in this loop: no timer, no data")
            return ready
        self.now += timeout
        return []

    def _in_flight(self) -> bool:
        keys = self.get_map().values()
        return any(key.events & selectors.EVENT_WRITE or _unconfirmed(key.fd) for key in keys)


def _unconfirmed(descriptor: int) -> int:
    try:
        found = fcntl.ioctl(descriptor, termios.TIOCOUTQ, b"\0\0\0\0")
    except OSError:
        return 0  # one that listens, or no socket
    return int(struct.unpack("i", found)[0])


class VirtualLoop(asyncio.SelectorEventLoop):
    """The loop; its time begins at 0."""

    def __init__(self) -> None:
        self._virtual = _Selector()
        super().__init__(self._virtual)

    def time(self) -> float:
        return self._virtual.now


def run(main: Coroutine[Any, Any, T]) -> T:
    """Like asyncio.run, in virtual time."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(main)
