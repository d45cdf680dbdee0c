"""Reading tasks from an iterator no faster than they are worked off, so that memory stays flat.

A bounded queue between the thread that reads (the caller's own, or a feeder's) and the executor.
The bound is kept by credit: the executor grants as many items as it wants to hold, the reader waits
at a semaphore (a SimpleQueue, whose entries are the grants) when it has used them up.
"""

from __future__ import annotations

import contextlib
import itertools
import queue
import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from fiber._engine.chunks import Pace
from fiber._runtime.latch import check_may_wait
from fiber._transport.loop import DOZE

AHEAD = 3
"""Messages worth of tasks that are read ahead for each worker."""


class InputStream:
    """The input of one job.  ``limit``: tasks that may be read and not yet consumed by the user.

    ``consumed`` says how many were.  ``notify`` is called, on the reading thread or the user's,
    when there is something that the executor waits for: input, or room below the limit.
    """

    def __init__(
        self,
        unit: int,
        notify: Callable[[], None],
        limit: int | None = None,
        consumed: Callable[[], int] = lambda: 0,
    ) -> None:
        self.ended = False
        """True once reading has ended."""
        self._unit = unit
        self._limit = None if limit is None else max(limit, unit)
        self._consumed = consumed
        self._notify = notify
        self._items: deque[Any] = deque()
        self._credit: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._granted = 0
        self._taken = 0
        self._awaited = True
        self._refused = 0  # how often the executor has looked for room
        self._asked = 0  # of these, the last time that it found some or was asked to look again

    # The reading thread

    def read(self, iterable: Iterable[Any]) -> None:
        """Read it all; raises what the iterable raises."""
        check_may_wait()
        iterator = iter(iterable)
        items, unit = self._items, self._unit
        chunk: list[Any] = []
        while (credit := self._next_credit()) > 0:
            left = credit
            for item in itertools.islice(iterator, credit):
                left -= 1
                chunk.append(item)
                if len(chunk) == unit:
                    items.extend(chunk)
                    chunk.clear()
                    if self._awaited:
                        self._awaited = False
                        self._notify()
                if self.ended:
                    return
            if left:
                items.extend(chunk)
                return

    def _next_credit(self) -> int:
        while True:
            with contextlib.suppress(queue.Empty):
                return self._credit.get(timeout=DOZE)  # a signal may be slept over

    def read_on_thread(
        self, iterable: Iterable[Any], finish: Callable[[BaseException | None], None]
    ) -> None:
        """Read it all on a thread of its own, and ``finish`` with what was raised, if anything."""

        def run() -> None:
            error = None
            try:
                self.read(iterable)
            except BaseException as raised:
                error = raised
            finish(error)

        try:
            threading.Thread(target=run, name="fiber-pool-feeder", daemon=True).start()
        except RuntimeError as error:  # the system has no room for it
            finish(error)

    # The user's thread

    def ask(self) -> None:
        """The user took results: notify, if there was no room before.

        Only notes that it has, when it has: whoever is interrupted asks again the next time.
        """
        refused = self._refused
        if self._asked < refused:
            self._notify()
            self._asked = refused

    # The executor

    def take(self) -> list[Any]:
        """Take the items that were read."""
        items = self._items
        taken = [items.popleft() for _ in range(len(items))]
        self._taken += len(taken)
        return taken

    def await_input(self) -> None:
        """Notify when there is something.  Take once more after this: it may have come before."""
        self._awaited = True

    def grant(self, waiting: int, workers: int, pace: Pace, target: float) -> None:
        """Let the reader go on if little is left: ``waiting`` tasks that nobody has yet."""
        bound = AHEAD * max(workers, 1) * max(pace.message_size(target), self._unit)
        ahead = waiting + self._granted - self._taken
        if self.ended or 2 * ahead > bound:
            return
        units = -(-(bound - ahead) // self._unit)
        if self._limit is not None:
            self._refused += 1  # first: who consumes after the count asks
            units = min(units, self._room(self._limit) // self._unit)
        if units:
            self._asked = self._refused
            self._granted += units * self._unit
            self._credit.put(units * self._unit)

    def _room(self, limit: int) -> int:
        return limit - (self._granted - self._consumed())

    def lift_limit(self) -> None:
        """Read without a limit: a caller that waits for all results consumes none."""
        self._limit = None

    def end(self) -> None:
        """Read no more."""
        self.ended = True
        self._credit.put(0)
