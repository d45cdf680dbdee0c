"""Activity: what the children of a program did, in bounded memory.

The program's monitors, timeline, summary and metrics all read this record.  Pure: each time is an
argument, in seconds of one monotonic clock.

A worker's answer becomes a ``WorkSpan``, or extends the worker's last one if it follows closely and
is of the same function.  If there are too many spans, ``resolution`` grows: spans that are closer
to each other become one.  So a run of a minute shows each message, and a run of a week shows hours.
"""

from __future__ import annotations

import weakref
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

SPANS = 20_000
"""Spans that are kept."""

ENDED = 2_000
"""Children that are kept after their end."""

DEATHS = 20
"""Deaths that are kept."""

FUNCTIONS = 500
"""Functions with totals of their own."""

OTHER_FUNCTIONS = "(other functions)"
"""Name for the functions beyond ``FUNCTIONS``."""

SEVERAL = "(several functions)"
"""Function of a span that stands for spans of several functions."""

_RESOLUTION = 1e-3
"""Seconds between spans that become one, at first."""

_BUCKETS = 600


class WorkSpan:
    """Time in which a child worked without a longer pause."""

    __slots__ = ("begin", "changed", "end", "failed", "function", "tasks", "work")

    def __init__(
        self, function: str, begin: float, end: float, work: float, tasks: int, failed: int
    ) -> None:
        self.function = function
        self.begin = begin
        self.end = end
        self.work = work
        """Seconds of work, without the pauses."""
        self.tasks = tasks
        self.failed = failed
        self.changed = 0
        """Revision at its last change."""

    def absorb(self, other: WorkSpan) -> None:
        """Take over a later span."""
        if self.function != other.function:
            self.function = SEVERAL
        self.end = other.end
        self.work += other.work
        self.tasks += other.tasks
        self.failed += other.failed


class ChildRecord:
    """Record of one child: a worker of a pool, or another process."""

    __slots__ = (
        "began",
        "changed",
        "cpu",
        "ended",
        "failed",
        "held",
        "host",
        "id",
        "memory",
        "name",
        "node",
        "noted",
        "pid",
        "pool",
        "ready",
        "reason",
        "spans",
        "started",
        "tasks",
        "work",
    )

    def __init__(self, id_: int, name: str, began: float) -> None:
        self.id = id_
        self.name = name
        self.host = self.node = ""
        self.pid: int | None = None
        self.pool: int | None = None
        """Number of its pool; None if it is no worker of a pool."""
        self.began = began
        """Time when it was asked for."""
        self.started: float | None = None
        self.ready: float | None = None
        """Time when its initializer returned."""
        self.ended: float | None = None
        self.reason = ""
        """Reason of an end that the program had not asked for."""
        self.tasks = self.failed = 0
        self.work = 0.0
        """Seconds of work, with unpickling and pickling in the worker."""
        self.held = 0.0
        """Seconds in which it had tasks.  ``held`` minus ``work`` is the time on the way.

        A call that its caller sent to the worker itself counts without its way.
        """
        self.noted = began
        """Time up to which ``held`` counts."""
        self.memory: int | None = None
        """Bytes of memory when it was measured last; None before."""
        self.cpu: float | None = None
        """Seconds of processor time, likewise."""
        self.spans: list[WorkSpan] = []
        self.changed = 0


class FunctionTotals:
    """Totals of one function."""

    __slots__ = ("answers", "chunk", "failed", "longest", "name", "tasks", "work")

    def __init__(self, name: str) -> None:
        self.name = name
        self.tasks = self.failed = 0
        self.answers = 0
        """Messages with which workers answered."""
        self.chunk = 1
        """Largest chunk of tasks that had to stay together."""
        self.work = 0.0
        self.longest = 0.0
        """Longest time of a task in seconds; of several tasks in one answer, their mean."""


class RateHistory:
    """Tasks that were done in each interval of ``width`` seconds, which grows with the run."""

    def __init__(self, start: float) -> None:
        self.width = 0.25
        self.done: list[int] = []
        self.failed: list[int] = []
        self._start = start

    def add(self, now: float, tasks: int, failed: int) -> None:
        """Count tasks that are done now."""
        at = int((now - self._start) / self.width)
        while at >= _BUCKETS:
            self.width *= 2
            self.done, self.failed = _pairs(self.done), _pairs(self.failed)
            at //= 2
        if at >= len(self.done):
            more = [0] * (at + 1 - len(self.done))
            self.done += more
            self.failed += more
        self.done[at] += tasks
        self.failed[at] += failed


