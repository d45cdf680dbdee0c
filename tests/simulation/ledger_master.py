"""The smallest executor: it carries out the ledger's decisions and checks them."""

from __future__ import annotations

import random
import signal
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from fiber._agent.interface import ExitReport
from fiber._agent.usage import Usage
from fiber._engine import tasks as engine
from fiber._engine.chunks import TaskPace
from fiber._engine.ledger import Ledger
from fiber._engine.tasks import WrongAnswer
from simulation.agents import Child
from simulation.audit import Audit
from simulation.oracle import Account, Violation, limits_of, require
from simulation.schedule import Act, Famine, Schedule
from simulation.workers import NO_OP, Ready, Ref, Results, Unreadable, Work, Worker
from simulation.world import World


def for_ledger(schedule: Schedule) -> Schedule:
    """Remove famines: this master starts workers without a pause, so some must start."""
    faults = tuple(fault for fault in schedule.faults if not isinstance(fault, Famine))
    return replace(schedule, faults=faults)


class Plain:
    """Everything is said as it is."""

    def work(
        self, worker: Worker, seq: int, payload: Any, buffers: Sequence[memoryview]
    ) -> Work | None:
        """``payload`` is it."""
        work: Work | None = payload
        return work

    def message(self, said: Any) -> Any:
        """``said`` is it."""
        return said


STOP = 0


class Member:
    """Worker of the pool; a ``ChildObserver``."""

    def __init__(self, master: LedgerMaster) -> None:
        self.child: Child
        self.worker: engine.WorkerEntry | None = None
        self.leaving = False
        self.convicted = False
        self._master = master

    def started(self, pid: int) -> None:
        """Note that the worker exists."""

    def received(self, message: Any) -> None:
        """Take a message of the worker."""
        self._master.heard(self, message)

    def recalled(self, seqs: list[int]) -> None:
        """Take back the packets that it did not read."""
        self._master.recalled(self, seqs)

    def measured(self, usage: Usage) -> None:
        """Take its memory and processor time."""

    def showed_stack(self, text: str) -> None:
        """Take its stacks."""

    def draining(self) -> None:
        """Note that its host is about to go."""

    def exited(self, report: ExitReport) -> None:
        """Note the end of the worker."""
        self._master.exited(self, report)

    def stop(self) -> None:
        """Ask the worker to end after its batches."""
        self.leaving = True
        self.child.deliver(STOP, None)


class Names:
    """Maps the master's objects to those of the audit."""

    def account(self, job: engine.Job) -> Account | None:
        """Whose job it is; None if a caller sent it directly."""
        account: Account | None = job.owner
        return account

    def ref(self, job: engine.Job, index: int, item: Any) -> Ref:
        """Return the name of the task that ``item`` is."""
        ref: Ref = item
        return ref

    def child(self, worker: engine.WorkerEntry) -> Child:
        """Return the simulated process of a worker."""
        child: Child = worker.key.child
        return child


