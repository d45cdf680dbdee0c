"""Decisions of a pool: events in, decisions out.

::

    submit, feed, cancel ─┐                       ┌─► assign    batches to send
    ready, receive ───────┼─► Ledger, worker set ─┼─► recall    workers to ask for unread batches
    gone, expire ─────────┘       decide(now)     ├─► start     workers to start
    close, terminate                              ├─► dismiss   workers to ask to end
                                                  ├─► end       workers to end at once
                                                  ├─► failed    jobs that cannot run, and why
                                                  └─► wake_at   when to ask again at the latest

An event only changes the state.  ``decide`` returns everything that follows from the state.  So no
event can forget to send a batch, to replace or dismiss a worker, or to end a pool without work.
Pure: ``now`` is an argument.  Not thread-safe: the executor (``fiber._runtime.executor``) calls it
on the loop thread.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Protocol

from fiber._engine.ledger import Ledger
from fiber._engine.start_failures import StartFailure, StartFailures
from fiber._engine.tasks import Batch, Job, Loss, RunningTask, WorkerEntry
from fiber.errors import FiberError

IDLE_DEATHS = 3
"""Deaths of idle workers, above the pool's maximum, after which they are replaced slowly."""

IDLE_PAUSE = 1.0
"""Seconds between slow replacements."""


class PoolMember(Protocol):
    """Process of a worker, from before its start until it is gone."""

    worker: WorkerEntry | None
    """Worker's entry in the ledger, once the worker is ready."""
    leaving: bool
    """True once the process was asked to end, or is about to be."""


class PoolWorkerSet:
    """Workers of a pool, ``minimum`` to ``maximum`` of them.

    ``members`` are the workers whose processes start or run.  ``size`` counts members that stay,
    ``starting`` those of them that are not ready.  ``trouble`` is the reason why no worker starts,
    once that has lasted for a while.  If no worker is ready either, it is also the ``error``,
    and the pool gives up.
    """

    def __init__(self, minimum: int, maximum: int) -> None:
        self.minimum = minimum
        self.maximum = maximum
        self.members: dict[PoolMember, None] = {}
        self.size = 0
        self.starting = 0
        self.trouble: FiberError | None = None
        self.error: FiberError | None = None
        self._failures = StartFailures()
        self._alone_since = 0.0  # when the last ready worker was lost
        self._idle_deaths = 0

    @property
    def failures(self) -> int:
        """Number of failed starts since the last success."""
        return self._failures.count

    def staying(self) -> list[PoolMember]:
        """Return the members that were not asked to end."""
        return [member for member in self.members if not member.leaving]

    def wanted(self, demand: int) -> int:
        """Return how many workers there should be for so many tasks."""
        return min(max(demand, self.minimum), self.maximum)

    def missing(self, demand: int, newcomers: int) -> int:
        """Return how many workers to start for so many tasks.

        Only new workers may run ``newcomers`` of the tasks.
        """
        missing = self.wanted(demand) - self.size
        return max(missing, min(newcomers - self.starting, self.maximum - self.size), 0)

    def startable(self, missing: int, now: float) -> int:
        """Return how many to start now; after failures it is one, once the pause is over."""
        if not self._failures.pause:
            return missing
        return min(missing, 1) if now >= self._try_at() and not self._trying() else 0

    def next_try(self) -> float | None:
        """Return when the pause after failures ends; None without one, or during a try."""
        return self._try_at() if self._failures.pause and not self._trying() else None

    def _trying(self) -> bool:
        """Return whether a worker starts as a try after failures."""
        return bool(self.failures and self.starting)

    def _at_work(self) -> bool:
        return self.size > self.starting

    def _try_at(self) -> float:
        return self._failures.try_at(at_work=self._at_work())

    # Events

    def add(self, member: PoolMember) -> None:
        """Add a worker that is about to be started."""
        self.members[member] = None
        self.size += 1
        self.starting += 1

    def ready(self, member: PoolMember, worker: WorkerEntry) -> None:
        """Note that a worker is ready."""
        member.worker = worker
        self.starting -= 1
        self._failures.forget()
        self.trouble = None
        if self._idle_deaths <= IDLE_DEATHS + self.maximum:
            self._failures.pause = 0.0

    def did_something(self) -> None:
        """Note that a worker sent a result."""
        if self._idle_deaths:
            self._idle_deaths = 0
            if not self.failures:
                self._failures.pause = 0.0

    def give_up(self, error: FiberError) -> None:
        """Note that no more workers can start, because of ``error``."""
        self.error = error

    def let_go(self, member: PoolMember) -> None:
        """Count a worker as leaving; the caller asks it to end, or kills it."""
        self._uncount(member)
        member.leaving = True

    def gone(self, member: PoolMember, now: float, failure: StartFailure | None) -> None:
        """Remove a worker whose process is gone, or could not be started.

        ``failure`` says why, if the worker was not ready.  None: the worker is not to blame, as
        when its host is lost.
        """
        if member not in self.members:
            return
        del self.members[member]
        self._uncount(member)
        if member.worker is not None and not self._at_work():
            self._alone_since = now
        if member.leaving:
            return
        if member.worker is not None:
            if not member.worker.queue:
                self._died_idle(now)
        elif failure is not None:
            self._failed(failure, now)

    def _died_idle(self, now: float) -> None:
        self._idle_deaths += 1
        if self._idle_deaths > IDLE_DEATHS + self.maximum:
            self._failures.hold(IDLE_PAUSE, now)

    def _failed(self, failure: StartFailure, now: float) -> None:
        self._failures.add(failure, now, at_work=self._at_work())
        if self._failures.last(failure, now):
            self.trouble = failure.error(self.failures)
            if not self._at_work() and self._failures.last(failure, now, self._alone_since):
                self.error = self.trouble

    def news(self, failure: StartFailure, now: float) -> str:
        """Return a text for the user, once for each series of failures that lasts; else empty."""
        if self.error or not self._failures.are_news(now):
            return ""
        return (
            f"no worker has started for {self._failures.lasted(now):.0f} s, {self.failures} tries: "
            f"{failure.who} ended before it was ready ({failure.reason}). Trying again"
        )

    def _uncount(self, member: PoolMember) -> None:
        if not member.leaving:
            self.size -= 1
            self.starting -= member.worker is None