class WorkReport(NamedTuple):
    """Work that a worker has reported."""

    function: str
    begin: float
    end: float
    seconds: float
    """Seconds of work between ``begin`` and ``end``."""
    tasks: int
    failed: int = 0
    answers: int = 1
    """Messages with which the worker answered."""
    chunk: int = 1
    """Tasks that had to stay together, by the ``chunksize`` of a map."""


class WorkSource(Protocol):
    """Part of the program that notes work now and then."""

    def note_work(self) -> None:
        """Note all work until now."""


class Activity:
    """Record of a program's children and their work."""

    def __init__(self, now: float, spans: int = SPANS) -> None:
        self.start = now
        self.resolution = _RESOLUTION
        self.rates = RateHistory(now)
        self.functions: dict[str, FunctionTotals] = {}
        self.pickling = 0.0
        """Seconds in which the program pickled tasks."""
        self.bytes_sent = self.bytes_received = 0
        self.tasks = self.failed = 0
        self.retried = 0
        """Runs that were repeated, since the task raised an error after which it is tried again."""
        self.lost = 0
        """Runs that were lost with their workers."""
        self.died = 0
        """Children that ended, and that the program had not asked to end."""
        self.forgotten = 0
        """Children whose records were dropped."""
        self.deaths: deque[ChildRecord] = deque(maxlen=DEATHS)
        """Last children that ended, and that the program had not asked to end."""
        self.sources: weakref.WeakSet[WorkSource] = weakref.WeakSet()
        """Parts that note their work in ``refresh``."""
        self._most_spans = spans
        self._span_count = 0
        self._children: dict[int, ChildRecord] = {}
        self._ended: deque[ChildRecord] = deque()
        self._numbers = 0
        self._pools = 0
        self._revision = 1
        self._rewritten = 0
        """Revision at which spans were merged or dropped."""

    def __iter__(self) -> Iterator[ChildRecord]:
        return iter(list(self._children.values()))

    # Changes

    def add_pool(self) -> int:
        """Return the number of a new pool."""
        self._pools += 1
        return self._pools

    def add_child(self, name: str, now: float) -> ChildRecord:
        """Return the record of a child that was asked for."""
        self._numbers += 1
        record = ChildRecord(self._numbers, name, now)
        record.changed = self._revision
        self._children[record.id] = record
        return record

    def started(self, record: ChildRecord, now: float, host: str, node: str, pid: int) -> None:
        """Note that a child runs."""
        record.started, record.host, record.node, record.pid = now, host, node, pid
        record.changed = self._revision

    def ready(self, record: ChildRecord, now: float, pool: int) -> None:
        """Note that a worker is ready for the tasks of a pool."""
        record.ready, record.pool = now, pool
        record.changed = self._revision

    def ended(self, record: ChildRecord, now: float, reason: str = "") -> None:
        """Note the end of a child, with its ``reason`` if the program had not asked for it."""
        record.ended, record.reason = now, reason
        record.changed = self._revision
        if reason:
            self.died += 1
            self.deaths.append(record)
        if record.started is None:  # it never ran, and a program may try again without end
            self._forget(record)
            return
        self._ended.append(record)
        if len(self._ended) > ENDED:  # several at a time: each time, the next snapshot is complete
            for _ in range(ENDED // 10 or 1):
                self._forget(self._ended.popleft())

    def worked(self, record: ChildRecord, work: WorkReport) -> None:
        """Note work that a worker has reported."""
        function, begin, end, seconds, tasks, failed, _, _ = work
        record.tasks += tasks
        record.work += seconds
        self.tasks += tasks
        if failed:
            record.failed += failed
            self.failed += failed
        self.rates.add(end, tasks, failed)
        self._count(work)
        revision = record.changed = self._revision
        spans = record.spans
        if spans:
            last = spans[-1]
            begin = max(begin, last.end)
            follows = last.function == function and begin - last.end <= self.resolution
            if follows and bool(last.tasks) == bool(tasks):
                last.end = max(last.end, end)
                last.work += seconds
                last.tasks += tasks
                last.failed += failed
                last.changed = revision
                return
        span = WorkSpan(function, begin, max(begin, end), seconds, tasks, failed)
        span.changed = revision
        spans.append(span)
        self._span_count += 1
        if self._span_count > self._most_spans:
            self._coarsen()

    def _count(self, work: WorkReport) -> None:
        totals = self.functions.get(work.function)
        if totals is None:
            name = work.function if len(self.functions) < FUNCTIONS else OTHER_FUNCTIONS
            totals = self.functions.setdefault(name, FunctionTotals(name))
        totals.failed += work.failed
        totals.work += work.seconds
        if work.tasks:
            totals.tasks += work.tasks
            totals.answers += work.answers
            totals.chunk = max(totals.chunk, work.chunk)
            totals.longest = max(totals.longest, work.seconds / work.tasks)

    # Bounds

    def _coarsen(self) -> None:
        """Merge spans until at most half of them are left; forget ended children if need be."""
        self._rewritten = self._revision
        longest = max(record.spans[-1].end for record in self if record.spans) - self.start
        self._merge()
        while 2 * self._span_count > self._most_spans and self.resolution <= longest:
            self.resolution *= 2
            self._merge()
        while 2 * self._span_count > self._most_spans and self._ended:
            self._forget(self._ended.popleft())
        # By now each child has two spans at most.
        self._most_spans = max(self._most_spans, 4 * self._span_count)

    def _merge(self) -> None:
        for record in self:
            record.spans = _merged(record.spans, self.resolution)
        self._span_count = sum(len(record.spans) for record in self)

    def _forget(self, record: ChildRecord) -> None:
        del self._children[record.id]
        self._span_count -= len(record.spans)
        self.forgotten += 1
        self._rewritten = self._revision

    # Reading

    def totals(self) -> dict[str, Any]:
        """Return the totals of the program as plain values."""
        return {
            "tasks": self.tasks,
            "failed": self.failed,
            "retried": self.retried,
            "lost": self.lost,
            "pickling": self.pickling,
            "bytes_sent": self.bytes_sent,
            "bytes_received": self.bytes_received,
        }

    def refresh(self) -> None:
        """Have all sources note their work until now."""
        for source in list(self.sources):
            source.note_work()

    def snapshot(self, now: float, since: int = 0) -> dict[str, Any]:
        """Return the record as plain values, or what changed after the snapshot ``since``.

        Times are seconds after the start.  If ``complete`` is true, the snapshot replaces earlier
        ones.  Otherwise a child replaces the facts of the child with its ``id``, and its spans
        follow the spans that begin earlier.
        """
        complete = since <= self._rewritten
        after = 0 if complete else since
        start = self.start
        found = {
            "revision": self._revision,
            "complete": complete,
            "now": now - start,
            "resolution": self.resolution,
            **self.totals(),
            "forgotten": self.forgotten,
            "children": [
                _child_facts(record, start, after)
                for record in self._children.values()
                if record.changed > after
            ],
            "functions": [
                {
                    "name": totals.name,
                    "tasks": totals.tasks,
                    "failed": totals.failed,
                    "answers": totals.answers,
                    "chunk": totals.chunk,
                    "work": totals.work,
                    "longest": totals.longest,
                }
                for totals in self.functions.values()
            ],
            "rates": {
                "width": self.rates.width,
                "done": list(self.rates.done),
                "failed": list(self.rates.failed),
            },
        }
        self._revision += 1
        return found


def _child_facts(record: ChildRecord, start: float, after: int) -> dict[str, Any]:
    facts = {
        "id": record.id,
        "name": record.name,
        "host": record.host,
        "node": record.node,
        "pid": record.pid,
        "pool": record.pool,
        "began": record.began - start,
        "started": _since(record.started, start),
        "ready": _since(record.ready, start),
        "ended": _since(record.ended, start),
        "reason": record.reason,
        "tasks": record.tasks,
        "failed": record.failed,
        "work": record.work,
        "held": record.held,
    }
    new = []
    for span in reversed(record.spans):
        if span.changed <= after:
            break
        new.append(
            [
                span.begin - start,
                span.end - start,
                span.function,
                span.work,
                span.tasks,
                span.failed,
            ]
        )
    new.reverse()
    facts["spans"] = new
    return facts


def _since(time: float | None, start: float) -> float | None:
    return None if time is None else time - start


def _merged(spans: list[WorkSpan], gap: float) -> list[WorkSpan]:
    """Return spans in which those of one function, and short ones, are ``gap`` apart at least."""
    kept: list[WorkSpan] = []
    for span in spans:
        last = kept[-1] if kept else None
        if last is not None and span.begin - last.end <= gap and _alike(last, span, gap):
            last.absorb(span)
        else:
            kept.append(span)
    return kept


def _alike(one: WorkSpan, other: WorkSpan, gap: float) -> bool:
    if bool(one.tasks) != bool(other.tasks):
        return False  # a lost run is no work
    is_short = min(one.end - one.begin, other.end - other.begin) <= gap
    return one.function == other.function or is_short


def _pairs(counts: list[int]) -> list[int]:
    """Return the sums of each two neighbours."""
    return [sum(counts[at : at + 2]) for at in range(0, len(counts), 2)]