class LedgerMaster:
    """Gives work as one ledger says."""

    language = Plain()

    def __init__(self, world: World, ledger: Ledger) -> None:
        self.world = world
        self.ledger = ledger
        self.jobs: dict[int, engine.Job] = {}
        self._audit = Audit(world, ledger, Names())
        self._rng = random.Random(f"{world.schedule.seed} master")
        self._members: dict[Child, Member] = {}
        self._gone: dict[Child, engine.WorkerEntry] = {}
        self._terminated = False
        self._pace = TaskPace()
        self._recall_at: float | None = None
        self._idle_since: dict[engine.WorkerEntry, float] = {}
        self._direct: dict[engine.WorkerEntry, int] = {}
        """Packets that the callers of leased workers have sent."""
        self._adopted: list[engine.Job] = []

    def begin(self) -> None:
        """Plan the jobs, and start the first workers."""
        for account in self.world.oracle.accounts:
            self._later(account.plan.at, self._open, account)
        self._settle()

    def _later(self, seconds: float, callback: Callable[..., None], *args: Any) -> None:
        self.world.loop.call_later(seconds, self._call, callback, args)

    def _call(self, callback: Callable[..., None], args: tuple[Any, ...]) -> None:
        callback(*args)
        self._settle()

    @property
    def _now(self) -> float:
        return self.world.loop.now()

    # The user

    def _open(self, account: Account) -> None:
        if account.cancelled:
            return
        plan = account.plan
        # Every other job runs a function that is known already.
        pace = self._pace if account.number % 2 else None
        job = self.ledger.open(
            account, pace=pace, limits=limits_of(plan), unit=plan.unit, alone=plan.alone
        )
        self._pace = TaskPace(job.pace)
        self.jobs[account.number] = job
        if plan.cancelled_at is not None:
            self._later(max(0.0, plan.cancelled_at - self._now), self._cancel, account)
        if plan.everywhere:
            self._broadcast(account, job)
        else:
            self._feed(account, job)

    def _broadcast(self, account: Account, job: engine.Job) -> None:
        for member in self._members.values():
            if not member.leaving and account.plan.tasks:
                self.ledger.pin(job, member.worker, Ref(account.number, job.fed))
                self.world.oracle.fed(account.number, 1)
        self._close(account, job)

    def _feed(self, account: Account, job: engine.Job, start: int = 0) -> None:
        plan = account.plan
        stop = min(start + plan.bite, len(plan.tasks))
        items = [Ref(account.number, index) for index in range(start, stop)]
        self.world.note("job %d is fed %d tasks", account.number, len(items))
        self.ledger.feed(job, self._rng.choice((items, items, tuple(items))))
        if not account.cancelled:  # otherwise no caller wants them
            self.world.oracle.fed(account.number, len(items))
        if stop < len(plan.tasks):
            self._later(plan.pause, self._feed, account, job, stop)
        else:
            self._close(account, job)

    def _close(self, account: Account, job: engine.Job) -> None:
        self.world.oracle.closed(account.number)
        if not account.cancelled and self.ledger.close(job):
            self._finished(account)

    def _finished(self, account: Account) -> None:
        self.world.note("job %d is finished", account.number)
        self.world.oracle.finished(account.number)

    def _cancel(self, account: Account) -> None:
        if account.finished or account.cancelled:
            return
        self.world.note("job %d is cancelled", account.number)
        account.cancelled = True
        job = self.jobs.get(account.number)
        if job is not None:
            for worker in self.ledger.cancel(job):
                worker.key.child.recall()

    def terminate(self) -> None:
        """Cancel all jobs."""
        self._terminated = True
        for account in self.world.oracle.accounts:
            self._cancel(account)
        self._settle()

    # The workers

    def heard(self, member: Member, said: Any) -> None:
        """A worker said something."""
        if isinstance(said, Ready):
            self.ledger.starting -= 1
            member.worker = self.ledger.add(member, self._now, self.world.schedule.left)
        elif member.worker is not None and not member.convicted:
            try:
                self._hear(member.worker, said)
            except WrongAnswer as error:
                self.world.note("%s is convicted: %s", member.child.name, error)
                member.convicted = True  # it is replaced once it is gone
                self.ledger.retire(member.worker)
                member.child.signal(signal.SIGKILL)
        self._settle()

    def _hear(self, worker: engine.WorkerEntry, said: Any) -> None:
        if isinstance(said, Unreadable):
            if self.ledger.held(worker, said.seq) is not None:
                self._split(said.seq)
        elif self._direct.get(worker) == said.seq:
            del self._direct[worker]  # its caller gets the result
        else:
            self._take(worker, said)

    def heard_late(self, child: Child, said: Any) -> None:
        """A worker that was given up answers: the answer must be ignored."""
        worker = self._gone.get(child)
        if worker is not None and isinstance(said, Results):
            _require_dropped(self._receive(worker, said))
        elif worker is not None and isinstance(said, Unreadable):
            require(self.ledger.held(worker, said.seq) is None, "a lost worker has a batch")
        self._settle()

    def _receive(self, worker: engine.WorkerEntry, said: Results) -> engine.Receipt | None:
        seq, offset, tasks, seconds, kept = said
        return self.ledger.receive(
            worker, seq, offset, len(tasks), self._now, seconds=seconds, kept=kept
        )

    def _take(self, worker: engine.WorkerEntry, said: Results) -> None:
        receipt = self._receive(worker, said)
        if receipt is None:
            return
        indexes = range(receipt.start, receipt.start + receipt.size)
        if [ref for ref, _ in said.tasks] != [receipt.item(index) for index in indexes]:
            raise Violation("results are booked for other tasks")
        for at, (ref, act) in enumerate(said.tasks, receipt.start):
            if act is not Act.RETRIED or not self.ledger.retry(receipt, at):
                self._deliver(receipt.job, ref, act)

    def _split(self, seq: int) -> None:
        receipt = self.ledger.split(seq, self._now)
        if receipt is not None:
            self._deliver(receipt.job, receipt.item(receipt.start), "unreadable")

    def _deliver(self, job: engine.Job, ref: Ref, outcome: Act | str) -> None:
        if ref == NO_OP:
            return
        self.world.oracle.delivered(ref, outcome)
        self._look(job)

    def _look(self, job: engine.Job) -> None:
        account: Account = job.owner
        # The job counts all results of a message before it reports the first.
        if job.finished and account.delivered == account.everything:
            self._finished(account)

    def recalled(self, member: Member, seqs: list[int]) -> None:
        """A worker did not read these."""
        if member.worker is not None:
            self.ledger.put_back(member.worker, seqs, self._now)
        self._settle()

    def exited(self, member: Member, report: ExitReport) -> None:
        """A worker is gone."""
        del self._members[member.child]
        if member.worker is None:
            self.ledger.starting -= 1
        else:
            self._gone[member.child] = member.worker
            self._lose(member.worker, report)
        self._settle()

    def _lose(self, worker: engine.WorkerEntry, report: ExitReport) -> None:
        losses = self.ledger.lose(worker, report.unread, report.running, report.disrupted)
        self._direct.pop(worker, None)
        losses = [loss for loss in losses if loss.item != NO_OP]
        for loss in losses:
            self.world.oracle.died(loss.item, *loss.counts)
        for job in {loss.job for loss in losses}:
            self._look(job)

    def _expire(self, batch: engine.Batch) -> None:
        if self.ledger.batches.get(batch.seq) is not batch:
            return
        receipt = self.ledger.expire(batch.seq)
        if receipt is not None:
            self._deliver(receipt.job, receipt.item(receipt.start), "too late")
        member: Member = batch.worker.key
        member.leaving = True
        member.child.signal(signal.SIGKILL)

    def drain(self) -> None:
        """Ask some worker to leave."""
        able = sorted(self._members.values(), key=lambda member: member.child.name)
        able = [it for it in able if it.worker and not it.worker.leased and not it.leaving]
        if able:
            self._leave(self._rng.choice(able))
        self._settle()

    def _leave(self, member: Member) -> None:
        assert member.worker is not None
        if self.ledger.leave(member.worker):
            self.world.note("%s leaves", member.child.name)
            member.stop()

    # After each event

    def _settle(self) -> None:
        self.world.count()
        self._assign()
        for worker in self.ledger.recall(self._now):
            worker.key.child.recall()
        self._let_go()
        if self._rng.random() < 0.05:
            self._lease()
        self._scale()
        self._set_timer()
        self._audit.check()

    def _assign(self) -> None:
        while (batch := self.ledger.assign(self._now)) is not None:
            member: Member = batch.worker.key
            assert batch.job is not None
            account: Account | None = batch.job.owner
            if any(self.world.task(ref).act is Act.UNSENDABLE for ref in batch.items):
                self._split(batch.seq)
                continue
            work = Work(batch.seq, batch.items, batch.stride, batch.unit)
            member.child.deliver(batch.seq, work)
            if account is not None and account.plan.timeout is not None:
                self._later(account.plan.timeout, self._expire, batch)

    def _lease(self) -> None:
        """Lease an idle worker to a caller for a while."""
        idle = self.ledger.idle()
        if not idle or not self.ledger.lease(worker := self._rng.choice(idle)):
            return
        self.world.note("%s is leased", worker.key.child.name)
        if self._rng.random() < 0.7:
            seq = self._direct[worker] = self.ledger.next_seq()
            worker.key.child.deliver(seq, Work(seq, [NO_OP], 1, 1, apart=True))
        self._later(self._rng.choice((1e-5, 1e-3, 0.1)), self._return, worker)

    def _return(self, worker: engine.WorkerEntry) -> None:
        """Give back the worker, perhaps with an answer that has not come yet."""
        if worker not in self.ledger.workers:
            return
        self.world.note("%s is returned", worker.key.child.name)
        seq = self._direct.pop(worker, None)
        if seq is None:
            self.ledger.return_idle(worker, self._now)
            return
        job = None
        if self._rng.random() < 0.5:
            job = self.ledger.open()
            self._adopted.append(job)
        self.ledger.return_busy(worker, seq, job, NO_OP, self._now)
        if job is not None:
            self.ledger.close(job)

    def _let_go(self) -> None:
        for worker in self.ledger.spent():
            worker.key.stop()

    def _scale(self) -> None:
        staying = sum(not member.leaving for member in self._members.values())
        schedule, wanted = self.world.schedule, self._wanted()
        newcomers = self.ledger.newcomers_wanted() - self.ledger.starting
        if not self._terminated:
            missing = max(wanted - staying, min(newcomers, schedule.max_workers - staying))
            for _ in range(missing):
                self._start()
        if schedule.linger is not None and staying > wanted:
            for worker in self.ledger.idle():
                if self._idle_since.get(worker) != worker.since:
                    self._idle_since[worker] = worker.since
                    self._later(schedule.linger, self._dismiss, worker, worker.since)

    def _wanted(self) -> int:
        schedule = self.world.schedule
        return max(schedule.min_workers, min(schedule.max_workers, self.ledger.demand()))

    def _start(self) -> None:
        member = Member(self)
        agents = [agent for agent in self.world.agents if not agent.lost]
        member.child = self.world.child(self._rng.choice(agents), member)
        member.child.start()
        self._members[member.child] = member
        self.ledger.starting += 1

    def _dismiss(self, worker: engine.WorkerEntry, since: float) -> None:
        """Ask a worker to end that was idle for a while."""
        member: Member = worker.key
        staying = sum(not member.leaving for member in self._members.values())
        idle = worker in self.ledger.idle() and worker.since == since
        if idle and staying > self._wanted():
            self._leave(member)

    def _set_timer(self) -> None:
        due = self.ledger.next_recall()
        if due is not None and due != self._recall_at:
            self._recall_at = due
            self._later(max(0.0, due - self._now), self._recall, due)

    def _recall(self, due: float) -> None:
        if self._recall_at == due:
            self._recall_at = None

    def done(self) -> bool:
        """The loop runs out of things to do."""
        return True

    def leave_process(self) -> None:
        """Keep the global state of the process, which the master does not change."""

    def check_end(self) -> None:
        """Check that no work is left over."""
        if not all(job.finished for job in self._adopted):
            raise Violation("the answer to a direct call never comes")
        self._audit.check_end()


def _require_dropped(receipt: engine.Receipt | None) -> None:
    if receipt is not None:
        raise Violation("a late result counts")
