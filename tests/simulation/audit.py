"""Invariants of a ledger, checked after every event."""

from __future__ import annotations

import math
from collections.abc import Iterable
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Protocol

from fiber._engine.chunks import LIMIT
from fiber._engine.ledger import Ledger
from fiber._engine.load import CHECK_EVERY, LATE_AFTER, LATE_TIMES, RECALL_AFTER
from fiber._engine.tasks import Batch, Job, Loss, Receipt, WorkerEntry
from simulation.oracle import Account, Violation, require
from simulation.workers import Ref

if TYPE_CHECKING:
    from simulation.agents import Child
    from simulation.world import World

SLACK = 1e-3
"""Seconds after RECALL_AFTER until which an idle worker must have asked for an unread batch."""


PASSES = 3
"""Batches for each job and worker that others may get while a job waits for its turn."""


class Names(Protocol):
    """Meaning of the objects of the ledger's driver."""

    def account(self, job: Job) -> Account | None:
        """Whose job it is; None if it is that of many."""

    def ref(self, job: Job, index: int, item: Any) -> Ref:
        """Return the name of the task that ``item``, the ``index``-th of ``job``, is."""

    def child(self, worker: WorkerEntry) -> Child:
        """Return the simulated process of a worker."""


class Audit:
    """Checks each decision and the state of one ledger against the oracle."""

    def __init__(
        self,
        world: World,
        ledger: Ledger,
        names: Names,
    ) -> None:
        self._world = world
        self._ledger = ledger
        self._names = names
        self._watched: dict[WorkerEntry, float] = {}
        self._late: dict[Batch, float] = {}
        """Times at which late batches were first seen, with another unread behind each."""
        self._patience: dict[Job, int] = {}
        self._asked: set[WorkerEntry] = set()
        self._left: dict[WorkerEntry, int] = {}
        """Units that each may do, less those that it has done."""
        self._jobs: set[Job] = set()
        self._leased: set[WorkerEntry] = set()
        watched = {
            "open": self._open,
            "add": self._add,
            "assign": self._assign,
            "receive": self._receive,
            "retry": self._retry,
            "cancel": self._cancel,
            "leave": self._leave,
            "recall": self._recall,
            "put_back": self._put_back,
            "lose": self._lose,
            "lease": self._lease,
            "return_idle": self._return_idle,
            "return_busy": self._return_busy,
        }
        self._real = SimpleNamespace(**{name: getattr(ledger, name) for name in watched})
        vars(ledger).update(watched)

    # Each decision

    def _open(self, *args: Any, **options: Any) -> Job:
        job: Job = self._real.open(*args, **options)
        self._jobs.add(job)
        return job

    def _add(self, key: Any, now: float, left: int | None = None) -> WorkerEntry:
        worker: WorkerEntry = self._real.add(key, now, left)
        if left is not None:
            self._left[worker] = left
        return worker

    def _assign(self, now: float) -> Batch | None:
        pins = {
            (job, span.start): worker
            for worker in self._ledger._pins
            for job, span in worker.pinned
        }
        reached = {job: job.reached for job in self._ledger.jobs if job.paused}
        batch: Batch | None = self._real.assign(now)
        if batch is not None:
            worker = batch.worker
            assert batch.job is not None
            self._world.note(
                "%s gets batch %d, from task %d to before %d",
                self._names.child(worker).name,
                batch.seq,
                batch.start,
                batch.stop,
            )
            self._check_tasks(batch, batch.job)
            back = batch.stop <= reached.get(batch.job, batch.stop)
            require(back or batch.pin, "a task is begun though nobody reads results")
            require(worker in self._ledger.workers, "a worker that is gone is given a batch")
            require(not worker.leaving, "a worker that leaves is given a batch")
            require(not worker.leased, "a worker that is leased is given a batch")
            require(not worker.key.leaving, "a worker that was told to stop is given a batch")
            require(worker.queue[-1] is batch, "a batch is not the last one of its worker")
            pinned_to = pins.get((batch.job, batch.start))
            require(batch.pin is (pinned_to is not None), "a pinned task is not marked")
            require(pinned_to in (None, worker), "a task runs where it is not pinned to")
            if not batch.pin:
                self._check_turns(batch.job, worker)
        return batch

    def _check_turns(self, job: Job, given: WorkerEntry) -> None:
        """``job`` is given a worker: others that wait must get their turns."""
        workers = self._ledger.workers
        # Another one with a single batch is kept free for callers that need an idle worker.
        passed = not any(len(worker.queue) == 1 for worker in workers if worker is not given)
        waiting = [other for other in self._ledger.jobs if other.has_next and other is not job]
        fair = PASSES * (len(self._ledger.jobs) + len(workers))
        self._patience = {other: self._patience.get(other, fair) - passed for other in waiting}
        least = min(self._patience.values(), default=0)
        require(least >= 0, "a job waits while others get all the workers")

    def _check_tasks(self, batch: Batch, job: Job) -> None:
        require(1 <= len(batch.items) <= LIMIT, f"a batch has {len(batch.items)} tasks")
        if job.alone or batch.pin or not job.charges.limits.retries:
            require(len(batch.items) == 1, "tasks that travel alone share a batch")
            require(batch.alone, "a task that travels alone is not marked")
        account = self._names.account(job)
        if account is not None:
            require(not account.cancelled, "a cancelled job is given out")
            require(batch.pin is account.plan.everywhere, "a task is pinned, or not, by mistake")
            for index, item in enumerate(batch.items, batch.start):
                self._check_name(job, account, index, item)

    def _check_name(self, job: Job, account: Account, index: int, item: Any) -> None:
        ref = self._names.ref(job, index, item)
        require(ref == (account.number, index), f"{ref} is taken for task {index}")

    def _receive(self, worker: WorkerEntry, seq: int, *args: Any, **options: Any) -> Receipt | None:
        batch = self._ledger.batches.get(seq)
        receipt: Receipt | None = self._real.receive(worker, seq, *args, **options)
        if batch is not None and seq not in self._ledger.batches and batch.worker in self._left:
            self._left[batch.worker] -= batch.units
        account = self._names.account(receipt.job) if receipt is not None else None
        if receipt is not None and account is not None:
            for index in range(receipt.start, receipt.start + receipt.size):
                self._check_name(receipt.job, account, index, receipt.item(index))
        return receipt

    def _retry(self, receipt: Receipt, index: int) -> bool:
        again: bool = self._real.retry(receipt, index)
        if again:
            ref = self._names.ref(receipt.job, index, receipt.item(index))
            self._world.oracle.tried_again(ref)
        return again

    def _cancel(self, job: Job) -> list[WorkerEntry]:
        missing = job.fed - job.done
        unfinished = len(self._ledger.unfinished(job))
        require(unfinished == missing, f"{unfinished} tasks are unfinished, not {missing}")
        holders = {
            worker
            for worker in self._ledger.workers
            if any(batch.job is job for batch in list(worker.queue)[1:])
        }
        told: list[WorkerEntry] = self._real.cancel(job)
        self._jobs.discard(job)
        require(set(told) == holders, "unread batches of a cancelled job are not recalled")
        return told

    def _leave(self, worker: WorkerEntry) -> bool:
        busy = bool(worker.queue or worker.pinned)
        leaving = worker.leaving
        left: bool = self._real.leave(worker)
        require(
            left is not busy, "a busy worker leaves" if left else "an idle worker may not leave"
        )
        require(worker.leaving is (left or leaving), "a refusal to leave changes the worker")
        return left

    def _recall(self, now: float) -> list[WorkerEntry]:
        asked: list[WorkerEntry] = self._real.recall(now)
        self._asked.update(asked)
        return asked

    def _put_back(self, worker: WorkerEntry, seqs: Iterable[int], now: float) -> None:
        self._asked.discard(worker)
        self._real.put_back(worker, seqs, now)

    def _lose(
        self,
        worker: WorkerEntry,
        unread: Iterable[int],
        running: tuple[int, int] | None,
        disrupted: bool = False,
    ) -> list[Loss]:
        held = [
            (
                batch.job,
                batch.seq,
                at,
                batch.start + at,
                _charged(batch.job, batch.start + at),
                batch.items[at],
            )
            for batch in worker.queue
            if batch.job is not None
            for at in range(batch.received, len(batch.items))
        ]
        losses: list[Loss] = self._real.lose(worker, unread, running, disrupted)
        given_up = {(loss.job, loss.task): loss for loss in losses}
        for job, seq, offset, index, attempts, item in held:
            ref = self._names.ref(job, index, item)
            loss = given_up.get((job, index))
            now = sum(loss.counts) if loss is not None else _charged(job, index)
            require(attempts <= now <= attempts + 1, f"{ref} goes from {attempts} to {now}")
            require(loss is None or loss.item is item, "a loss names another task")
            self._check_charge(
                self._names.child(worker), seq, offset, ref, now > attempts, disrupted
            )
            if loss is not None:
                self._world.note("%s is given up", ref)
        return losses

    def _lease(self, worker: WorkerEntry) -> bool:
        idle = worker in self._ledger.idle()
        leased: bool = self._real.lease(worker)
        require(idle or not leased, "a worker is leased that is not idle")
        if leased:
            self._leased.add(worker)
        return leased

    def _return_idle(self, worker: WorkerEntry, now: float) -> None:
        self._check_return(worker)
        self._real.return_idle(worker, now)

    def _return_busy(
        self, worker: WorkerEntry, seq: int, job: Job | None, item: Any, now: float
    ) -> None:
        self._check_return(worker)
        require(seq not in self._ledger.batches, "two batches have the same number")
        self._real.return_busy(worker, seq, job, item, now)

    def _check_return(self, worker: WorkerEntry) -> None:
        require(worker in self._leased, "a worker is returned that was not leased")
        require(worker in self._ledger.workers, "a worker is returned that is gone")
        self._leased.discard(worker)

    def _check_charge(
        self, child: Child, seq: int, offset: int, ref: Ref, charged: bool, disrupted: bool
    ) -> None:
        if charged:
            self._world.oracle.blamed(child, seq, offset, ref, disrupted)
        else:
            self._world.oracle.spared(child, ref)

    # The whole

    def check(self) -> None:
        """Check that each task and worker is in its one place, and that none idles without need."""
        self._check_workers()
        forgotten = {job for job in self._jobs - self._ledger.jobs if not job.finished}
        require(not forgotten, "the ledger has forgotten a job")
        places: dict[Job, list[tuple[str, int, int]]] = {
            job: [
                ("waiting", stock.start + stock.position, len(stock))
                for stock in job.waiting._stocks
            ]
            for job in self._ledger.jobs
        }
        for batch in self._ledger.batches.values():
            if batch.job is not None:
                first = batch.start + batch.received
                places.setdefault(batch.job, []).append(("in a batch", first, batch.stop - first))
        pinned = [entry for worker in self._ledger.workers for entry in worker.pinned]
        for job, span in (*pinned, *self._ledger._unassigned_pins):
            places.setdefault(job, []).append(("pinned", span.start, len(span.items)))
        for job, where in places.items():
            account = self._names.account(job)
            if account is not None:
                _check_places(job, account, where)
        self._check_demand()
        self._check_idle()
        self._check_late()

    def _check_demand(self) -> None:
        wanted = workers_wanted(self._ledger)
        # A worker that runs a cancelled task takes no other.
        unwanted = sum(
            len(batch.items) - batch.received
            for batch in self._ledger.batches.values()
            if batch.job is None
        )
        demand = self._ledger.demand()
        fits = wanted <= demand <= wanted + unwanted
        require(fits, f"the demand is {demand}, not {wanted}, with {unwanted} cancelled tasks")

    def _check_workers(self) -> None:
        held = 0
        for worker in self._ledger.workers:
            held += len(worker.queue)
            child = self._names.child(worker)
            # Its user finds that out.
            require(worker.leased or not child.gone, f"{child.name} is gone, but not lost")
            require(not (worker.leased and worker.queue), f"{child.name} is leased and has a batch")
            require(len(worker.queue) <= 2, f"{child.name} has too many batches")
            for batch in worker.queue:
                require(self._ledger.batches.get(batch.seq) is batch, "an unknown batch is held")
                require(batch.worker is worker, "a batch is held by another worker")
            if worker in self._left:
                left = self._left[worker] - sum(batch.units for batch in worker.queue)
                require(worker.left == left, f"{child.name} has {worker.left} left, not {left}")
            if len(worker.queue) == 2:
                require(
                    not any(batch.alone for batch in worker.queue),
                    "something queues behind or before a task that travels alone",
                )
        require(held == len(self._ledger.batches), "a batch is with nobody")

    def _check_idle(self) -> None:
        idle = self._ledger.idle()
        if not idle:
            self._watched.clear()
            return
        since = [worker.since for worker in idle]
        require(since == sorted(since), "the idle are not in the order in which they became so")
        waiting = any(job.has_next for job in self._ledger.jobs)
        require(not waiting, "a task waits though a worker is idle")
        require(not any(worker.pinned for worker in idle), "a pinned task waits for nothing")
        now = self._world.loop.now()
        asked = 0
        late = []
        for worker in self._ledger.workers:
            if len(worker.queue) == 2 and not self._names.child(worker).agent.is_cut:
                if worker in self._asked:
                    asked += 1
                elif (
                    now
                    > max(worker.since, self._watched.setdefault(worker, now))
                    + RECALL_AFTER
                    + SLACK
                ):
                    late.append(worker)
                else:
                    self._world.loop.call_later(RECALL_AFTER + 2 * SLACK, self._check_idle)
        if late and asked < len(idle):
            raise Violation(
                f"{self._names.child(late[0]).name} keeps an unread batch from an idle worker"
            )

    def _check_late(self) -> None:
        """Check that no batch stays unread behind one that takes far longer than predicted.

        Without another worker it may stay.
        """
        now = self._world.loop.now()
        late: dict[Batch, float] = {}
        workers = self._ledger.workers
        for worker in workers - self._asked:
            if len(worker.queue) == 2 and len(workers) > 1:
                batch = worker.queue[0]
                if now > worker.since + max(LATE_AFTER, LATE_TIMES * batch.predicted()):
                    late[batch] = since = self._late.get(batch, now)
                    name = self._names.child(worker).name
                    require(now <= since + CHECK_EVERY + SLACK, f"{name} keeps an unread batch")
        self._late = late

    def check_end(self) -> None:
        """Check the ledger once no event is left."""
        ledger = self._ledger
        require(not ledger.batches, f"batches {list(ledger.batches)} are left over")
        require(not ledger.demand(), f"{ledger.demand()} tasks are left over")
        require(not any(job.closed for job in ledger.jobs), "a finished job is left over")
        require(not any(worker.queue for worker in ledger.workers), "a worker is left busy")
        require(ledger.starting == 0, f"{ledger.starting} workers never started")


