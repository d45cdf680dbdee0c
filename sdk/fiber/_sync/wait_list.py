"""Wait list of a condition: a table in shared memory.

Only the holder of the condition's lock changes it::

    next ticket │ two words for the user │ end │ place │ place │ …

A *place* is for one waiting thread.  It has its state, the identity of its process, its ticket, and
a semaphore on which the thread sleeps.  Each change is one store, so a lock holder that dies
between two changes leaves the table consistent.  To leave a place is one store too, without the
lock.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import filterfalse, islice
from typing import Protocol

from fiber._sync import liveness
from fiber._sync.semaphore import SLICE, SharedBlock, make_semaphore, semaphore_at

WAIT_LIST_SIZE = (1 << 16) - 64
"""Bytes of a wait list of a thousand places.  One more step, and each had a segment to itself."""

# Words of 8 bytes
_TICKET = 0
_USERS = 1
_END = 3  # end of the places that were ever taken
_PLACES = range(8, WAIT_LIST_SIZE // 8, 8)
# Words of a place
_STATE = 0
_WHO = 1  # identity of the process; 0 if the place is free
_CAME = 2  # ticket: the order in which the threads came
_HELD = 3  # number of things, set by ``hold``
_BELL = 4
_WAITS, _WAITS_AFAR, _LOST, _NOTIFIED = range(4)


class Raisable(Protocol):
    """Counter that ``reclaim`` can raise."""

    def add(self, n: int) -> None:
        """Raise the count."""


class WaitList:
    """Wait list, as this process uses it."""

    __slots__ = ("__weakref__", "_ring", "_words", "block")

    def __init__(self, block: SharedBlock, ring: Callable[[], None] = lambda: None) -> None:
        self.block = block
        self._ring = ring
        self._words = block.view.cast("q")

    def enter(self, *, afar: bool = False) -> int:
        """Take a place for this thread; ``afar``: it is for a process of another host."""
        words = self._words
        place = self._free_place()
        words[_END] = max(words[_END], place + _PLACES.step)
        make_semaphore(self._bell(place), 0)
        words[place] = _WAITS_AFAR if afar else _WAITS
        words[_TICKET] = words[place + _CAME] = words[_TICKET] + 1
        words[place + _HELD] = 0
        words[place + _WHO] = liveness.own_identity()  # last: from here on it is taken
        return place

    def sleep(self, place: int, timeout: float | None) -> None:
        """Wait without the lock until ``place`` is notified, at most ``timeout`` seconds."""
        bell = semaphore_at(self._bell(place))
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self.is_notified(place):
            left = SLICE if deadline is None else min(SLICE, deadline - time.monotonic())
            if bell.acquire(True, left) or left <= 0:
                return

    def is_notified(self, place: int) -> bool:
        """Tell whether the waiter at ``place`` was notified."""
        return self._words[place] == _NOTIFIED

    def leave(self, place: int) -> bool:
        """Free a place; return whether it was notified."""
        notified = self.is_notified(place)
        self._words[place + _WHO] = 0
        return notified

    def dismiss(self, place: int) -> None:
        """Free a place that was kept over several waits."""
        self._words[place + _WHO] = 0

    def lose(self, place: int) -> None:
        """Note that the waiter at ``place``, on another host, has died."""
        self._words[place] = _LOST

    def notify(self, n: int) -> None:
        """Wake the ``n`` threads that have waited longest.  Skip dead ones."""
        words = self._words
        waiting = [place for place in self._used() if words[place] in (_WAITS, _WAITS_AFAR)]
        if n < len(waiting):
            waiting.sort(key=lambda place: words[place + _CAME])
            waiting = list(islice(filterfalse(self._is_dead, waiting), n))
        rings = _WAITS_AFAR in [words[place] for place in waiting]
        for place in waiting:
            words[place] = _NOTIFIED
            semaphore_at(self._bell(place)).release()
        if rings:
            self._ring()

    def waiters(self) -> int:
        """Return the number of waiters."""
        return sum(self._words[place] in (_WAITS, _WAITS_AFAR) for place in self._used())

    def remove_dead(self) -> int:
        """Free the places of dead waiters; return their number."""
        dead = [place for place in self._used() if self._is_dead(place)]
        for place in dead:
            self._words[place + _WHO] = 0
        return len(dead)

    def hold(self, place: int, number: int) -> None:
        """Note how many things the process at ``place`` has.  Needs no lock."""
        self._words[place + _HELD] = number

    def tally(self, place: int, held: int, total: int) -> None:
        """Note how many things the process at ``place`` has, and set the user's second word."""
        self._words[place + _HELD] = held
        self.set(1, total)

    def held(self) -> int:
        """Return the number of things that the processes of all places have."""
        return sum(self._words[place + _HELD] for place in self._used())

    def reclaim(self, counter: Raisable) -> int:
        """Free the places of dead processes, add their things to ``counter``, and count these."""
        dead = [place for place in self._used() if self._is_dead(place)]
        total = 0
        for place in dead:
            if held := self._words[place + _HELD]:
                counter.add(held)  # first: after a death here they are added twice, not never
                total += held
            self._words[place + _WHO] = 0
        return total

    def get(self, number: int) -> int:
        """Return one of the user's two words."""
        return self._words[_USERS + number]

    def set(self, number: int, value: int) -> None:
        """Set one of the user's two words."""
        self._words[_USERS + number] = value

    def _free_place(self) -> int:
        for is_free in (self._is_unused, self._is_dead):
            for place in filter(is_free, _PLACES):
                return place
        raise OSError(f"more than {len(_PLACES)} threads wait at one condition")

    def _bell(self, place: int) -> int:
        return self.block.address + 8 * (place + _BELL)

    def _is_unused(self, place: int) -> bool:
        return not self._words[place + _WHO]

    def _used(self) -> Iterator[int]:
        places = range(_PLACES.start, self._words[_END], _PLACES.step)
        return (place for place in places if self._words[place + _WHO])

    def _is_dead(self, place: int) -> bool:
        words = self._words
        return words[place] == _LOST or not liveness.is_alive(words[place + _WHO])
