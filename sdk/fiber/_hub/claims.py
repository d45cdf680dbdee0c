"""Places of a bounded queue that processes have taken for items which they have not sent yet.

The place of an item that was sent comes back when the item is received.  Until it is sent, the
process that put it has it in memory, and the item dies with that process.  So each process keeps
the number of its unsent items in a table in shared memory, where other processes find it after its
death.
"""

from __future__ import annotations

import os
import time
import weakref
from contextlib import suppress
from typing import Any

from fiber._hub import shared_semaphores, wait_lists
from fiber._hub.client import Unreachable
from fiber._hub.shared_semaphores import AnySemaphore
from fiber._hub.wait_lists import AnyWaitList
from fiber._sync.semaphore import COUNTING
from fiber._transport.base import SharedCounter

_LOOK = 0.2
"""Seconds between two looks for dead processes."""


class Claims:
    """The table, and the claims of this process.  Any thread."""

    def __init__(self) -> None:
        self.__setstate__((wait_lists.create(), shared_semaphores.create(COUNTING, 1, 1)))

    def __getstate__(self) -> tuple[AnyWaitList, AnySemaphore]:
        return self._table, self._lock

    def __setstate__(self, state: tuple[Any, AnySemaphore]) -> None:
        self._table, self._lock = state
        self._next_look = 0.0
        self._begin()

    def _begin(self) -> None:
        self._pid = os.getpid()
        self._own: list[None] = []
        self._entry: list[Any] = []

    def add(self) -> None:
        """Note that this process has taken a place."""
        if self._pid != os.getpid():  # a fork: what its parent has is not its own
            self._begin()
        self._own.append(None)
        self._tell()

    def drop(self) -> None:
        """Note that this process has one place less: the item was sent, or the place given back."""
        try:
            self._own.pop()
        except IndexError:  # interrupted before it was noted
            return
        self._tell()

    def recover(self, counter: SharedCounter) -> int:
        """Give the places of dead processes back to ``counter``; return how many there were."""
        now = time.monotonic()
        if now < self._next_look:
            return 0
        self._next_look = now + _LOOK
        self._lock.acquire()
        try:
            return int(self._table.reclaim(counter))
        finally:
            self._lock.release()

    def _tell(self) -> None:
        if not self._entry:
            self._enter()
        if not self._entry:
            return
        entry, own = self._entry[0], self._own
        try:
            while True:
                count = len(own)
                self._table.hold(entry, count)
                if count == len(own):  # else another thread may have told the old number last
                    return
        except (OSError, Unreachable):
            pass  # the hub is gone, and the queue with it

    def _enter(self) -> None:
        self._lock.acquire()
        try:
            with suppress(OSError):  # there are too many processes: this one is not watched
                self._entry.append(self._table.enter())
                weakref.finalize(self, self._table.dismiss, self._entry[-1])
        finally:
            self._lock.release()
