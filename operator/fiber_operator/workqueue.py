"""Work queue of pools: each pool waits in it at most once and is reconciled by one task at a time.

Events that arrive during a reconcile cause one more reconcile afterwards.  Three rules space the
reconciles of one pool:

* after a reconcile the pool rests for as long as the reconcile's result says;
* events of pods wait until ``GAP`` seconds after the last reconcile, so that a thousand events of a
  growing pool cause a few reconciles;
* a failed reconcile is repeated after a delay that doubles each time.

While a pool changes, it is also reconciled when the events of its pods cease, even if it has not
rested: the status then shows the result at once.  The next rest is longer by the part that was
skipped, and is not shortened again.

A pool in trouble does not hold up others.  A reconcile that takes longer than ``LONG`` seconds, for
example because a webhook hangs, passes its place to the next pool.  Pools whose last reconcile
failed let others go first and never occupy all places.

Namespaces take turns: the next pool comes from the namespace with the fewest running reconciles,
and among those from the one whose last reconcile began first.  A namespace without a running
reconcile gets an extra place, so that it does not wait for others.

The queue runs in one event loop and uses that loop's clock; it is not thread-safe.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
import logging
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from fiber_operator.logs import about

log = logging.getLogger(__name__)


GAP = 0.5
"""Seconds between reconciles that only pods' events asked for: they show in the status within a
second, and a pool that grows by fifty pods a second costs two lists a second."""
LULL = 0.15
"""Seconds without an event after which the events of a pool have ceased."""
FIRST_BACKOFF = 0.5
LONGEST_BACKOFF = 30.0
LONGEST_BLOCK = 1.0
"""Seconds for which a failure keeps even new events out."""

LONG = 2.0
"""Seconds after which a reconcile counts as waiting and not as working."""
YIELD = 10.0
"""Seconds by which a pool whose last reconcile failed lets others go first."""
CROWD = 4
"""Reconciles under way at most, those that wait included, for each that may work."""


_Heap = list[tuple[float, int, "Key"]]
_Heaps = dict[str, _Heap]
"""Heaps by namespace."""


class Key(NamedTuple):
    """Namespace and name of a pool.  A later pool may have the same name."""

    namespace: str
    name: str


@dataclass(frozen=True)
class Result:
    """Result of one reconcile of a pool."""

    requeue_after: float | None = None
    """Reconcile again after this many seconds even without an event."""
    rest: float = 0.0
    """Do not reconcile again for this many seconds in any case."""
    lull: bool = False
    """Reconcile again, even before it has rested, when events of its pods have come and cease."""
    failed: bool = False
    """Reconcile again soon, and later each time."""
    forget: bool = False
    """True if the pool does not exist."""


@dataclass
class _Entry:
    due: float | None = None
    """Time at which it is due; None: it does not wait."""
    blocked: float = -1e9
    """Earliest time of the next reconcile."""
    rested: float = -1e9
    """End of the pool's rest, when events of its pods bring a reconcile."""
    lull: bool = False
    """True if they bring it before the end of the rest, once they cease."""
    limit: float | None = None
    """Latest time of a reconcile that waits for the events to cease; None if none waits."""
    owed: float = 0.0
    """Seconds by which its last rest was shortened."""
    failures: int = 0
    running: float | None = None
    """Time at which its present reconcile began; None while none runs."""
    rush: bool = False
    """True if it was added urgently while it ran."""
    order: int = -1
    """Order of its valid place in the heap.  Places with other orders are void."""


@dataclass(frozen=True)
class QueueStatistics:
    """The queue at one moment."""

    waiting: int
    """Pools that are due and wait for a free task."""
    running: int
    known: int
    longest_wait: float
    """Seconds for which the pool that waits longest is overdue."""
    longest_run: float
    """Seconds that the longest reconcile takes so far."""
    since_last_end: float
    """Seconds since a reconcile ended, or since the queue was made."""


