"""Wait list of a condition of this host, on the side of its hub."""

from __future__ import annotations

from fiber._hub.doorbell import Doorbell
from fiber._hub.hosted import Waiter
from fiber._hub.protocol import Status
from fiber._sync.semaphore import Block
from fiber._sync.wait_list import WaitList
from fiber._transport.loop import Loop

_LOOK = 1.0
"""Seconds until it looks for itself whether somebody was notified: who rings may die before."""


class HostedWaitList:
    """Wait list that the hub serves.  Runs on the loop's thread."""

    def __init__(self, loop: Loop, doorbell: Doorbell, block: Block) -> None:
        self._loop = loop
        self._doorbell = doorbell
        self.places = WaitList(block, self._serve)
        self._sleepers: dict[Waiter, int] = {}
        self._is_looking = False

    def sleep(self, waiter: Waiter, place: int) -> None:
        """Answer once that place is notified."""
        if not self._sleepers:
            self._doorbell.listen(self._serve)
        self._sleepers[waiter] = place
        self._serve()
        if self._sleepers and not self._is_looking:
            self._is_looking = True
            self._loop.call_later(_LOOK, self._look)

    def withdraw(self, waiter: Waiter) -> bool:
        """Stop waiting; return False if ``waiter`` did not wait."""
        return self._sleepers.pop(waiter, None) is not None

    def close(self) -> None:
        """Stop serving it: no process of another host uses it."""
        self._sleepers.clear()
        self._doorbell.forget(self._serve)

    def _serve(self) -> None:
        for waiter, place in list(self._sleepers.items()):
            if self.places.is_notified(place):
                del self._sleepers[waiter]
                waiter.answer(Status.OK)
        if not self._sleepers:
            self._doorbell.forget(self._serve)

    def _look(self) -> None:
        self._is_looking = False
        self._serve()
        if self._sleepers:
            self._is_looking = True
            self._loop.call_later(_LOOK, self._look)
