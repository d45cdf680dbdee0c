"""The ledger's entries: jobs, batches and workers.  Only the ledger changes them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from fiber._engine.charges import Charges, Counts, Limits
from fiber._engine.chunks import PROMPT, TARGET, Pace
from fiber._engine.spans import Span, Waiting

HAD = 16
"""Batches that a worker had last and that it may still answer for."""


class WrongAnswer(Exception):
    """An answer that its worker cannot have given in good faith; the text says why."""


class Job:
    """The tasks of one call."""

    __slots__ = (
        "alone",
        "batches",
        "charges",
        "closed",
        "done",
        "exact",
        "fed",
        "listed",
        "owner",
        "pace",
        "paused",
        "pins",
        "reached",
        "unit",
        "waiting",
    )

    def __init__(
        self, owner: Any, pace: Pace, limits: Limits, unit: int, alone: bool, exact: bool
    ) -> None:
        self.owner = owner
        self.pace = pace
        self.unit = unit
        self.exact = exact
        self.alone = alone or limits.retries == 0
        self.waiting = Waiting()
        self.batches: dict[Batch, None] = {}  # those of its tasks that were given out
        self.pins: dict[Worker, None] = {}  # who holds pinned tasks of it
        self.charges = Charges(limits)
        self.fed = 0
        self.done = 0
        self.closed = False
        self.reached = 0  # the index behind the last task that was given out
        self.listed = False  # whether it is in the ledger's round of turns
        self.paused = False  # whether its tasks wait until somebody takes results of it

    @property
    def target(self) -> float:
        """Seconds of work that a message of it should carry."""
        return PROMPT if self.exact else TARGET

    @property
    def has_next(self) -> bool:
        """Whether a task of it may be given out."""
        waiting = self.waiting
        return bool(waiting) and not (self.paused and waiting.first() >= self.reached)

    @property
    def never_given(self) -> int:
        """How many of its tasks nobody was given yet."""
        return self.fed - self.reached

    @property
    def finished(self) -> bool:
        """No task will come any more, and all that came are done."""
        return self.closed and self.done == self.fed

    def drop_waiting(self, wanted: Callable[[Any], bool]) -> int:
        """Drop the waiting tasks that are not ``wanted``; return how many."""
        waiting, self.waiting = self.waiting, Waiting()
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

        Returns the spans that run again and the tasks that had their tries, the last ones first.
        """
        again, losses = [], []
        for span in reversed(rest.around(suspects)):
            task, charges = span.start, self.charges
            if task in suspects and not charges.charge(task, disrupted=disrupted):
                losses.append(Loss(self, task, charges.settle(task), span.items[0]))
            else:
                again.append(span)
        return again, losses


class Batch:
    """A slice of a job's tasks in one message.

    ``job`` is None once its results are not wanted; ``received`` counts those that came, the last
    of them from ``_received_from`` on; ``stride`` is the number of tasks between two notes of the
    worker's progress.  ``has_function`` is False if the message relies on the worker's memory.
    """

    __slots__ = (
        "_received_from",
        "alone",
        "has_function",
        "items",
        "job",
        "pin",
        "received",
        "seq",
        "start",
        "stride",
        "unit",
        "worker",
    )

    def __init__(self, seq: int, job: Job | None, worker: Worker, span: Span) -> None:
        self.seq = seq
        self.job = job
        self.has_function = True
        self.worker = worker
        self.start = span.start
        self.items = span.items
        self.alone = span.alone
        self.pin = span.pin
        self.stride = 1 if job is None or job.exact else job.pace.stride()
        self.unit = 1 if job is None else job.unit
        self.received = 0
        self._received_from = 0

    def take(self, offset: int, count: int, kept: int | None) -> bool:
        """Take ``count`` results from ``offset`` on; False if they are the last ones once more.

        Raises WrongAnswer for results that cannot come next.
        """
        stop, size = offset + count, len(self.items)
        if count and offset == self._received_from and stop == self.received:
            return False
        if offset != self.received or stop > size:
            raise WrongAnswer(
                f"it sent results {offset} to {stop} of batch {self.seq}, which has {size} tasks "
                f"and {self.received} results"
            )
        # One that keeps none would have its tasks run again without end, and no run would count.
        if kept is not None and not max(stop, 1) <= kept <= size:
            raise WrongAnswer(f"it kept {kept} of {size} tasks of batch {self.seq}, {stop} done")
        self._received_from, self.received = offset, stop
        return True

    @property
    def stop(self) -> int:
        """The index behind its last task."""
        return self.start + len(self.items)

    @property
    def units(self) -> int:
        """What this batch counts for maxtasksperchild."""
        return -(-len(self.items) // self.unit)

    def rest(self) -> Span:
        """The tasks without a result."""
        return self.part(self.start + self.received, self.stop)

    def part(self, first: int, stop: int) -> Span:
        """The tasks from index ``first`` to before ``stop``."""
        return Span(self.start, self.items, self.alone, self.pin).part(first, stop)

    def cut(self, kept: int) -> Span:
        """Keep only the first ``kept`` tasks; return the others."""
        rest = self.part(self.start + kept, self.stop)
        self.items = self.items[:kept]
        return rest

    def suspects(self, running: tuple[int, int] | None) -> range:
        """Tasks one of which was running: all without a result, if nothing else is known."""
        first, stop = self.start + self.received, self.stop
        if running is None or running[0] != self.seq:
            return range(first, stop)
        at = self.start + running[1]
        return range(max(first, at), max(first, min(stop, at + self.stride)))


class Worker:
    """What one worker holds.  ``left``: units that it may still be given (maxtasksperchild)."""

    __slots__ = ("had", "key", "leaving", "left", "lent", "pinned", "queue", "recalled", "since")

    def __init__(self, key: Any, left: int | None) -> None:
        self.key = key
        self.left = left
        self.queue: deque[Batch] = deque()
        self.had: deque[int] = deque(maxlen=HAD)  # batches that are over
        self.pinned: deque[tuple[Job, Span]] = deque()
        self.since = 0.0  # when it began what it does now
        self.recalled = False
        self.leaving = False
        self.lent = False  # a caller uses it directly

    def in_progress(self, unread: set[int], running: tuple[int, int] | None) -> Batch | None:
        """The batch that it was in when it died: it reads one at a time."""
        read = [batch for batch in self.queue if batch.seq not in unread]
        named = [batch for batch in read if running is not None and batch.seq == running[0]]
        return next(iter(named or read), None)


class Receipt(NamedTuple):
    """``size`` results that count: tasks of ``job`` from index ``start`` on."""

    job: Job
    start: int
    size: int
    batch: Batch

    def item(self, index: int) -> Any:
        """What the task ``index`` was made from."""
        return self.batch.items[index - self.batch.start]


class Loss(NamedTuple):
    """A task that was running in too many workers when they were lost."""

    job: Job
    task: int
    counts: Counts
    item: Any
