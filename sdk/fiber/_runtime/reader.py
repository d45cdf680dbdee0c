"""Reading tasks from an iterator no faster than they are worked off, so that memory stays flat.

The reading thread (the caller's own, or a feeder's) appends to ``inbox``, which needs no lock; the
exchange moves what is there to the ledger whenever it looks for work, and lets the reader go on
when little is left.  Nobody waits for the other: a reader that finds workers hungry has work
assigned at once, and whoever leaves workers hungry looks into the inbox after saying so.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import Any

from fiber._engine.ledger import Job, Ledger
from fiber._runtime.shield import unbroken

AHEAD = 3
"""Messages worth of tasks that are read ahead for each worker."""


FEW = 16


class Reader:
    """Feeds one job.  ``limit``: tasks that may be read and not yet consumed by the user."""

    def __init__(self, job: Job, lock: threading.Lock, limit: int | None = None) -> None:
        self.inbox: deque[Any] = deque()
        self.limit = None if limit is None else max(limit, job.unit)
        self.stopped = False
        self._job = job
        self._lock = lock
        self._bound = AHEAD * job.unit
        self._read = 0
        self._consumed = 0
        self._blocked = False
        self._gate = threading.Lock()
        self._gate.acquire()

    # The reading thread

    def read(self, iterable: Iterable[Any], hungry: Callable[[], None]) -> None:
        """Read it all; raises what the iterable raises.  ``hungry`` is called after each chunk."""
        unit = self._job.unit
        iterator = iter(iterable)
        if unit == 1:
            chunks: Iterator[Sequence[Any]] = zip(iterator)
        else:
            chunks = iter(lambda: list(islice(iterator, unit)), [])
        # A reader that nobody holds to account looks around after a few only.
        often = 1 if self.limit is not None else max(FEW // unit, 1)
        for count, chunk in enumerate(chunks, 1):
            self.inbox.extend(chunk)
            self._read += len(chunk)
            hungry()
            if count % often == 0 and self._full():
                self._wait()
            if self.stopped:
                return

    def _full(self) -> bool:
        ahead = len(self.inbox) + len(self._job.waiting)
        return ahead >= self._bound or (
            self.limit is not None and self._read - self._consumed >= self.limit
        )

    def _wait(self) -> None:
        with unbroken, self._lock:
            # ``consume`` counts first and looks for this then: one of both sees the other.
            self._blocked = True
            if not self._full() or self.stopped:
                self._blocked = False
                return
        self._gate.acquire()

    # Others

    def absorb(self, ledger: Ledger) -> None:
        """Move what was read to the ledger.  Lock held."""
        inbox = self.inbox
        if inbox:
            ledger.feed(self._job, [inbox.popleft() for _ in range(len(inbox))])

    def make_room(self, workers: int) -> None:
        """Let the reader go on if little is left.  Lock held."""
        message = self._job.pace.message_size(self._job.target)
        self._bound = AHEAD * max(workers, 1) * max(message, self._job.unit)
        self._release_if_room()

    def _has_room(self) -> bool:
        ahead = len(self.inbox) + len(self._job.waiting)
        return self.stopped or (
            2 * ahead <= self._bound
            and (self.limit is None or self._read - self._consumed < self.limit)
        )

    def consume(self, tasks: int) -> None:
        """The user took the results of so many tasks."""
        self._consumed += tasks
        if self._blocked:
            with unbroken, self._lock:
                self._release_if_room()

    def _release_if_room(self) -> None:
        if self._blocked and self._has_room():
            self._blocked = False
            self._gate.release()

    def unbind(self) -> None:
        """Whoever waits for all to be done cannot consume.  Lock held."""
        self.limit = None
        self._release_if_room()

    def stop(self) -> None:
        """Read no more.  Lock held."""
        self.stopped = True
        self._release_if_room()
