"""What must hold inside a ledger, looked at after every event."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from fiber._engine.chunks import LIMIT
from fiber._engine.ledger import PATIENCE, Batch, Job, Ledger, Loss, Receipt, Worker
from simulation.oracle import Account, Violation
from simulation.workers import Ref

if TYPE_CHECKING:
    from simulation.agents import Child
    from simulation.schedule import Act
    from simulation.world import World

SLACK = 1e-3
"""Seconds after PATIENCE until which an idle worker must have asked for an unread batch."""

Held = list[tuple[Job, int, int, int, Ref, int]]


class Audit:
    """Checks one ledger against what the oracle knows."""

    def __init__(self, world: World, ledger: Ledger) -> None:
        self._world = world
        self._oracle = world.oracle
        self._ledger = ledger
        self._watched: dict[Worker, float] = {}
        self._pins: dict[tuple[Job, int], Worker] = {}

    # Each decision

    def before_assignment(self) -> None:
        """The ledger is about to be asked what to give."""
        self._pins = {
            (job, span.start): worker
            for worker in self._ledger._pins
            for job, span in worker.pinned
        }

    def assigned(self, batch: Batch) -> None:
        """The ledger gives ``batch`` to its worker."""
        worker = batch.worker
        account: Account | None = batch.job and batch.job.owner
        _require(account is not None and not account.cancelled, "a cancelled job is given out")
        assert account is not None
        _require(worker in self._ledger.workers, "a worker that is gone is given a batch")
        _require(not worker.leaving, "a worker that leaves is given a batch")
        _require(not worker.key.leaving, "a worker that was told to stop is given a batch")
        _require(worker.queue[-1] is batch, "a batch is not the last one of its worker")
        _require(1 <= len(batch.items) <= LIMIT, f"a batch has {len(batch.items)} tasks")
        expected = [Ref(account.number, index) for index in range(batch.start, batch.stop)]
        _require(list(batch.items) == expected, f"batch {batch.seq} carries other tasks")
        if account.plan.everywhere:
            pinned = self._pins.get((batch.job, batch.start)) is worker
            _require(pinned and batch.pin, "a task runs where it is not pinned to")
        if account.plan.alone or account.plan.everywhere or not account.plan.retries:
            _require(len(batch.items) == 1, "tasks that travel alone share a batch")
            _require(batch.alone, "a task that travels alone is not marked")

    def received(self, receipt: Receipt, tasks: Sequence[tuple[Ref, Act]]) -> None:
        """The ledger takes results."""
        account: Account = receipt.job.owner
        indexes = range(receipt.start, receipt.start + receipt.size)
        expected = [Ref(account.number, index) for index in indexes]
        _require([ref for ref, _ in tasks] == expected, "results are booked for other tasks")
        _require([receipt.item(index) for index in indexes] == expected, "a receipt's items differ")

    def dropped(self, receipt: Receipt | None) -> None:
        """The ledger hears from a worker that was given up."""
        _require(receipt is None, "a late result counts")

    def cancel(self, job: Job) -> list[Worker]:
        """Cancel ``job``."""
        account: Account = job.owner
        missing = account.everything & ~account.delivered
        expected = {Ref(account.number, at) for at in range(account.fed) if missing >> at & 1}
        unfinished = self._ledger.unfinished(job)
        _require(len(unfinished) == len(expected), "the unfinished tasks are miscounted")
        _require(set(unfinished) == expected, "other tasks are said to be unfinished")
        holders = {
            worker
            for worker in self._ledger.workers
            if any(batch.job is job for batch in list(worker.queue)[1:])
        }
        told = self._ledger.cancel(job)
        _require(set(told) == holders, "unread batches of a cancelled job are not recalled")
        return told

    def leave(self, worker: Worker) -> bool:
        """Ask ``worker`` to leave."""
        busy = bool(worker.queue or worker.pinned)
        leaving = worker.leaving
        left = self._ledger.leave(worker)
        _require(left is not busy, "a busy worker leaves" if left else "an idle worker may not leave")
        _require(worker.leaving is (left or leaving), "a refusal to leave changes the worker")
        return left

    def before_loss(self, worker: Worker) -> Held:
        """What the user is still interested in of what ``worker`` holds."""
        return [
            (batch.job, batch.seq, index - batch.start, index, batch.items[index - batch.start],
             batch.job.attempts.get(index, 0))
            for batch in worker.queue if batch.job is not None
            for index in range(batch.start + batch.received, batch.stop)
        ]

    def after_loss(self, child: Child, held: Held, losses: Sequence[Loss]) -> None:
        """``child`` was lost: who is charged for it?"""
        given_up = {(loss.job, loss.task) for loss in losses}
        for job, seq, offset, index, ref, attempts in held:
            now = job.attempts.get(index, 0)
            if (job, index) in given_up or now == attempts + 1:
                self._oracle.blamed(child, seq, offset, ref)
            else:
                _require(now == attempts, f"the attempts of {ref} go from {attempts} to {now}")
                self._oracle.spared(child, ref)

    def named(self, loss: Loss) -> None:
        """A task had its tries."""
        account: Account = loss.job.owner
        _require(loss.item == Ref(account.number, loss.task), "a loss names another task")

    # The whole

    def check(self) -> None:
        """Each task is in one place, each worker where it belongs, nobody idle without need."""
        self._check_workers()
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
        for job, span in (*pinned, *self._ledger._homeless):
            places.setdefault(job, []).append(("pinned", span.start, len(span.items)))
        for job, where in places.items():
            self._check_places(job, where)
        self._check_demand()
        self._check_idle()

    def _check_places(self, job: Job, places: list[tuple[str, int, int]]) -> None:
        account: Account = job.owner
        if account.cancelled:
            raise Violation(f"job {account.number} was cancelled, but the ledger keeps {places}")
        seen = account.delivered
        for place, start, size in places:
            tasks = (1 << size) - 1 << start
            if seen & tasks:
                raise Violation(f"tasks of job {account.number} from {start} on are {place} and "
                                "elsewhere")
            seen |= tasks
        if seen != account.everything:
            raise Violation(f"tasks {account.everything & ~seen:b} of job {account.number} are "
                            "nowhere")
        done = account.delivered.bit_count()
        _require(job.done == done, f"job {account.number} counts {job.done}, not {done}, as done")

    def _check_demand(self) -> None:
        wanted = sum(
            (account.everything & ~account.delivered).bit_count()
            for account in self._oracle.accounts
            if not account.cancelled
        )
        unwanted = sum(
            len(batch.items) - batch.received
            for batch in self._ledger.batches.values()
            if batch.job is None
        )
        demand = self._ledger.demand()
        _require(demand == wanted + unwanted, f"the demand is {demand}, not {wanted}+{unwanted}")

    def _check_workers(self) -> None:
        held = 0
        for worker in self._ledger.workers:
            held += len(worker.queue)
            _require(not worker.key.child.gone, f"{worker.key.child.name} is gone, but not lost")
            _require(len(worker.queue) <= 2, f"{worker.key.child.name} has too many batches")
            for batch in worker.queue:
                _require(self._ledger.batches.get(batch.seq) is batch, "an unknown batch is held")
                _require(batch.worker is worker, "a batch is held by another worker")
            if len(worker.queue) == 2:
                _require(
                    not any(batch.alone for batch in worker.queue),
                    "something queues behind or before a task that travels alone",
                )
        _require(held == len(self._ledger.batches), "a batch is with nobody")

    def _check_idle(self) -> None:
        idle = self._ledger.idle()
        if not idle:
            self._watched.clear()
            return
        since = [worker.since for worker in idle]
        _require(since == sorted(since), "the idle are not in the order in which they became so")
        waiting = any(job.waiting for job in self._ledger.jobs)
        _require(not waiting, "a task waits though a worker is idle")
        _require(not any(worker.pinned for worker in idle), "a pinned task waits for nothing")
        now = self._world.loop.now()
        asked = 0
        late = []
        for worker in self._ledger.workers:
            if len(worker.queue) == 2 and not worker.key.child.agent.up.is_cut:
                if worker.recalled:
                    asked += 1
                elif now > max(worker.since, self._watched.setdefault(worker, now)) + PATIENCE + SLACK:
                    late.append(worker)
                else:
                    self._world.loop.call_later(PATIENCE + 2 * SLACK, self._check_idle)
        if late and asked < len(idle):
            raise Violation(f"{late[0].key.child.name} keeps an unread batch from an idle worker")

    def check_end(self) -> None:
        """Nothing happens any more."""
        ledger = self._ledger
        _require(not ledger.batches, f"batches {list(ledger.batches)} are left over")
        _require(not ledger.demand(), f"{ledger.demand()} tasks are left over")
        _require(not any(job.closed for job in ledger.jobs), "a finished job is left over")
        _require(not any(worker.queue for worker in ledger.workers), "a worker is left busy")
        _require(ledger.starting == 0, f"{ledger.starting} workers never started")


def _require(condition: bool, otherwise: str) -> None:
    if not condition:
        raise Violation(otherwise)
