"""Wait list of a condition: a table in shared memory.  Only the holder of the condition's lock
changes it.

::

    next ticket │ two words of the user's │ end │ place │ place │ …

A *place* is for one thread that waits: what became of it, whose it is, when it came, and a
semaphore on which it sleeps.  Each change is one store, so a holder that dies between two leaves
the table in order.  To leave a place is one store, too, for which nobody needs the lock.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import filterfalse, islice
from typing import Protocol

from fiber._sync import liveness
from fiber._sync.semaphore import SLICE, SharedBlock, make_semaphore, semaphore_at

WAIT_LIST_SIZE = 1 << 15

# Words of 8 bytes
_TICKET = 0
_USERS = 1
_END = 3  # of the places that anybody ever had
_PLACES = range(8, WAIT_LIST_SIZE // 8, 8)
# Of a place
_STATE = 0
_WHO = 1  # the process, or 0: it is free
_CAME = 2
_HELD = 3  # what ``hold`` was told
_BELL = 4
_WAITS, _WAITS_AFAR, _LOST, _NOTIFIED = range(4)


class Raisable(Protocol):
    """A count of free things."""

    def add(self, n: int) -> None:
        """Raise the count."""


class WaitList:
    """Wait list on the side of this process."""

    __slots__ = ("__weakref__", "_ring", "_words", "block")

    def __init__(self, block: SharedBlock, ring: Callable[[], None] = lambda: None) -> None:
        self.block = block
        self._ring = ring
        self._words = block.view.cast("q")

    def enter(self, *, afar: bool = False) -> int:
        """A place for this thread.  ``afar``: the hub's, for one of another host."""
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
        """Wait until that place is notified, for ``timeout`` seconds at most.  Without the lock."""
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
        """Free a place that was taken for longer."""
        self._words[place + _WHO] = 0

    def lose(self, place: int) -> None:
        """Note that the waiter at ``place``, on another host, has died."""
        self._words[place] = _LOST

    def notify(self, n: int) -> None:
        """Wake the ``n`` that have waited for longest; who died meanwhile is passed over."""
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

    def bury(self) -> int:
        """Return how many waiters died since the last call."""
        dead = [place for place in self._used() if self._is_dead(place)]
        for place in dead:
            self._words[place + _WHO] = 0
        return len(dead)

    def hold(self, place: int, number: int) -> None:
        """Note how many things the owner of a place has.  Without the lock."""
        self._words[place + _HELD] = number

    def tally(self, place: int, held: int, total: int) -> None:
        """Note how many things the owner of a place has, and set the user's second word."""
        self._words[place + _HELD] = held
        self.set(1, total)

    def held(self) -> int:
        """Return the number of things that all owners of places have."""
        return sum(self._words[place + _HELD] for place in self._used())

    def reclaim(self, counter: Raisable) -> int:
        """Free the places of dead processes; give ``counter`` what they had and return it."""
        dead = [place for place in self._used() if self._is_dead(place)]
        total = 0
        for place in dead:
            if held := self._words[place + _HELD]:
                counter.add(held)  # first: after a death here it is given back twice, not never
                total += held
            self._words[place + _WHO] = 0
        return total

    def get(self, number: int) -> int:
        """Return one of the user's two words."""
        return self._words[_USERS + number]

    def set(self, number: int, value: int) -> None:
        """Set it."""
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
