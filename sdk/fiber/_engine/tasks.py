"""Entries of the ledger: jobs, batches and workers.

Only the ledger changes them.  Waiting tasks are slices of a job.  Slices stay whole, so a million
tasks cost as much as one.

A lost task runs again.  Two bounds limit that, for two causes of the loss:

* **Deaths.**  The task may have killed its worker.  It runs again at most ``retries`` times.
* **Disruptions.**  The cluster ended the worker: a drain, an eviction, a preemption, a lost node.
  The task is not at fault, so this uses up no retry.  ``disruptions`` is the bound.  Without one,
  a task that takes longer than every worker runs would be repeated without end.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from fiber._engine.chunks import PROMPT, TARGET, TaskPace

COMPACT = 1024
"""Number of items at the front of a growing list that may be given out before they are removed."""

RunningTask = tuple[int, int]
"""Task that a worker runs: the number of its batch, and its offset in the batch."""

ENDED_SEQS = 16
"""Number of finished batches that a worker may still answer for."""


class Limits(NamedTuple):
    """Number of times that one task may run again, by the cause of its worker's end."""

    retries: int = 3
    disruptions: int = 20


class LossCounts(NamedTuple):
    """Number of times that one task was lost."""

    deaths: int
    disruptions: int


class Charges:
    """Losses that are charged to the tasks of one job, by their indices."""

    __slots__ = ("deaths", "disruptions", "limits", "lost")

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.lost = 0  # runs, of all tasks
        self.deaths: dict[int, int] = {}
        self.disruptions: dict[int, int] = {}

    def charge(self, task: int, *, disrupted: bool = False) -> bool:
        """Count one more lost run; return False if the task may not run again."""
        self.lost += 1
        counts = self.disruptions if disrupted else self.deaths
        limit = self.limits.disruptions if disrupted else self.limits.retries
        counts[task] = count = counts.get(task, 0) + 1
        return count <= limit

    def settle(self, task: int) -> LossCounts:
        """Forget a task that is done; return its counts."""
        return LossCounts(self.deaths.pop(task, 0), self.disruptions.pop(task, 0))


class Span:
    """Tasks ``start``, ``start + 1``, ... with their ``items``.

    ``alone``: each travels in a separate message; ``pin``: only one certain worker may run them.
    """

    __slots__ = ("alone", "items", "pin", "start")

    def __init__(
        self, start: int, items: Sequence[Any], alone: bool = False, pin: bool = False
    ) -> None:
        self.start = start
        self.items = items
        self.alone = alone
        self.pin = pin

    def part(self, first: int, stop: int, *, alone: bool = False) -> Span:
        """Return the tasks from ``first`` to before ``stop``, as indexes of the job."""
        items = self.items[first - self.start : stop - self.start]
        return Span(first, items, alone or self.alone, self.pin)

    def singly(self) -> list[Span]:
        """Return each task as a span that travels alone."""
        first = self.start
        return [self.part(at, at + 1, alone=True) for at in range(first, first + len(self.items))]

    def around(self, suspects: range) -> list[Span]:
        """Return in pieces: tasks before the suspects, each suspect alone, tasks after them."""
        if not suspects:
            return [self] if len(self.items) else []
        pieces, stop = [], self.start + len(self.items)
        if self.start < suspects.start:
            pieces.append(self.part(self.start, suspects.start))
        pieces += self.part(suspects.start, suspects.stop).singly()
        if suspects.stop < stop:
            pieces.append(self.part(suspects.stop, stop))
        return pieces


class _Stock:
    """Tasks that are given out from the front, and added at the end."""

    __slots__ = ("alone", "items", "position", "start")

    def __init__(self, span: Span) -> None:
        self.start = span.start
        self.items = span.items
        self.alone = span.alone
        self.position = 0

    def __len__(self) -> int:
        return len(self.items) - self.position

    def cut(self, size: int) -> Span:
        position = self.position
        span = Span(self.start + position, self.items[position : position + size], self.alone)
        self.position = position + size
        return span

    def grow(self, span: Span) -> bool:
        """Append ``span`` if that needs no copy of the items; return False if it does."""
        if (
            not isinstance(self.items, list)
            or self.alone != span.alone
            or self.start + len(self.items) != span.start
        ):
            return False
        if self.position > COMPACT and 2 * self.position > len(self.items):
            del self.items[: self.position]
            self.start += self.position
            self.position = 0
        self.items.extend(span.items)
        return True