class WorkQueue:
    """Reconciles each pool in its time.  ``reconcile`` is awaited once at a time for a pool."""

    def __init__(self, reconcile: Callable[[Key], Awaitable[Result]], *, concurrency: int) -> None:
        self._reconcile = reconcile
        self._concurrency = concurrency
        self._entries: dict[Key, _Entry] = {}
        self._well: _Heaps = {}
        self._failing: _Heaps = {}
        self._last_begun: dict[str, int] = {}
        """Order of the last reconcile of each namespace."""
        self._orders = itertools.count()
        self._tasks: dict[asyncio.Task[None], tuple[float, str]] = {}
        """Reconciles under way, the oldest first: since when, and the namespace."""
        self._wake = asyncio.Event()
        self._last_end = self._now()

    def add(self, key: Key, *, delay: float = 0.0, urgent: bool = False) -> None:
        """Reconcile ``key``: after ``delay`` seconds, ``GAP`` after its last, or if urgent now.

        A reconcile that it waits for already is brought forward if need be, never put off.
        """
        now = self._now()
        entry = self._entries.setdefault(key, _Entry())
        if not urgent and entry.lull and entry.running is None:
            self._await_lull(key, entry, now + delay)
            return
        due = max(now + delay, entry.blocked)
        if not urgent:
            due = max(due, entry.rested)
        elif entry.running is not None:
            entry.rush = True
        if entry.limit is not None:
            entry.limit = min(entry.limit, due)
        if entry.due is None or due < entry.due:
            self._place(key, entry, due)

    async def run(self) -> None:
        """Reconcile what is due until cancelled; then end what is under way."""
        try:
            while True:
                self._wake.clear()
                self._start_due()
                await self._sleep()
        finally:
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)

    async def drain(self, grace: float) -> None:
        """Start no further reconcile, and give those under way ``grace`` seconds to end."""
        self._concurrency = 0
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=grace)

    def statistics(self) -> QueueStatistics:
        """The queue now."""
        now = self._now()
        overdue = [
            now - entry.due
            for entry in self._entries.values()
            if entry.due is not None and entry.due <= now and entry.running is None
        ]
        runs = [
            now - entry.running for entry in self._entries.values() if entry.running is not None
        ]
        return QueueStatistics(
            waiting=len(overdue),
            running=len(runs),
            known=len(self._entries),
            longest_wait=max(overdue, default=0.0),
            longest_run=max(runs, default=0.0),
            since_last_end=now - self._last_end,
        )

    def known(self) -> list[Key]:
        """Return every pool that was added and was not found to be gone."""
        return list(self._entries)

    def _now(self) -> float:
        return asyncio.get_running_loop().time()

    def _await_lull(self, key: Key, entry: _Entry, now: float) -> None:
        if entry.limit is None:
            rested = max(now, entry.rested)
            entry.limit = rested if entry.due is None else min(rested, entry.due)
        due = min(entry.limit, now + LULL)
        if due != entry.due:
            self._place(key, entry, due)

    def _place(self, key: Key, entry: _Entry, due: float) -> None:
        entry.due, entry.order = due, next(self._orders)
        if entry.running is None:
            heaps = self._failing if entry.failures else self._well
            heapq.heappush(heaps.setdefault(key.namespace, []), (due, entry.order, key))
            self._wake.set()

    def _first(self, heaps: _Heaps, namespace: str) -> tuple[float, Key] | None:
        """Return the first place in the namespace's heap that is not void."""
        heap = heaps[namespace]
        while heap:
            due, order, key = heap[0]
            entry = self._entries.get(key)
            if entry is not None and entry.order == order:
                return due, key
            heapq.heappop(heap)
        del heaps[namespace]
        return None

    def _firsts(self) -> Iterator[tuple[float, _Heaps, str]]:
        """Yield the due time and the place of the first pool of each namespace that may begin."""
        under_way = Counter(namespace for _, namespace in self._tasks.values())
        everywhere, alone = self._open(self._concurrency), self._open(2 * self._concurrency)
        for heaps in alone:
            for namespace in list(heaps):
                if heaps not in everywhere and under_way[namespace]:
                    continue
                if first := self._first(heaps, namespace):
                    yield first[0], heaps, namespace

    def _open(self, most: int) -> list[_Heaps]:
        """Return the heaps whose pools may begin now, if ``most`` may work at the same time."""
        now = self._now()
        working = sum(started + LONG > now for started, _ in self._tasks.values())
        if working >= most or len(self._tasks) >= CROWD * most:
            return []
        if working >= max(1, most - most // 4) or len(self._tasks) >= (CROWD - 1) * most:
            return [self._well]
        return [self._well, self._failing]

    def _next(self) -> tuple[_Heaps, str] | None:
        """Return the place of the next pool."""
        now = self._now()
        under_way = Counter(namespace for _, namespace in self._tasks.values())
        turns = []
        for due, heaps, namespace in self._firsts():
            late = due + (YIELD if heaps is self._failing else 0.0) > now
            if due <= now:
                turn = (late, under_way[namespace], self._last_begun.get(namespace, -1), due)
                turns.append((turn, heaps, namespace))
        if not turns:
            return None
        _, heaps, namespace = min(turns, key=lambda found: found[0])
        return heaps, namespace

    def _start_due(self) -> None:
        while found := self._next():
            heaps, namespace = found
            now, (_, _, key) = self._now(), heapq.heappop(heaps[namespace])
            entry = self._entries[key]
            entry.owed = max(0.0, entry.rested - now) if entry.limit is not None else 0.0
            entry.due, entry.limit, entry.order = None, None, -1
            entry.running, entry.rush, entry.lull = now, False, False
            task = asyncio.create_task(self._take(key, entry), name=f"reconcile of {key}")
            self._tasks[task] = now, namespace
            self._last_begun[namespace] = next(self._orders)
            task.add_done_callback(self._done)

    def _done(self, task: asyncio.Task[None]) -> None:
        del self._tasks[task]
        self._wake.set()

    async def _sleep(self) -> None:
        """Wait until a pool is due, a place becomes free, or a pool is added."""
        now = self._now()
        firsts = [due for due, _, _ in self._firsts()]
        begun = [started for started, _ in self._tasks.values()]
        handing_on = [started + LONG for started in begun if started + LONG > now]
        timeout = None
        if self._concurrency and (times := firsts + handing_on):
            timeout = max(0.0, min(times) - now)
        try:
            async with asyncio.timeout(timeout):
                await self._wake.wait()
        except TimeoutError:
            pass  # it is time

    async def _take(self, key: Key, entry: _Entry) -> None:
        try:
            result = await self._reconcile(key)
        except Exception:
            # A fault of this program must not end it: other pools work, and this one may again.
            log.exception("a reconcile failed", extra=about(*key, reason="InternalError"))
            result = Result(failed=True)
        finally:
            entry.running, self._last_end = None, self._now()
        self._settle(key, entry, result, self._last_end)

    def _settle(self, key: Key, entry: _Entry, result: Result, now: float) -> None:
        wanted = entry.due is not None  # added while it ran
        if result.forget and not wanted:
            del self._entries[key]
            if all(other.namespace != key.namespace for other in self._entries):
                self._last_begun.pop(key.namespace, None)
            return
        entry.failures = entry.failures + 1 if result.failed else 0
        entry.blocked = now + result.rest
        again = result.requeue_after
        if result.failed:
            again = min(LONGEST_BACKOFF, FIRST_BACKOFF * 2 ** min(entry.failures - 1, 10))
            entry.blocked = max(entry.blocked, now + min(again, LONGEST_BLOCK))
        entry.rested = max(now + GAP, entry.blocked) + entry.owed
        entry.lull = result.lull and not result.failed and not entry.owed
        if entry.due is not None:
            due, entry.due = entry.due, None
            if entry.lull and not entry.rush:
                self._await_lull(key, entry, max(due, now))
            else:
                self._place(key, entry, max(due, entry.blocked if entry.rush else entry.rested))
        if again is not None:
            self.add(key, delay=again, urgent=True)
