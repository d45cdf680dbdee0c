"""An event loop whose clock stands still while anything happens and leaps over the rest.

A minute in which nothing happens takes no time, so tests of timeouts, back-off and resync need no
sleep.  Real sockets within the process work: what was sent is on its way in the kernel for less
than ``IN_FLIGHT``, and only when nothing came for that long does the clock leap to the next timer.
"""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar("T")

IN_FLIGHT = 0.002
STUCK = 5.0


class _Selector(selectors.EpollSelector):
    now = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if ready or (timeout is not None and timeout <= 0):
            return ready
        ready = super().select(IN_FLIGHT)
        if ready:
            return ready
        if timeout is None:
            ready = super().select(STUCK)
            if not ready:
                raise RuntimeError("nothing will ever happen in this loop: no timer, no data")
            return ready
        self.now += timeout
        return []


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
