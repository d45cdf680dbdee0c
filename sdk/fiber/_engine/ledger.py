"""Which task is where: the paper's task queue and pending table in one pure object.

::

    feed ──► waiting ──assign──► sent to a worker ──receive──► done
                ▲                       │
                └── take_back, split, ──┘
                    lose, retry

* A **task** is one call, known by its job and its index in it.  At every moment it waits, is in exactly
  one batch, or is done; it becomes done once.
* A **batch** is a contiguous slice of one job's tasks, sent to one worker in one message and known by
  its sequence number.  What it brings back counts only while the ledger knows the number, so late,
  duplicate and foreign results fall off.
* A worker has at most one batch that it runs and one that it has not read yet.

No clock, no I/O: ``now`` is an argument; the caller sends what ``assign`` returns, kills, starts and
delivers.  Not thread-safe: one lock around it.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from fiber._engine.chunks import Pace
from fiber._engine.spans import Span, Waiting

PATIENCE = 2e-3
"""Seconds that a worker's current batch may take before idle workers ask for the one behind it."""


class Job:
    """The tasks of one call.  Made by ``Ledger.open``."""

    __slots__ = (
        "alone", "attempts", "closed", "done", "fed", "listed", "owner", "pace", "retries", "unit", "waiting"
    )

    def __init__(self, owner: Any, pace: Pace, retries: int, unit: int, alone: bool) -> None:
        self.owner = owner
        self.pace = pace
        self.retries = retries
        self.unit = unit
        self.alone = alone or retries == 0
        self.waiting = Waiting()
        self.attempts: dict[int, int] = {}
        self.fed = 0
        self.done = 0
        self.closed = False
        self.listed = False

    @property
    def finished(self) -> bool:
        """No task will come any more and all that came are done."""
        return self.closed and self.done == self.fed


