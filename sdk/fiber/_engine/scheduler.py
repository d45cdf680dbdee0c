"""What a pool does next: events in, decisions out.

::

    submit, feed, cancel ─┐                       ┌─► assign    batches to send
    ready, receive ───────┼─► Ledger, WorkerSet ──┼─► recall    workers to ask for unread batches
    gone, expire ─────────┘       decide(now)     ├─► start     workers to start
    close, terminate                              ├─► dismiss   workers to tell to end
                                                  ├─► end       workers to end at once
                                                  ├─► failed    jobs without hope, and why
                                                  └─► wake_at   when to ask again at the latest

An event only changes what is known; ``decide`` says all that follows, so that no event can forget
to send what can be sent now, to replace or dismiss a worker, or to end a pool that has nothing left
to do.  No clock, no thread, no socket.  Not thread-safe: the executor (``fiber._runtime.executor``)
calls it on one thread.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from fiber._engine.ledger import Batch, Job, Ledger, Loss, Worker
from fiber._engine.start_failures import StartFailure
from fiber._engine.worker_set import Member, WorkerSet


class Decisions(NamedTuple):
    """What follows from what happened."""

    assign: list[Batch]
    recall: list[Worker]
    start: int
    dismiss: list[Member]
    end: list[Member]
    """To end at once, since the pool gives up."""
    failed: list[tuple[Job, BaseException]]
    wake_at: float
    """When to decide again if nothing happens; infinity if there is no need."""
    over: bool
    """The pool has ended: nobody is left, and nothing will come."""


class Scheduler:
    """Decides for one pool of ``minimum`` to ``maximum`` workers.

    A worker ends after ``max_tasks`` units of work (None: never), and above the minimum after
    ``idle_timeout`` seconds with nothing to do.  ``ledger`` knows the tasks, ``workers`` who there
    is: read them, and change them by the methods here, but for what concerns single tasks and
    batches (``receive``, ``retry``, ``split`` and so on), which is the ledger's own.
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
        self.workers = WorkerSet(minimum, maximum)
        self.closing = False
        self.terminated = False
        self.lent = 0
        """Workers that callers use directly."""
        self._max_tasks = max_tasks
        self._idle_timeout = idle_timeout
        self._gave_up = False

    # Tasks

    def pin_everywhere(self, job: Job, item: Any) -> None:
        """A task of ``job`` for every worker that there is, or that is starting."""
        for member in self.workers.staying():
            self.ledger.pin(job, member.worker, item)

    # Workers

    def starting(self, member: Member) -> None:
        """One of those to start is about to be."""
        self.workers.add(member)

    def ready(self, member: Member, now: float) -> None:
        """It is ready for work, unless it was told to go or is gone: it may be heard of late."""
        if member in self.workers.members and not member.leaving and member.worker is None:
            self.workers.ready(member, self.ledger.add(member, now, self._max_tasks))

    def gone(
        self,
        member: Member,
        now: float,
        *,
        unread: Iterable[int] = (),
        running: tuple[int, int] | None = None,
        disrupted: bool = False,
        failure: StartFailure | None = None,
    ) -> list[Loss]:
        """It is gone, with or without having been told to; tasks that it had run again elsewhere.

        Returns those that had their tries.  ``unread``, ``running`` and ``disrupted`` as for
        ``Ledger.lose``, ``failure`` as for ``WorkerSet.gone``.
        """
        self.workers.gone(member, now, failure)
        if member.worker is None:
            return []
        if member.worker.lent:
            self._returned(member.worker)
        return self.ledger.lose(member.worker, unread, running, disrupted=disrupted)

    def drain(self, member: Member) -> bool:
        """Give it nothing more, since its host is about to go; False if it leaves already.

        Another takes its place at once.  It ends once it has run what it has begun.
        """
        if member not in self.workers.members or member.leaving:
            return False
        if member.worker is not None:
            self.ledger.retire(member.worker)
        self.workers.let_go(member)
        return True

    def let_go(self, member: Member) -> None:
        """It is about to die by the executor's hand."""
        self.workers.let_go(member)

    def lend(self, worker: Worker) -> bool:
        """Leave an idle worker to callers; False if it is needed, or not idle."""
        if self.closing or self.ledger.waits() or not self.ledger.lend(worker):
            return False
        self.lent += 1
        return True

    def return_idle(self, worker: Worker, now: float) -> None:
        """A lent worker is back."""
        if worker.lent:
            self._returned(worker)
            self.ledger.return_idle(worker, now)

    def return_busy(self, worker: Worker, seq: int, job: Job | None, item: Any, now: float) -> None:
        """A lent worker is back and runs what was sent as ``seq``: see the ledger."""
        if worker.lent:
            self._returned(worker)
            self.ledger.return_busy(worker, seq, job, item, now)

    def _returned(self, worker: Worker) -> None:
        worker.lent = False
        self.lent -= 1

    # The end

    def close(self) -> None:
        """No more jobs will come."""
        self.closing = True

    def terminate(self) -> Sequence[Member]:
        """Nothing more is to be done; the workers to end, all of them."""
        self.closing = self.terminated = True
        for member in self.workers.staying():
            self.workers.let_go(member)
        return list(self.workers.members)

    # What follows

    def decide(self, now: float) -> Decisions:
        """All that follows from what happened until now; what it says is taken as done."""
        ledger, workers = self.ledger, self.workers
        ledger.starting = workers.starting
        failed, end = self._give_up()
        assign: list[Batch] = []
        while (batch := ledger.assign(now)) is not None:
            assign.append(batch)
        wake_at = math.inf
        recall: list[Worker] = []
        if ledger.imbalanced():
            recall = ledger.recall(now)
            wake_at = ledger.next_recall() or wake_at
        dismiss: list[Member] = [worker.key for worker in ledger.spent()]
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

    def needs_lent(self) -> bool:
        """Whether workers that are lent, and not in use, would have something to do."""
        return bool(self.lent) and (self.closing or self.ledger.waits())

    def _demand(self) -> int:
        return self.ledger.demand() + self.lent

    def _missing(self, now: float, wake_at: float) -> tuple[int, float]:
        """How many workers to start, and when to look again."""
        if self._done():
            return 0, wake_at
        missing = self.workers.missing(self._demand(), self.ledger.newcomers_wanted())
        start = self.workers.startable(missing, now)
        if missing and not start:
            try_at = self.workers.next_try()
            wake_at = wake_at if try_at is None else min(wake_at, try_at)
        return start, wake_at

    def _done(self) -> bool:
        """Whether no new worker is of any use."""
        over = self.terminated or self.workers.error is not None
        return over or (self.closing and not self.ledger.jobs)

    def _thin_out(self, now: float, dismiss: list[Member]) -> float:
        """Let go who has been idle for long; when the next one will have been."""
        while (idle := self.ledger.longest_idle()) is not None:
            if self.workers.size <= self.workers.wanted(self._demand()):
                break
            due = idle.since + self._idle_timeout
            if due > now or not self.ledger.leave(idle):
                return due
            self.workers.let_go(idle.key)
            dismiss.append(idle.key)
        return math.inf

    def _give_up(self) -> tuple[list[tuple[Job, BaseException]], list[Member]]:
        """Jobs that wait for workers which do not start, and whom to end since all is lost."""
        trouble, error = self.workers.trouble, self.workers.error
        if trouble is None or self.terminated:
            return [], []
        if error is None:
            return [(job, trouble) for job in self.ledger.jobs_for_newcomers()], []
        end: list[Member] = []
        if not self._gave_up:
            self._gave_up = True
            end = self.workers.staying()
            for member in end:
                self.workers.let_go(member)
        return [(job, error) for job in self.ledger.jobs], end

    def _not_needed(self) -> list[Member]:
        """Workers of a closed pool that has nothing left for them."""
        if self.ledger.jobs or not self.workers.size:
            return []
        idle = [worker.key for worker in self.ledger.idle() if self.ledger.leave(worker)]
        leaving = idle + [m for m in self._starting_members() if not m.leaving]
        for member in leaving:
            self.workers.let_go(member)
        return leaving

    def _starting_members(self) -> list[Member]:
        if not self.workers.starting:
            return []
        return [member for member in self.workers.members if member.worker is None]

    def _is_over(self) -> bool:
        if self.workers.members:
            return False
        return not self.ledger.jobs or self.terminated or self.workers.error is not None
