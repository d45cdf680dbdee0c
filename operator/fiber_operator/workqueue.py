"""Work queue of pools: each pool waits in it at most once and is reconciled by one task at a time.

Events that arrive during a reconcile cause one more reconcile afterwards.  Three rules space the
reconciles of one pool:

* after a reconcile the pool rests for as long as the reconcile's result says;
* events of pods wait until ``GAP`` seconds after the last reconcile, so that a thousand events of a
  growing pool cause a few reconciles;
* a failed reconcile is repeated after a delay that doubles each time.

A pool whose result says ``early`` may be reconciled before the end of its rest, as soon as the
events of its pods pause.  So the status shows the end of a change at once.  The next rest is longer
by the time that was saved, and cannot be shortened, so that the load stays the same.

A pool in trouble does not delay others.  A reconcile that takes longer than ``LONG`` seconds, for
example because a webhook hangs, gives its place to the next pool and goes on.  Pools whose last
reconcile failed come after the others and never occupy all places.

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
"""Seconds between reconciles that are caused by events of pods: short enough that the status is
current within a second, long enough that many events cause one reconcile."""
PAUSE = 0.15
"""Seconds without an event after which the events of a pool have paused."""
FIRST_BACKOFF = 0.5
LONGEST_BACKOFF = 30.0
LONGEST_BLOCK = 1.0
"""Seconds, at most, for which even urgent events wait after a failed reconcile."""

LONG = 2.0
"""Seconds after which a running reconcile gives its place to another."""
YIELD = 10.0
"""Seconds for which a due pool whose last reconcile failed lets others go first."""
MOST_RUNNING = 4
"""Running reconciles at most for each place, including those that gave up their place."""


_Heap = list[tuple[float, int, "Key"]]
_Heaps = dict[str, _Heap]
"""Heap of due times for each namespace."""


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
    """Do not reconcile again for this many seconds, even for urgent events."""
    early: bool = False
    """Reconcile before the end of the rest if events of pods arrive and then pause."""
    failed: bool = False
    """Reconcile again after a delay that doubles with each failure."""
    forget: bool = False
    """Remove the pool from the queue, because it does not exist."""


@dataclass
class _Entry:
    """State of one pool in the queue."""

    due: float | None = None
    """Time of the next reconcile; None: none is asked for."""
    blocked_until: float = -1e9
    """Earliest time of a reconcile for an urgent event."""
    resting_until: float = -1e9
    """Earliest time of a reconcile for events of pods, unless ``may_be_early``."""
    may_be_early: bool = False
    """True if a pause of the events ends the rest."""
    latest: float | None = None
    """Latest time of a reconcile that waits for a pause of the events; None: none waits for one."""
    rest_saved: float = 0.0
    """Seconds by which a pause shortened the last rest.  The next rest is longer by them."""
    failures: int = 0
    """Reconciles that failed one after the other."""
    running_since: float | None = None
    """Time at which the running reconcile began; None: none runs."""
    urgent: bool = False
    """True if an urgent event arrived while the reconcile ran."""
    order: int = -1
    """Number of the valid entry of this pool in the heap.  Entries with other numbers are void."""


@dataclass(frozen=True)
class QueueStatistics:
    """Numbers of the queue at one moment."""

    waiting: int
    """Pools that are due and wait for a place."""
    running: int
    """Running reconciles."""
    known: int
    """Pools that were added and still exist."""
    longest_wait: float
    """Seconds for which the pool that waits longest is overdue."""
    longest_run: float
    """Seconds since the oldest running reconcile began."""
    since_last_end: float
    """Seconds since the last end of a reconcile, or since the queue was made."""


class WorkQueue:
    """Queue that awaits ``reconcile`` for each pool that was added, one at a time for each pool.

    ``concurrency`` is the number of places, which pools of all namespaces share.
    """

    def __init__(self, reconcile: Callable[[Key], Awaitable[Result]], *, concurrency: int) -> None:
        self._reconcile = reconcile
        self._concurrency = concurrency
        self._entries: dict[Key, _Entry] = {}
        self._healthy: _Heaps = {}
        self._failing: _Heaps = {}
        self._last_begun: dict[str, int] = {}
        """Number of the last reconcile of each namespace, from ``_orders``."""
        self._orders = itertools.count()
        self._tasks: dict[asyncio.Task[None], tuple[float, str]] = {}
        """Running reconciles, the oldest first: time of the begin, and namespace."""
        self._wake = asyncio.Event()
        self._last_end = self._now()

    def add(self, key: Key, *, delay: float = 0.0, urgent: bool = False) -> None:
        """Reconcile ``key`` after ``delay`` seconds, and after its rest.  If urgent, skip the rest.

        If the pool already waits, the earlier of both times counts.
        """
        now = self._now()
        entry = self._entries.setdefault(key, _Entry())
        if not urgent and entry.may_be_early and entry.running_since is None:
            self._wait_for_pause(key, entry, now + delay)
            return
        due = max(now + delay, entry.blocked_until)
        if not urgent:
            due = max(due, entry.resting_until)
        elif entry.running_since is not None:
            entry.urgent = True
        if entry.latest is not None:
            entry.latest = min(entry.latest, due)
        if entry.due is None or due < entry.due:
            self._place(key, entry, due)

    async def run(self) -> None:
        """Reconcile the pools that are due until cancelled.  Then cancel the running reconciles."""
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
        """Start no further reconcile.  Wait ``grace`` seconds for the running ones to end."""
        self._concurrency = 0
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=grace)

    def statistics(self) -> QueueStatistics:
        """Return the numbers of the queue now."""
        now = self._now()
        overdue = [
            now - entry.due
            for entry in self._entries.values()
            if entry.due is not None and entry.due <= now and entry.running_since is None
        ]
        runs = [
            now - entry.running_since
            for entry in self._entries.values()
            if entry.running_since is not None
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
        """Return the pools that were added and that no result has removed."""
        return list(self._entries)

    def _now(self) -> float:
        return asyncio.get_running_loop().time()

    def _wait_for_pause(self, key: Key, entry: _Entry, event_at: float) -> None:
        """Reconcile when the events pause: each event puts the reconcile off, up to a limit."""
        if entry.latest is None:
            rest_ends = max(event_at, entry.resting_until)
            entry.latest = rest_ends if entry.due is None else min(rest_ends, entry.due)
        due = min(entry.latest, event_at + PAUSE)
        if due != entry.due:
            self._place(key, entry, due)

    def _place(self, key: Key, entry: _Entry, due: float) -> None:
        entry.due, entry.order = due, next(self._orders)
        if entry.running_since is None:
            heaps = self._failing if entry.failures else self._healthy
            heapq.heappush(heaps.setdefault(key.namespace, []), (due, entry.order, key))
            self._wake.set()

    def _first(self, heaps: _Heaps, namespace: str) -> tuple[float, Key] | None:
        """Return the due time and the pool of the first valid entry in the namespace's heap."""
        heap = heaps[namespace]
        while heap:
            due, order, key = heap[0]
            entry = self._entries.get(key)
            if entry is not None and entry.order == order:
                return due, key
            heapq.heappop(heap)
        del heaps[namespace]
        return None

    def _candidates(self) -> Iterator[tuple[float, _Heaps, str]]:
        """Yield due time, heaps and namespace of each namespace's first pool that may begin."""
        running = Counter(namespace for _, namespace in self._tasks.values())
        shared = self._open_heaps(self._concurrency)
        extra = self._open_heaps(2 * self._concurrency)
        for heaps in extra:
            for namespace in list(heaps):
                if heaps not in shared and running[namespace]:
                    continue  # the extra places are for namespaces without a running reconcile
                if first := self._first(heaps, namespace):
                    yield first[0], heaps, namespace

    def _open_heaps(self, places: int) -> list[_Heaps]:
        """Return the heaps whose pools may begin now, if there are that many places."""
        now = self._now()
        working = sum(started + LONG > now for started, _ in self._tasks.values())
        running = len(self._tasks)
        if working >= places or running >= MOST_RUNNING * places:
            return []
        if working >= max(1, places - places // 4) or running >= (MOST_RUNNING - 1) * places:
            return [self._healthy]
        return [self._healthy, self._failing]

    def _next(self) -> tuple[_Heaps, str] | None:
        """Return the heaps and the namespace of the pool to reconcile next."""
        now = self._now()
        running = Counter(namespace for _, namespace in self._tasks.values())
        turns = []
        for due, heaps, namespace in self._candidates():
            yields = due + (YIELD if heaps is self._failing else 0.0) > now
            if due <= now:
                turn = (yields, running[namespace], self._last_begun.get(namespace, -1), due)
                turns.append((turn, heaps, namespace))
        if not turns:
            return None
        _, heaps, namespace = min(turns, key=lambda candidate: candidate[0])
        return heaps, namespace

    def _start_due(self) -> None:
        while chosen := self._next():
            heaps, namespace = chosen
            now, (_, _, key) = self._now(), heapq.heappop(heaps[namespace])
            entry = self._entries[key]
            paused = entry.latest is not None
            entry.rest_saved = max(0.0, entry.resting_until - now) if paused else 0.0
            entry.due, entry.latest, entry.order = None, None, -1
            entry.running_since, entry.urgent, entry.may_be_early = now, False, False
            task = asyncio.create_task(self._run_reconcile(key, entry), name=f"reconcile of {key}")
            self._tasks[task] = now, namespace
            self._last_begun[namespace] = next(self._orders)
            task.add_done_callback(self._done)

    def _done(self, task: asyncio.Task[None]) -> None:
        del self._tasks[task]
        self._wake.set()

    async def _sleep(self) -> None:
        """Wait until a pool is due, a reconcile gives up its place, or ``_wake`` is set."""
        now = self._now()
        due_times = [due for due, _, _ in self._candidates()]
        long_from = [started + LONG for started, _ in self._tasks.values()]
        next_place = [moment for moment in long_from if moment > now]
        timeout = None
        if self._concurrency and (times := due_times + next_place):
            timeout = max(0.0, min(times) - now)
        try:
            async with asyncio.timeout(timeout):
                await self._wake.wait()
        except TimeoutError:
            pass  # a pool is due, or a place is free

    async def _run_reconcile(self, key: Key, entry: _Entry) -> None:
        try:
            result = await self._reconcile(key)
        except Exception:
            # A bug must not end the operator: other pools work, and this one may work again.
            log.exception("a reconcile failed", extra=about(*key, reason="InternalError"))
            result = Result(failed=True)
        finally:
            entry.running_since, self._last_end = None, self._now()
        self._plan_next(key, entry, result, self._last_end)

    def _plan_next(self, key: Key, entry: _Entry, result: Result, now: float) -> None:
        added_meanwhile = entry.due is not None
        if result.forget and not added_meanwhile:
            del self._entries[key]
            if all(other.namespace != key.namespace for other in self._entries):
                self._last_begun.pop(key.namespace, None)
            return
        entry.failures = entry.failures + 1 if result.failed else 0
        entry.blocked_until = now + result.rest
        again = result.requeue_after
        if result.failed:
            again = min(LONGEST_BACKOFF, FIRST_BACKOFF * 2 ** min(entry.failures - 1, 10))
            entry.blocked_until = max(entry.blocked_until, now + min(again, LONGEST_BLOCK))
        entry.resting_until = max(now + GAP, entry.blocked_until) + entry.rest_saved
        entry.may_be_early = result.early and not result.failed and not entry.rest_saved
        if entry.due is not None:
            due, entry.due = entry.due, None
            if entry.may_be_early and not entry.urgent:
                self._wait_for_pause(key, entry, max(due, now))
            else:
                earliest = entry.blocked_until if entry.urgent else entry.resting_until
                self._place(key, entry, max(due, earliest))
        if again is not None:
            self.add(key, delay=again, urgent=True)