def workers_wanted(ledger: Ledger) -> int:
    """Return how many workers the tasks could use that run or wait, cancelled ones left out."""
    pins = sum(len(worker.pinned) for worker in ledger.workers) + len(ledger._unassigned_pins)
    return pins + sum(map(_wanted, ledger.jobs))


def _wanted(job: Job) -> int:
    """Return how many workers the job's tasks could use that wait, or that workers have."""
    wanted = 0
    for stock in job.waiting._stocks:
        size = len(stock)
        if job.paused:
            wanted += max(0, min(size, job.reached - stock.start - stock.position))
        else:
            wanted += size if stock.alone else math.ceil(size / job.unit)
    open_tasks = sum(batch.stop - batch.start - batch.received for batch in job.batches)
    units = sum(math.ceil(len(batch.items) / job.unit) for batch in job.batches)
    return wanted + min(open_tasks, units)


def _check_places(job: Job, account: Account, places: list[tuple[str, int, int]]) -> None:
    """Each task is waiting, or in a batch, or done, and nowhere else."""
    number = account.number
    require(not account.cancelled, f"job {number} was cancelled, but the ledger keeps {places}")
    seen = account.delivered
    for place, start, size in places:
        tasks = (1 << size) - 1 << start
        if seen & tasks:
            raise Violation(f"tasks of job {number} from {start} on are {place} and elsewhere")
        seen |= tasks
    if seen != account.everything:
        raise Violation(f"tasks {account.everything & ~seen:b} of job {number} are nowhere")
    done = account.delivered.bit_count()
    require(job.done == done, f"job {number} counts {job.done}, not {done}, as done")


def _charged(job: Job, index: int) -> int:
    charges = job.charges
    return charges.deaths.get(index, 0) + charges.disruptions.get(index, 0)
