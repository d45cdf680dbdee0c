"""Ledger of all tasks: the task queue and the pending table of uber's paper on Fiber.

::

    feed ──► waiting ──assign──► in a batch ──receive──► done
                ▲                     │
                └─ put_back, split, ──┘
                   lose, retry

* A **task** is one call, identified by its job and its index in the job.  At every moment it
  waits, is in exactly one batch, or is done.
* A **batch** is a contiguous slice of one job's tasks, sent to one worker in one message.  Its
  sequence number identifies it.  Results count only from the worker that has the batch, and only
  in order.  Late and repeated results are ignored; others raise WrongAnswer.
* A **worker** has at most one batch that it runs and one that it has not read yet.

Pure: ``now`` is an argument, and the caller sends the batches that ``assign`` returns.  Not
thread-safe: the executor calls it on the loop thread.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter
from typing import Any

from fiber._engine.chunks import TaskPace
from fiber._engine.load import WorkersByLoad
from fiber._engine.tasks import (
    Batch,
    Job,
    JobTurns,
    Limits,
    Loss,
    Receipt,
    RunningTask,
    Span,
    WaitingTasks,
    WorkerEntry,
    WrongAnswer,
)

LOOKAHEAD = 4
"""Number of jobs that wait for an idle worker while a later job queues a batch at a busy one."""

_by_seq = attrgetter("seq")


class Ledger:
    """Ledger of one pool.

    The scheduler sets ``starting``, the number of workers that will be added soon.
    """

    def __init__(self) -> None:
        self.jobs: set[Job] = set()
        self.workers: set[WorkerEntry] = set()
        self.batches: dict[int, Batch] = {}
        self.starting = 0
        self.leased = 0  # number of workers that callers lease
        self._open_tasks = 0  # number of tasks of ``jobs`` that are fed and not done
        self._seq = itertools.count(1)
        self._turns = JobTurns()
        self._with_surplus: set[Job] = set()  # those of ``jobs`` that are paused or have chunks
        self._load = WorkersByLoad()
        self._pins: dict[WorkerEntry, None] = {}
        self._unassigned_pins: list[tuple[Job, Span]] = []
        self._cancelled: set[Batch] = set()

    # Jobs

    def open(
        self,
        owner: Any = None,
        *,
        pace: TaskPace | None = None,
        limits: Limits = Limits(),  # noqa: B008 - immutable
        unit: int = 1,
        alone: bool = False,
        eager: bool = False,
    ) -> Job:
        """Open a new job; ``limits`` says how often a task of it runs again.

        ``unit``: smallest chunk of contiguous tasks in a batch.  ``alone``: each task travels
        alone, to an idle worker, with no batch queued behind it.  A job without retries does so
        too, since after a crash it must be known which task had run.  ``eager``: results are wanted
        one by one, and the worker notes each task that it begins.
        """
        job = Job(owner, pace or TaskPace(), limits, unit, alone, eager)
        self._list(job)
        return job

    def feed(self, job: Job, items: Sequence[Any]) -> None:
        """Add tasks to ``job``; ``items`` is sliced when it is sent and must not change.

        The ledger takes over a list and may append to it.
        """
        if job not in self.jobs or not len(items):
            return
        job.waiting.append(Span(job.fed, items, job.alone))
        self._add_fed(job, len(items))
        self._turns.give(job)

    def pin(self, job: Job, worker: WorkerEntry | None, item: Any) -> None:
        """Add a task to ``job`` for this worker alone; for a later worker if it is None or lost."""
        span = Span(job.fed, [item], alone=True, pin=True)
        self._add_fed(job, 1)
        if worker is None:
            self._unassigned_pins.append((job, span))
        else:
            self._pin(job, worker, span)

    def _pin(self, job: Job, worker: WorkerEntry, span: Span) -> None:
        worker.pinned.append((job, span))
        self._pins[worker] = None
        job.pins[worker] = None
        self._load.sort_pinned(worker)

    def close(self, job: Job) -> bool:
        """Close the job to further tasks; return True if that finishes it."""
        job.closed = True
        return self._drop_if_finished(job)

    def unfinished(self, job: Job) -> list[Any]:
        """Return the items of the job's tasks that are not done."""
        spans = [batch.rest() for batch in job.batches]
        pinned = itertools.chain(self._unassigned_pins, *(worker.pinned for worker in job.pins))
        spans += [span for owner, span in pinned if owner is job]
        return [*job.waiting.items(), *itertools.chain.from_iterable(s.items for s in spans)]

    def cancel(self, job: Job) -> list[WorkerEntry]:
        """Forget a job: its tasks are not sent, and its results do not count.

        Return the workers that hold unread batches of it, which are worth a recall.
        """
        job.waiting = WaitingTasks()
        if job in self.jobs:
            self.jobs.discard(job)
            self._with_surplus.discard(job)
            self._open_tasks -= job.fed - job.done
        holders = []
        for batch in job.batches:
            batch.job = None
            self._cancelled.add(batch)
            if batch.worker.queue[0] is not batch:
                holders.append(batch.worker)
        job.batches.clear()
        for worker in job.pins:
            worker.pinned = deque(pinned for pinned in worker.pinned if pinned[0] is not job)
            if not worker.pinned:
                self._pins.pop(worker, None)
                self._load.sort_pinned(worker)
        job.pins.clear()
        if self._unassigned_pins:
            self._unassigned_pins = [pin for pin in self._unassigned_pins if pin[0] is not job]
        return holders

    def pause(self, job: Job, paused: bool) -> None:
        """Hold back the tasks of a job that no worker has had yet; or end the pause."""
        job.paused = paused
        if job in self.jobs:
            self._list(job)
        if not paused and job.waiting:
            self._turns.give(job)

    # Workers

    def add(self, key: Any, now: float, left: int | None = None) -> WorkerEntry:
        """Add a worker that is ready for ``left`` units of work (None: any number)."""
        worker = WorkerEntry(key, left)
        worker.since = now
        self.workers.add(worker)
        self._assign_pins(worker)
        self._load.sort(worker)
        return worker

    def _assign_pins(self, worker: WorkerEntry) -> None:
        """Give a new worker the pinned tasks of a lost one, at most one of each job."""
        remaining = []
        for job, span in self._unassigned_pins:
            if any(job is pinned[0] for pinned in worker.pinned):
                remaining.append((job, span))
            else:
                self._pin(job, worker, span)
        self._unassigned_pins = remaining

    def leave(self, worker: WorkerEntry) -> bool:
        """Give ``worker`` no more tasks; return False, and change nothing, if it is busy."""
        if worker.queue or worker.pinned:
            return False
        self.retire(worker)
        self._load.spent.pop(worker, None)
        return True

    def spent(self) -> list[WorkerEntry]:
        """Return the workers that have used up their ``left`` units; they get no more tasks."""
        spent, self._load.spent = list(self._load.spent), {}
        for worker in spent:
            self.retire(worker)
        return spent

    def retire(self, worker: WorkerEntry) -> None:
        """Give a leaving worker no more tasks; a later worker gets the tasks pinned to it."""
        worker.leaving = True
        self._unassigned_pins += worker.pinned
        worker.pinned.clear()
        self._pins.pop(worker, None)
        self._load.sort(worker)

    def newcomers_wanted(self) -> int:
        """Return how many tasks only a new worker may run."""
        return len(self._unassigned_pins)

    def jobs_for_newcomers(self) -> set[Job]:
        """Return the jobs with tasks that only a new worker may run."""
        return {job for job, _ in self._unassigned_pins}

    def idle(self) -> list[WorkerEntry]:
        """Return the idle workers, the longest idle first."""
        return list(self._load.idle)

    def idle_count(self) -> int:
        """Return the number of idle workers."""
        return len(self._load.idle)

    def longest_idle(self) -> WorkerEntry | None:
        """Return the worker that has been idle for longest."""
        return next(iter(self._load.idle), None)

    def demand(self) -> int:
        """Return how many workers the tasks could use that run or wait.

        The tasks of a chunk that the user asked for count as one, and tasks that a pause holds back
        as none.  A cancelled batch that a worker still has counts as one.
        """
        surplus = sum([job.surplus for job in self._with_surplus]) if self._with_surplus else 0
        return self._open_tasks - surplus + len(self._cancelled)

    def has_assignable(self) -> bool:
        """Return True if a worker may get a task."""
        return bool(self._turns or self._pins)

    # Assigning

    def assign(self, now: float) -> Batch | None:
        """Return the next batch to send; None if no worker may get one.

        Idle workers come first; jobs take turns.
        """
        if self._load.idle_pinned:
            return self._assign_pinned(now)
        turns = self._turns
        if not turns or not (self._load.idle or self._load.queueable):
            return None
        passed = 0
        while passed < len(turns) and passed <= min(len(self._load.queueable), LOOKAHEAD):
            job = turns[passed]
            waits = job.has_next
            worker = self._worker_for(job, passed) if waits else None
            if worker is None and waits:
                passed += 1  # the job keeps its turn and reserves a worker
                continue
            del turns[passed]
            batch = self._send_next(job, worker, now) if worker is not None else None
            job.listed = job.has_next
            if job.listed:
                turns.append(job)
            if batch is not None:
                return batch
        return None

    def _assign_pinned(self, now: float) -> Batch:
        worker = next(iter(self._load.idle_pinned))
        job, span = worker.pinned.popleft()
        if not worker.pinned:
            del self._pins[worker]
        return self._send(job, worker, span, now)

    def _worker_for(self, job: Job, passed: int) -> WorkerEntry | None:
        """Return a worker that may get tasks of ``job``.

        ``passed`` earlier jobs wait for an idle worker.  So as many workers that will soon be idle
        are reserved for them.
        """
        idle = self._load.last_idle()
        if idle is not None:
            return idle
        if job.waiting.first_alone() or not job.pace.may_queue(len(job.waiting)):
            return None
        # Tasks that a starting worker can run should not queue behind a batch of another.
        if self.starting and len(job.waiting) <= self.starting:
            return None
        return self._load.queueable_after(passed)

    def _send_next(self, job: Job, worker: WorkerEntry, now: float) -> Batch:
        waiting = len(job.waiting)
        size = 1
        if waiting > 1:
            workers = len(self.workers) + self.starting
            size = job.pace.batch_size(waiting, workers, job.unit, job.target)
        if job.paused:  # a span may mix tasks that came back with tasks that are held back
            size = min(size, job.reached - job.waiting.first())
        if worker.left is not None:
            size = min(size, worker.left * job.unit)
        return self._send(job, worker, job.waiting.take(size), now)

    def _send(self, job: Job, worker: WorkerEntry, span: Span, now: float) -> Batch:
        batch = Batch(self.next_seq(), job, worker, span)
        if worker.left is not None:
            worker.left -= min(batch.units, worker.left)
        self._hold(batch, now)
        return batch

    def _hold(self, batch: Batch, now: float) -> None:
        worker = batch.worker
        self.batches[batch.seq] = batch
        if batch.job is not None:
            batch.job.hold(batch)
        if not worker.queue:
            worker.since = now
        worker.queue.append(batch)
        self._load.sort(worker)

    # Leases

    def next_seq(self) -> int:
        """Return a new sequence number.  Any thread may call this."""
        return next(self._seq)

    def lease(self, worker: WorkerEntry) -> bool:
        """Lease an idle worker to callers, who send it calls directly; False if it is not idle."""
        if worker not in self._load.idle or worker.left is not None:
            return False
        worker.leased = True
        self.leased += 1
        self._load.sort(worker)
        return True

    def expect_late(self, worker: WorkerEntry, seq: int) -> None:
        """Accept the answer of a worker to a call that its caller has given up."""
        worker.ended_seqs.append(seq)

    def return_idle(self, worker: WorkerEntry, now: float) -> None:
        """Take back a leased worker, which is idle."""
        self._end_lease(worker)
        worker.since = now
        self._load.sort(worker)

    def return_busy(
        self, worker: WorkerEntry, seq: int, job: Job | None, item: Any, now: float
    ) -> None:
        """Take back a leased worker that runs the call sent as ``seq``.

        From now on the call is a task of ``job``; None: its result does not count.
        """
        self._end_lease(worker)
        start = 0 if job is None else job.fed
        batch = Batch(seq, job, worker, Span(start, [item], alone=True))
        if job is None:
            self._cancelled.add(batch)
        else:
            self._add_fed(job, 1)
        self._hold(batch, now)

    def _end_lease(self, worker: WorkerEntry) -> None:
        if worker.leased:
            worker.leased = False
            self.leased -= 1

    # Receiving

    def held(self, worker: WorkerEntry, seq: int) -> Batch | None:
        """Return the batch that ``worker`` answers for, or None if the batch is over.

        Raise WrongAnswer if the worker never had it.
        """
        batch = self.batches.get(seq)
        if batch is not None and batch.worker is worker:
            return batch
        if worker not in self.workers or (batch is None and seq in worker.ended_seqs):
            return None
        owner = "which it never had" if batch is None else "which another worker has"
        raise WrongAnswer(f"it answered for batch {seq}, {owner}")

    def receive(
        self,
        worker: WorkerEntry,
        seq: int,
        offset: int,
        count: int,
        now: float,
        *,
        seconds: float = 0.0,
        kept: int | None = None,
    ) -> Receipt | None:
        """Take ``count`` results of batch ``seq``, from task ``offset`` on, which took ``seconds``.

        Return None if they do not count.  Raise WrongAnswer if ``worker`` cannot have them.
        ``kept``: the worker keeps that many tasks of the batch, and gives the others back.
        """
        batch = self.held(worker, seq)
        if batch is None or not batch.take(offset, count, kept):
            return None
        job, received = batch.job, batch.received
        if job is not None:
            self._add_done(job, count)
            job.pace.observe(count, seconds)
        if kept is not None:
            self._cut_short(batch, kept)
        if received == len(batch.items):
            self._close_batch(batch, now)
        if job is None:
            return None
        self._drop_if_finished(job)
        return Receipt(job, batch.start + offset, count, batch)

    def _cut_short(self, batch: Batch, kept: int) -> None:
        if kept == len(batch.items):
            return
        units = batch.units
        rest = batch.cut(kept)
        if batch.worker.left is not None:
            batch.worker.left += units - batch.units
        if batch.job is not None:
            self._requeue(batch.job, rest)

    def _close_batch(self, batch: Batch, now: float) -> None:
        self._end_batch(batch)
        worker = batch.worker
        if worker.queue[0] is batch:
            worker.since = now
        worker.queue.remove(batch)
        self._load.sort(worker)

    def _end_batch(self, batch: Batch) -> None:
        del self.batches[batch.seq]
        batch.worker.ended_seqs.append(batch.seq)
        self._cancelled.discard(batch)
        if batch.job is not None:
            batch.job.release(batch)

    def retry(self, receipt: Receipt, index: int) -> bool:
        """Run a task again because of its result; return False if it has no tries left."""
        job = receipt.job
        if job not in self.jobs and not job.finished:
            return False  # cancelled
        if not job.charges.charge(index):
            return False
        if job not in self.jobs:  # the job was finished by this task
            self._list(job)
            self._open_tasks += job.fed - job.done
        self._add_done(job, -1)
        span = Span(index, [receipt.item(index)], True, receipt.batch.pin)
        if span.pin:
            self._pin(job, receipt.batch.worker, span)
        else:
            self._requeue(job, span)
        return True

    def put_back(self, worker: WorkerEntry, seqs: Iterable[int], now: float) -> None:
        """Take back batches that ``worker`` never read: the answer to a recall."""
        worker.recalled = False
        held = (self.batches.get(seq) for seq in seqs)
        unread = [batch for batch in held if batch is not None and batch.worker is worker]
        for batch in sorted(unread, key=_by_seq, reverse=True):
            self._withdraw(batch, now)
            if batch.job is not None:
                batch.job.waiting.put_back(batch.rest())
                self._turns.give_first(batch.job)
        if len(worker.queue) > 1:
            self._load.sort(worker)

    def drop_waiting(self, job: Job, wanted: Callable[[Any], bool]) -> None:
        """Count waiting tasks that are no longer ``wanted`` as done."""
        self._add_done(job, job.drop_waiting(wanted))
        self._drop_if_finished(job)

    def split(self, seq: int, now: float) -> Receipt | None:
        """Queue the tasks of a batch again, to be sent one by one: its worker cannot unpickle it.

        If the batch has one task, that task is at fault: it is done, and the receipt names it.
        """
        batch = self.batches.get(seq)
        if batch is None:
            return None
        if len(batch.items) == 1:
            return self.receive(batch.worker, seq, 0, 1, now)
        self._withdraw(batch, now)
        if batch.job is not None:
            for span in reversed(batch.rest().singly()):
                self._requeue(batch.job, span)
        return None

    def expire(self, seq: int) -> Receipt | None:
        """End the task that was sent alone as batch ``seq``: its time limit has passed.

        The worker still runs it, and gets no more tasks.  None if its result does not count.
        """
        batch = self.batches.get(seq)
        if batch is None:
            return None
        self.retire(batch.worker)
        job, batch.job = batch.job, None
        if job is None:
            return None
        job.release(batch)
        self._add_done(job, 1)
        self._drop_if_finished(job)
        return Receipt(job, batch.start, 1, batch)

    def recall(self, now: float) -> list[WorkerEntry]:
        """Return the workers whose unread batch is to be recalled.

        The batch before it is late, or a worker is idle.
        """
        late = self._load.recall_from_late(now, alone=len(self.workers) < 2)
        if not self._load.idle or any(job.has_next for job in self._turns):
            return late
        return late + self._load.recall(now)

    def next_recall(self) -> float | None:
        """Return the time of the next recall, if no event comes before; None if there is none."""
        return self._load.next_recall()

    # Deaths of workers

    def lose(
        self,
        worker: WorkerEntry,
        unread: Iterable[int],
        running: RunningTask | None,
        disrupted: bool = False,
    ) -> list[Loss]:
        """Remove a worker that is gone: its tasks wait again, and its running task is charged.

        ``unread``: batches that it never read.  ``running``: None if it is unknown; then the first
        batch that it may have read counts.  ``disrupted``: the cluster ended it.  Return the tasks
        that have no tries left; they are done.
        """
        self.workers.discard(worker)
        self._end_lease(worker)
        in_progress = worker.in_progress(set(unread), running)
        losses: list[Loss] = []
        for batch in sorted(worker.queue, key=_by_seq, reverse=True):
            self._end_batch(batch)
            if batch.job is not None:
                suspects = batch.suspects(running) if batch is in_progress else range(0)
                again, lost = batch.job.lose(batch.rest(), suspects, disrupted=disrupted)
                losses += lost
                self._run_again(batch.job, again, len(lost))
        worker.queue.clear()
        self.retire(worker)
        self._load.spent.pop(worker, None)
        return losses[::-1]

    def _run_again(self, job: Job, spans: list[Span], lost_tasks: int) -> None:
        self._add_done(job, lost_tasks)
        for span in spans:
            if span.pin:
                self._unassigned_pins.append((job, span))
            else:
                self._requeue(job, span)
        self._drop_if_finished(job)

    # Steps of the methods above

    def _add_fed(self, job: Job, tasks: int) -> None:
        job.fed += tasks
        self._open_tasks += tasks

    def _add_done(self, job: Job, tasks: int) -> None:
        """Count tasks of the job that are done (negative: that run again)."""
        job.done += tasks
        if job in self.jobs:
            self._open_tasks -= tasks

    def _withdraw(self, batch: Batch, now: float) -> None:
        if batch.worker.left is not None:
            batch.worker.left += batch.units
        self._close_batch(batch, now)

    def _requeue(self, job: Job, span: Span) -> None:
        job.waiting.appendleft(span)
        self._turns.give(job)

    def _drop_if_finished(self, job: Job) -> bool:
        if job.finished:
            self.jobs.discard(job)
            self._with_surplus.discard(job)
        return job.finished

    def _list(self, job: Job) -> None:
        self.jobs.add(job)
        if job.paused or job.unit > 1:
            self._with_surplus.add(job)
        else:
            self._with_surplus.discard(job)