class WaitingTasks:
    """Waiting tasks of one job, in the order in which they will be given out."""

    __slots__ = ("_count", "_stocks")

    def __init__(self) -> None:
        self._stocks: deque[_Stock] = deque()
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def items(self) -> Iterator[Any]:
        """Yield the items of the waiting tasks."""
        for stock in self._stocks:
            yield from stock.items[stock.position :]

    def first(self) -> int:
        """Return the index of the next task."""
        stock = self._stocks[0]
        return stock.start + stock.position

    def first_alone(self) -> bool:
        """Return whether the next task travels alone."""
        return self._stocks[0].alone

    def chunks(self, unit: int) -> int:
        """Return how many workers could run the tasks at once, if ``unit`` tasks stay together."""
        return sum([len(each) if each.alone else -(-len(each) // unit) for each in self._stocks])

    def append(self, span: Span) -> None:
        """Add tasks behind all others."""
        self._count += len(span.items)
        if not self._stocks or not self._stocks[-1].grow(span):
            self._stocks.append(_Stock(span))

    def appendleft(self, span: Span) -> None:
        """Add tasks that were given out before, ahead of all others."""
        self._count += len(span.items)
        self._stocks.appendleft(_Stock(span))

    def put_back(self, span: Span) -> None:
        """Add tasks that no worker has begun: ahead of all later tasks of the job."""
        earlier: list[_Stock] = []
        while self._stocks and self.first() < span.start:
            earlier.append(self._stocks.popleft())
        self.appendleft(span)
        self._stocks.extendleft(reversed(earlier))

    def take(self, size: int) -> Span:
        """Take the next tasks: at most ``size``, contiguous, one if it travels alone."""
        stock = self._stocks[0]
        span = stock.cut(1 if stock.alone else min(size, len(stock)))
        if not len(stock):
            self._stocks.popleft()
        self._count -= len(span.items)
        return span


class WrongAnswer(Exception):
    """Error for an answer that an honest worker cannot give; the text says why."""


class Job:
    """Tasks of one call."""

    __slots__ = (
        "alone",
        "batches",
        "charges",
        "closed",
        "done",
        "eager",
        "fed",
        "held",
        "listed",
        "owner",
        "pace",
        "paused",
        "pins",
        "reached",
        "running",
        "unit",
        "waiting",
    )

    def __init__(
        self, owner: Any, pace: TaskPace, limits: Limits, unit: int, alone: bool, eager: bool
    ) -> None:
        self.owner = owner
        self.pace = pace
        self.unit = unit
        self.eager = eager
        self.alone = alone or limits.retries == 0
        self.waiting = WaitingTasks()
        self.batches: dict[Batch, None] = {}  # batches of it that workers have
        self.held = 0  # units of those batches
        self.running = 0  # tasks of those batches without a result
        self.pins: dict[WorkerEntry, None] = {}  # workers that have pinned tasks of it
        self.charges = Charges(limits)
        self.fed = 0
        self.done = 0
        self.closed = False
        self.reached = 0  # index after the last task that was given out
        self.listed = False  # True while it is in the ledger's queue of turns
        self.paused = False  # True while its tasks wait until its results are read

    @property
    def target(self) -> float:
        """Seconds of work that one of the job's messages should carry."""
        return PROMPT if self.eager else TARGET

    @property
    def has_next(self) -> bool:
        """True if one of the job's tasks may be given out."""
        waiting = self.waiting
        return bool(waiting) and not (self.paused and waiting.first() >= self.reached)

    def hold(self, batch: Batch) -> None:
        """Note that a worker has the batch."""
        self.batches[batch] = None
        self.held += batch.units
        self.running += len(batch.items)
        self.reached = max(self.reached, batch.stop)

    def release(self, batch: Batch) -> None:
        """Note that the batch is over."""
        if batch in self.batches:
            del self.batches[batch]
            self.held -= batch.units
            self.running -= len(batch.items) - batch.received

    @property
    def surplus(self) -> int:
        """Number of open tasks that call for no further worker: the other tasks of each chunk, and
        tasks that a pause holds back."""
        surplus = max(0, self.running - self.held)
        if self.paused:
            return surplus + self.fed - self.reached
        return surplus + len(self.waiting) - self.waiting.chunks(self.unit)

    @property
    def finished(self) -> bool:
        """True once no more tasks will come and all tasks are done."""
        return self.closed and self.done == self.fed

    def drop_waiting(self, wanted: Callable[[Any], bool]) -> int:
        """Drop the waiting tasks that are not ``wanted``; return how many."""
        waiting, self.waiting = self.waiting, WaitingTasks()
        dropped = 0
        while waiting:
            span = waiting.take(len(waiting))
            kept = [at for at, item in enumerate(span.items, span.start) if wanted(item)]
            dropped += len(span.items) - len(kept)
            whole = len(kept) == len(span.items)
            for part in [span] if whole else [span.part(at, at + 1) for at in kept]:
                self.waiting.append(part)
        return dropped

    def lose(
        self, rest: Span, suspects: range, *, disrupted: bool
    ) -> tuple[list[Span], list[Loss]]:
        """Charge the ``suspects`` in ``rest``, tasks of a lost worker.

        Return the spans that run again and the tasks that have no tries left, the last ones first.
        """
        again, losses = [], []
        for span in reversed(rest.around(suspects)):
            task, charges = span.start, self.charges
            if task in suspects and not charges.charge(task, disrupted=disrupted):
                losses.append(Loss(self, task, charges.settle(task), span.items[0]))
            else:
                again.append(span)
        return again, losses


class JobTurns(deque[Job]):
    """Jobs with waiting tasks, in the order in which they get workers."""

    def give(self, job: Job) -> None:
        """Give the job a turn after all others, unless it has one."""
        if not job.listed:
            job.listed = True
            self.append(job)

    def give_first(self, job: Job) -> None:
        """Give the job the next turn, since it got no work done in an earlier one."""
        if job.listed:
            self.remove(job)
        job.listed = True
        self.appendleft(job)


class Batch:
    """Slice of a job's tasks in one message.

    ``job`` is None once the results do not count.  ``received`` is the number of results; the last
    message of results began at ``_received_from``.  ``stride`` is the number of tasks between two
    notes of the worker's progress.  ``has_function`` is False if the worker must remember the
    function.  ``late`` is True if it ran for too long to let another batch wait behind it.
    """

    __slots__ = (
        "_received_from",
        "alone",
        "has_function",
        "items",
        "job",
        "late",
        "pin",
        "received",
        "seq",
        "start",
        "stride",
        "unit",
        "worker",
    )

    def __init__(self, seq: int, job: Job | None, worker: WorkerEntry, span: Span) -> None:
        self.seq = seq
        self.job = job
        self.has_function = True
        self.worker = worker
        self.start = span.start
        self.items = span.items
        self.alone = span.alone
        self.pin = span.pin
        self.stride = 1 if job is None or job.eager else job.pace.stride()
        self.unit = 1 if job is None else job.unit
        self.received = 0
        self.late = False
        self._received_from = 0

    def take(self, offset: int, count: int, kept: int | None) -> bool:
        """Take ``count`` results from ``offset`` on; return False if they repeat the last ones.

        Raise WrongAnswer for results that cannot come next.
        """
        stop, size = offset + count, len(self.items)
        if count and offset == self._received_from and stop == self.received:
            return False
        if offset != self.received or stop > size:
            raise WrongAnswer(
                f"it sent results {offset} to {stop} of batch {self.seq}, which has {size} tasks "
                f"and {self.received} results"
            )
        # If a worker kept none, its tasks could run again without end, and without a charge.
        if kept is not None and not max(stop, 1) <= kept <= size:
            raise WrongAnswer(f"it kept {kept} of {size} tasks of batch {self.seq}, {stop} done")
        self._received_from, self.received = offset, stop
        if self.job is not None:
            self.job.running -= count
        return True

    @property
    def stop(self) -> int:
        """Index after the last task."""
        return self.start + len(self.items)

    @property
    def units(self) -> int:
        """Units that this batch counts for maxtasksperchild."""
        return -(-len(self.items) // self.unit)

    def predicted(self) -> float:
        """Return the seconds that the batch should take; 0 if that is unknown."""
        seconds = None if self.job is None else self.job.pace.seconds
        return 0.0 if seconds is None else seconds * len(self.items)

    def rest(self) -> Span:
        """Return the tasks without a result."""
        return self.part(self.start + self.received, self.stop)

    def part(self, first: int, stop: int) -> Span:
        """Return the tasks from index ``first`` to before ``stop``."""
        return Span(self.start, self.items, self.alone, self.pin).part(first, stop)

    def cut(self, kept: int) -> Span:
        """Keep only the first ``kept`` tasks; return the others."""
        rest, units = self.part(self.start + kept, self.stop), self.units
        self.items = self.items[:kept]
        if self.job is not None:
            self.job.held -= units - self.units
            self.job.running -= len(rest.items)
        return rest

    def suspects(self, running: RunningTask | None) -> range:
        """Return tasks one of which was running: without better knowledge all without a result."""
        first, stop = self.start + self.received, self.stop
        if running is None or running[0] != self.seq:
            return range(first, stop)
        at = self.start + running[1]
        return range(max(first, at), max(first, min(stop, at + self.stride)))


class WorkerEntry:
    """Batches of one worker.  ``left``: units that it may still get (maxtasksperchild)."""

    __slots__ = (
        "ended_seqs",
        "key",
        "leased",
        "leaving",
        "left",
        "pinned",
        "queue",
        "recalled",
        "since",
    )

    def __init__(self, key: Any, left: int | None) -> None:
        self.key = key
        self.left = left
        self.queue: deque[Batch] = deque()
        self.ended_seqs: deque[int] = deque(maxlen=ENDED_SEQS)  # of its batches that are over
        self.pinned: deque[tuple[Job, Span]] = deque()
        self.since = 0.0  # time when it became idle, or began its current batch
        self.recalled = False
        self.leaving = False
        self.leased = False  # callers send it calls directly

    def in_progress(self, unread: set[int], running: RunningTask | None) -> Batch | None:
        """Return the batch that the worker ran when it died; a worker reads one at a time."""
        read = [batch for batch in self.queue if batch.seq not in unread]
        named = [batch for batch in read if running is not None and batch.seq == running[0]]
        return next(iter(named or read), None)


class Receipt(NamedTuple):
    """Results that count: those of ``size`` tasks of ``job`` from index ``start`` on."""

    job: Job
    start: int
    size: int
    batch: Batch

    def item(self, index: int) -> Any:
        """Return the item of the task ``index``."""
        return self.batch.items[index - self.batch.start]


class Loss(NamedTuple):
    """Task that was running in too many workers when they were lost."""

    job: Job
    task: int
    counts: LossCounts
    item: Any