class Decisions(NamedTuple):
    """Actions for the executor."""

    assign: list[Batch]
    recall: list[WorkerEntry]
    start: int
    dismiss: list[PoolMember]
    end: list[PoolMember]
    """Workers to end at once, since the pool gives up."""
    failed: list[tuple[Job, BaseException]]
    wake_at: float
    """Time to decide again if no event comes before; infinity if there is no need."""
    over: bool
    """True once the pool has ended: no workers are left, and no tasks will come."""


class Scheduler:
    """Scheduler of one pool of ``minimum`` to ``maximum`` workers.

    A worker ends after ``max_tasks`` units of work (None: never), and above the minimum after
    ``idle_timeout`` idle seconds.  ``ledger`` has the tasks, ``workers`` the workers.  Callers may
    read both, and change them by the methods here.  Methods for single tasks and batches
    (``receive``, ``retry``, ``split`` and so on) are called on the ledger.
    """

    def __init__(
        self,
        minimum: int,
        maximum: int,
        *,
        max_tasks: int | None = None,
        idle_timeout: float = math.inf,
    ) -> None:
        self.ledger = Ledger()
        self.workers = PoolWorkerSet(minimum, maximum)
        self.closing = False
        self.terminated = False
        self._max_tasks = max_tasks
        self._idle_timeout = idle_timeout
        self._gave_up = False

    # Tasks

    def pin_everywhere(self, job: Job, item: Any) -> None:
        """Feed ``job`` a task for every worker that stays, also for those that are starting."""
        for member in self.workers.staying():
            self.ledger.pin(job, member.worker, item)

    # Workers

    def starting(self, member: PoolMember) -> None:
        """Add a worker that is about to be started."""
        self.workers.add(member)

    def ready(self, member: PoolMember, now: float) -> None:
        """Note that a worker is ready; ignored if it was asked to end, or is gone."""
        if member in self.workers.members and not member.leaving and member.worker is None:
            self.workers.ready(member, self.ledger.add(member, now, self._max_tasks))

    def gone(
        self,
        member: PoolMember,
        now: float,
        *,
        unread: Iterable[int] = (),
        running: RunningTask | None = None,
        disrupted: bool = False,
        failure: StartFailure | None = None,
    ) -> list[Loss]:
        """Remove a worker that is gone, for any reason; its tasks wait again.

        Return the tasks that have no tries left.  ``unread``, ``running`` and ``disrupted`` as for
        ``Ledger.lose``, ``failure`` as for ``PoolWorkerSet.gone``.
        """
        self.workers.gone(member, now, failure)
        if member.worker is None:
            return []
        return self.ledger.lose(member.worker, unread, running, disrupted=disrupted)

    def drain(self, member: PoolMember) -> bool:
        """Give no more tasks to a worker whose host is about to end; False if it leaves already.

        Another worker takes its place at once.  The old one ends after the tasks that it has begun.
        """
        if member not in self.workers.members or member.leaving:
            return False
        if member.worker is not None:
            self.ledger.retire(member.worker)
        self.workers.let_go(member)
        return True

    def let_go(self, member: PoolMember) -> None:
        """Count a worker as leaving: the executor is about to kill it."""
        self.workers.let_go(member)

    def lease(self, worker: WorkerEntry) -> bool:
        """Lease an idle worker to callers; return False if it is needed, or not idle."""
        return not (self.closing or self.ledger.has_assignable()) and self.ledger.lease(worker)

    def return_idle(self, worker: WorkerEntry, now: float) -> None:
        """Take back a leased worker, which is idle."""
        if worker.leased:
            self.ledger.return_idle(worker, now)

    def return_busy(
        self, worker: WorkerEntry, seq: int, job: Job | None, item: Any, now: float
    ) -> None:
        """Take back a leased worker that runs the call sent as ``seq``: see the ledger."""
        if worker.leased:
            self.ledger.return_busy(worker, seq, job, item, now)

    # The end

    def close(self) -> None:
        """Close the pool: no more jobs will come."""
        self.closing = True

    def terminate(self) -> Sequence[PoolMember]:
        """End the pool without its remaining tasks; return all workers, to be ended."""
        self.closing = self.terminated = True
        for member in self.workers.staying():
            self.workers.let_go(member)
        return list(self.workers.members)

    # Decisions

    def decide(self, now: float) -> Decisions:
        """Return the actions that follow from all events until now, and count them as done."""
        ledger, workers = self.ledger, self.workers
        ledger.starting = workers.starting
        failed, end = self._give_up()
        assign: list[Batch] = []
        while (batch := ledger.assign(now)) is not None:
            assign.append(batch)
        recall = ledger.recall(now)
        wake_at = ledger.next_recall() or math.inf
        dismiss: list[PoolMember] = [worker.key for worker in ledger.spent()]
        for member in dismiss:
            workers.let_go(member)
        start = 0
        if workers.size < workers.maximum:
            start, wake_at = self._missing(now, wake_at)
        if workers.size > workers.minimum and self._idle_timeout < math.inf:
            wake_at = min(wake_at, self._thin_out(now, dismiss))
        over = False
        if self.closing:
            dismiss += self._not_needed()
            over = self._is_over()
        return Decisions(assign, recall, start, dismiss, end, failed, wake_at, over)

    def needs_leased(self) -> bool:
        """Return whether the pool needs the leased workers that no caller uses at the moment."""
        return bool(self.ledger.leased) and (self.closing or self.ledger.has_assignable())

    def _demand(self) -> int:
        return self.ledger.demand() + self.ledger.leased

    def _missing(self, now: float, wake_at: float) -> tuple[int, float]:
        """Return how many workers to start, and when to decide again."""
        if self._done():
            return 0, wake_at
        missing = self.workers.missing(self._demand(), self.ledger.newcomers_wanted())
        start = self.workers.startable(missing, now)
        if missing and not start:
            try_at = self.workers.next_try()
            wake_at = wake_at if try_at is None else min(wake_at, try_at)
        return start, wake_at

    def _done(self) -> bool:
        """Return whether the pool needs no new workers."""
        over = self.terminated or self.workers.error is not None
        return over or (self.closing and not self.ledger.jobs)

    def _thin_out(self, now: float, dismiss: list[PoolMember]) -> float:
        """Dismiss workers that were idle for too long; return when the next one is due."""
        while (idle := self.ledger.longest_idle()) is not None:
            if self.workers.size <= self.workers.wanted(self._demand()):
                break
            due = idle.since + self._idle_timeout
            if due > now or not self.ledger.leave(idle):
                return due
            self.workers.let_go(idle.key)
            dismiss.append(idle.key)
        return math.inf

    def _give_up(self) -> tuple[list[tuple[Job, BaseException]], list[PoolMember]]:
        """Return the jobs that fail since workers do not start, and the workers to end then."""
        trouble, error = self.workers.trouble, self.workers.error
        if trouble is None or self.terminated:
            return [], []
        if error is None:
            return [(job, trouble) for job in self.ledger.jobs_for_newcomers()], []
        end: list[PoolMember] = []
        if not self._gave_up:
            self._gave_up = True
            end = self.workers.staying()
            for member in end:
                self.workers.let_go(member)
        return [(job, error) for job in self.ledger.jobs], end

    def _not_needed(self) -> list[PoolMember]:
        """Return the workers to dismiss from a closed pool without jobs."""
        if self.ledger.jobs or not self.workers.size:
            return []
        idle = [worker.key for worker in self.ledger.idle() if self.ledger.leave(worker)]
        leaving = idle + [m for m in self._starting_members() if not m.leaving]
        for member in leaving:
            self.workers.let_go(member)
        return leaving

    def _starting_members(self) -> list[PoolMember]:
        if not self.workers.starting:
            return []
        return [member for member in self.workers.members if member.worker is None]

    def _is_over(self) -> bool:
        if self.workers.members:
            return False
        return not self.ledger.jobs or self.terminated or self.workers.error is not None