class Batch:
    """A slice of a job's tasks in one message.  ``job`` is None once nobody wants its results."""

    __slots__ = ("alone", "items", "job", "pin", "received", "seq", "start", "stride", "worker")

    def __init__(self, seq: int, job: Job, worker: Worker, span: Span, stride: int) -> None:
        self.seq = seq
        self.job: Job | None = job
        self.worker = worker
        self.start = span.start
        self.items: Sequence[Any] = span.items
        self.alone = span.alone
        self.pin = span.pin
        self.stride = stride
        self.received = 0

    @property
    def units(self) -> int:
        """What this batch counts for maxtasksperchild."""
        return -(-len(self.items) // self.job.unit) if self.job else 0

    def rest(self) -> Span:
        """The tasks without a result."""
        return Span(self.start + self.received, self.items[self.received :], self.alone, self.pin)


class Worker:
    """What one worker holds.  ``left``: units that it may still be given (maxtasksperchild)."""

    __slots__ = ("key", "leaving", "left", "pinned", "queue", "recalled", "since")

    def __init__(self, key: Any, left: int | None) -> None:
        self.key = key
        self.left = left
        self.queue: deque[Batch] = deque()
        self.pinned: deque[tuple[Job, Span]] = deque()
        self.since = 0.0
        self.recalled = False
        self.leaving = False

    @property
    def spent(self) -> bool:
        """It did all that it may do, and can go."""
        return self.left == 0 and not self.queue


class Loss(NamedTuple):
    """A task that was running in too many workers when they died."""

    job: Job
    index: int
    attempts: int


class Receipt(NamedTuple):
    """Results that count: ``count`` tasks of ``job`` from ``start`` on, whose ``items`` they answer."""

    job: Job
    start: int
    items: Sequence[Any]


class Ledger:
    """The ledger of one pool."""

    def __init__(self) -> None:
        self.jobs: set[Job] = set()
        self.workers: set[Worker] = set()
        self.batches: dict[int, Batch] = {}
        self.starting = 0  # workers that will be added soon; kept by the caller
        self._seq = itertools.count(1)
        self._turns: deque[Job] = deque()
        # Insertion-ordered sets of the workers that may be given something, by what they hold.
        self._idle: dict[Worker, None] = {}
        self._single: dict[Worker, None] = {}
        self._deep: dict[Worker, None] = {}
        self._pins: dict[Worker, None] = {}

    # -- jobs ---------------------------------------------------------------------------------------

    def open(
        self, owner: Any = None, *, pace: Pace | None = None, retries: int = 3, unit: int = 1, alone: bool = False
    ) -> Job:
        """A new job.  ``unit``: its tasks are given out in contiguous chunks of at least this many.
        ``alone``: each task travels alone, to an idle worker, with nothing queued behind it."""
        job = Job(owner, pace or Pace(), retries, unit, alone)
        self.jobs.add(job)
        return job

    def feed(self, job: Job, items: Sequence[Any]) -> None:
        """More tasks for ``job``; ``items`` is sliced as it is sent, and must not change.

        A list is taken over: the ledger may append to it.
        """
        if job not in self.jobs or not len(items):
            return
        job.waiting.append(Span(job.fed, items, job.alone))
        job.fed += len(items)
        self._list(job)

    def pin(self, job: Job, worker: Worker, item: Any) -> None:
        """One more task for ``job``, which only ``worker`` may run."""
        span = Span(job.fed, [item], alone=True, pin=True)
        job.fed += 1
        self.pin_again(job, worker, span)

    def pin_again(self, job: Job, worker: Worker, span: Span) -> None:
        """Give a pinned task whose worker was lost to another one."""
        worker.pinned.append((job, span))
        self._pins[worker] = None

    def close(self, job: Job) -> bool:
        """No more tasks will be fed; True if the job is finished by that."""
        job.closed = True
        return self._finish(job)

    def cancel(self, job: Job) -> list[Worker]:
        """Forget a job: nothing of it is sent or counted any more.

        Returns the workers that hold unread batches of it, worth a ``take_back``.
        """
        job.waiting = Waiting()
        self.jobs.discard(job)
        holders = []
        for batch in self.batches.values():
            if batch.job is job:
                batch.job = None
                if batch.worker.queue[0] is not batch:
                    holders.append(batch.worker)
        for worker in list(self._pins):
            worker.pinned = deque(pinned for pinned in worker.pinned if pinned[0] is not job)
            if not worker.pinned:
                del self._pins[worker]
        return holders

    # -- workers ------------------------------------------------------------------------------------

    def add(self, key: Any, now: float, left: int | None = None) -> Worker:
        """A worker that is ready for work."""
        worker = Worker(key, left)
        worker.since = now
        self.workers.add(worker)
        self._shelve(worker)
        return worker

    def leave(self, worker: Worker) -> bool:
        """Give ``worker`` nothing more.  False, and nothing changed, if it is busy."""
        if worker.queue or worker.pinned:
            return False
        worker.leaving = True
        self._shelve(worker)
        return True

    @property
    def idle(self) -> list[Worker]:
        """Workers with nothing to do, the one that has been so for longest first."""
        return list(self._idle)

    def demand(self) -> int:
        """Tasks that wait or run, capped at what is worth asking: the number of workers that could be used."""
        return sum(len(job.waiting) for job in self._turns) + sum(
            len(batch.items) - batch.received for batch in self.batches.values()
        )

    # -- giving -------------------------------------------------------------------------------------

    def assign(self, now: float) -> Batch | None:
        """The next batch to send, or None when no worker may be given anything.

        Idle workers come first, the last used before others; jobs take turns.
        """
        if self._pins and (batch := self._assign_pinned(now)):
            return batch
        for _ in range(len(self._turns)):
            job = self._turns[0]
            if not job.waiting:
                job.listed = False
                self._turns.popleft()
                continue
            self._turns.rotate(-1)
            if (worker := self._worker_for(job)) is not None:
                return self._cut(job, worker, now)
        return None

    def _assign_pinned(self, now: float) -> Batch | None:
        for worker in self._pins:
            if worker in self._idle:
                job, span = worker.pinned.popleft()
                if not worker.pinned:
                    del self._pins[worker]
                return self._send(job, worker, span, now)
        return None

    def _worker_for(self, job: Job) -> Worker | None:
        if self._idle:
            return next(reversed(self._idle))
        if job.waiting.first_alone() or len(job.waiting) <= self.starting or job.pace.depth() < 2:
            return None
        return next(iter(self._single), None)

    def _cut(self, job: Job, worker: Worker, now: float) -> Batch:
        size = job.pace.batch_size(len(job.waiting), len(self.workers) + self.starting or 1, job.unit)
        if worker.left is not None:
            size = min(size, worker.left * job.unit)
        return self._send(job, worker, job.waiting.take(size), now)

    def _send(self, job: Job, worker: Worker, span: Span, now: float) -> Batch:
        batch = Batch(next(self._seq), job, worker, span, job.pace.stride())
        self.batches[batch.seq] = batch
        if not worker.queue:
            worker.since = now
        worker.queue.append(batch)
        if worker.left is not None:
            worker.left -= min(batch.units, worker.left)
        self._shelve(worker)
        return batch

    # -- taking -------------------------------------------------------------------------------------

    def receive(
        self, seq: int, offset: int, count: int, now: float, *, seconds: float = 0.0, kept: int | None = None
    ) -> Receipt | None:
        """``count`` results of batch ``seq``, its tasks from ``offset`` on; None if they do not count.

        ``seconds`` is what they took.  ``kept``: the worker keeps only that many tasks of the batch and
        gives the rest back.
        """
        batch = self.batches.get(seq)
        if batch is None or offset != batch.received or offset + count > len(batch.items):
            return None
        receipt = None
        job = batch.job
        if job is not None:
            receipt = Receipt(job, batch.start + offset, batch.items[offset : offset + count])
            job.done += count
            job.pace.observe(count, seconds)
        batch.received += count
        if kept is not None:
            self._cut_short(batch, kept)
        if batch.received == len(batch.items):
            self._close_batch(batch, now)
        if job is not None:
            self._finish(job)
        return receipt

    def _cut_short(self, batch: Batch, kept: int) -> None:
        kept = max(kept, batch.received)
        rest = batch.items[kept:]
        if not len(rest):
            return
        units = batch.units
        batch.items = batch.items[:kept]
        if batch.job is not None:
            self._return(batch.job, Span(batch.start + kept, rest))
        if batch.worker.left is not None:
            batch.worker.left += units - batch.units

    def _close_batch(self, batch: Batch, now: float) -> None:
        del self.batches[batch.seq]
        worker = batch.worker
        worker.queue.remove(batch)
        worker.since = now
        self._shelve(worker)

    def retry(self, receipt: Receipt, index: int) -> bool:
        """Run a task again whose result was received but is not good enough.  False: it had its tries."""
        job = receipt.job
        if job not in self.jobs and not job.finished:
            return False  # cancelled
        if not self._charge(job, index):
            return False
        job.done -= 1
        self.jobs.add(job)
        self._return(job, Span(index, [receipt.items[index - receipt.start]], alone=True))
        return True

    def put_back(self, worker: Worker, seqs: Iterable[int], now: float) -> None:
        """The answer to a recall: these batches were never read by ``worker``."""
        worker.recalled = False
        for batch in sorted(self._held(worker, seqs), key=_by_seq, reverse=True):
            self._withdraw(batch, now)
            if batch.job is not None:
                self._return(batch.job, batch.rest())

    def split(self, seq: int, now: float) -> Receipt | None:
        """The worker could not read the message: send its tasks again, one by one, to find the culprit.

        A batch of one is the culprit: then it counts as done, and the receipt says whose it is.
        """
        batch = self.batches.get(seq)
        if batch is None:
            return None
        if len(batch.items) == 1:
            return self.receive(seq, 0, 1, now)
        self._withdraw(batch, now)
        if batch.job is not None:
            for span in reversed(batch.rest().singly()):
                self._return(batch.job, span)
        return None

    def expire(self, seq: int) -> Receipt | None:
        """The task of batch ``seq`` (sent alone) ran out of time: done, while its worker still runs it."""
        batch = self.batches.get(seq)
        if batch is None or batch.job is None:
            return None
        job, batch.job = batch.job, None
        job.done += 1
        self._finish(job)
        return Receipt(job, batch.start, batch.items)

    def recall(self, now: float) -> list[Worker]:
        """Workers to ask for the batch that they have not read, since others have nothing to do."""
        if not self._idle or any(job.waiting for job in self._turns):
            return []
        victims = []
        for worker in itertools.islice(self._deep, len(self._idle)):
            if now - worker.since >= PATIENCE and not worker.recalled:
                worker.recalled = True
                victims.append(worker)
        return victims

    def next_recall(self) -> float | None:
        """When ``recall`` could next return something, if nothing else happens."""
        if not self._idle or not self._deep:
            return None
        return min((w.since + PATIENCE for w in itertools.islice(self._deep, len(self._idle)) if not w.recalled),
                   default=None)

    # -- losing -------------------------------------------------------------------------------------

    def lose(
        self, worker: Worker, unread: Iterable[int], running: tuple[int, int] | None
    ) -> tuple[list[Loss], list[tuple[Job, Span]]]:
        """``worker`` is gone.  Its tasks wait again; those it was running are charged an attempt.

        ``unread``: batches that it never read.  ``running``: batch and offset of the task it was in.
        Returns the tasks that had their tries, which are done by that, and the pinned ones, which need
        another worker (``pin_again``).
        """
        self.workers.discard(worker)
        worker.leaving = True
        untouched = {id(batch) for batch in self._held(worker, unread)}
        losses: list[Loss] = []
        homeless = list(worker.pinned)
        for batch in sorted(worker.queue, key=_by_seq, reverse=True):
            del self.batches[batch.seq]
            job = batch.job
            if job is None:
                continue
            suspects = range(0) if id(batch) in untouched else _suspects(batch, running)
            for span in reversed(_around(batch.rest(), suspects)):
                if span.start in suspects and not self._charge(job, span.start):
                    losses.append(Loss(job, span.start, job.attempts.pop(span.start)))
                    job.done += 1
                elif span.pin:
                    homeless.append((job, span))
                else:
                    self._return(job, span)
            self._finish(job)
        worker.queue.clear()
        worker.pinned.clear()
        self._pins.pop(worker, None)
        self._shelve(worker)
        losses.reverse()
        return losses, homeless

    # -- inside -------------------------------------------------------------------------------------

    def _held(self, worker: Worker, seqs: Iterable[int]) -> list[Batch]:
        found = (self.batches.get(seq) for seq in seqs)
        return [batch for batch in found if batch is not None and batch.worker is worker]

    def _withdraw(self, batch: Batch, now: float) -> None:
        worker = batch.worker
        if worker.left is not None:
            worker.left += batch.units
        self._close_batch(batch, now if worker.queue[0] is batch else worker.since)

    def _charge(self, job: Job, index: int) -> bool:
        """Count one more lost run; False if that was the last one allowed."""
        job.attempts[index] = attempts = job.attempts.get(index, 0) + 1
        return attempts <= job.retries

    def _return(self, job: Job, span: Span) -> None:
        span.alone = span.alone or job.alone
        job.waiting.appendleft(span)
        self._list(job)

    def _list(self, job: Job) -> None:
        if not job.listed:
            job.listed = True
            self._turns.append(job)

    def _finish(self, job: Job) -> bool:
        if job.finished:
            self.jobs.discard(job)
        return job.finished

    def _shelve(self, worker: Worker) -> None:
        """Put the worker where ``assign`` looks for one that holds as much as it does."""
        self._idle.pop(worker, None)
        self._single.pop(worker, None)
        queue = worker.queue
        if len(queue) < 2:
            self._deep.pop(worker, None)
        elif worker not in self._deep:
            self._deep[worker] = None
        if worker.leaving or worker.left == 0:
            return
        if not queue:
            self._idle[worker] = None
        elif len(queue) == 1 and not queue[0].alone and not worker.pinned:
            self._single[worker] = None


def _by_seq(batch: Batch) -> int:
    return batch.seq


def _suspects(batch: Batch, running: tuple[int, int] | None) -> range:
    """Indexes of the tasks one of which was running: all that have no result, if nothing is known."""
    first, end = batch.start + batch.received, batch.start + len(batch.items)
    if running is None or running[0] != batch.seq:
        return range(first, end)
    at = batch.start + running[1]
    return range(max(first, at), min(end, at + batch.stride))


def _around(span: Span, suspects: range) -> list[Span]:
    """``span`` in pieces: what lies before the suspects, each of them alone, what lies behind."""
    if not suspects:
        return [span]
    first, last = suspects.start - span.start, suspects.stop - span.start
    pieces = [Span(span.start, span.items[:first], span.alone, span.pin)] if first else []
    pieces += Span(suspects.start, span.items[first:last], span.alone, span.pin).singly()
    if last < len(span.items):
        pieces.append(Span(suspects.stop, span.items[last:], span.alone, span.pin))
    return pieces
