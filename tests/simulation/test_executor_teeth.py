"""The simulation finds faults of executors: each fault here breaks one promise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from fiber._engine import scheduler, start_failures
from fiber._engine.scheduler import Decisions, PoolMember, Scheduler
from fiber._engine.start_failures import StartFailure
from fiber._engine.tasks import Batch, Job, Loss, Receipt, WorkerEntry
from fiber._runtime.answers import Pickled
from fiber._runtime.exchange import AnswerReceiver, BatchSender, TimeLimits
from fiber._runtime.executor import PoolExecutor
from fiber._runtime.jobs import CallQueue, Calls, Jobs
from fiber._runtime.leases import Lease, Leases
from fiber._runtime.work_items import Call, InputStream
from fiber._runtime.workers import WorkerHandle
from simulation.explore import first_failure
from simulation.suites import SUITES

pytestmark = pytest.mark.slow

SEEDS = range(10_100)
"""Among these each fault must show."""

RARE = {
    "forgets_unsent_tasks": 350,
    "leases_needed_workers": 600,
    "blames_dropped_tasks": 10_000,
}
"""Seeds where the search begins for faults that show late; it goes on with all the others."""

Patch = pytest.MonkeyPatch
Fault = Callable[[Patch], None]


def forgets_unsent_tasks(patch: Patch) -> None:
    """Takes a batch that was assigned, but not sent, for one that its worker may have run."""

    def lost(self: BatchSender, worker: WorkerEntry) -> set[int]:
        real(self, worker)
        return set()

    real = BatchSender.lost
    patch.setattr(BatchSender, "lost", lost)


def decides(patch: Patch, change: Callable[[Scheduler, Decisions], Decisions]) -> None:
    """The scheduler decides otherwise."""

    def decide(self: Scheduler, now: float) -> Decisions:
        return change(self, real(self, now))

    real = Scheduler.decide
    patch.setattr(Scheduler, "decide", decide)


def never_replaces_workers(patch: Patch) -> None:
    decides(patch, lambda _, decisions: decisions._replace(start=0))


def never_lets_go(patch: Patch) -> None:
    patch.setattr(Scheduler, "_not_needed", lambda _: [])


def grows_too_late(patch: Patch) -> None:
    def demand(self: Scheduler) -> int:
        return self.workers.minimum

    patch.setattr(Scheduler, "_demand", demand)


def grows_too_far(patch: Patch) -> None:
    decides(patch, lambda _, decisions: decisions._replace(start=decisions.start + 1))


def never_looks_again(patch: Patch) -> None:
    """Ignore timers: idle workers stay, recalls wait, and pauses never end."""
    decides(patch, lambda _, decisions: decisions._replace(wake_at=float("inf")))


def forgets_that_somebody_left(patch: Patch) -> None:
    def let_go(self: scheduler.PoolWorkerSet, member: PoolMember) -> None:
        member.leaving = True

    patch.setattr(scheduler.PoolWorkerSet, "let_go", let_go)


def gives_up_at_once(patch: Patch) -> None:
    """Decide by the number instead of the time."""
    patch.setattr(start_failures, "RAISED_PATIENCE", 0.0)
    patch.setattr(start_failures, "KILLED_PATIENCE", 0.0)


def never_gives_up(patch: Patch) -> None:
    def _failed(self: scheduler.PoolWorkerSet, failure: StartFailure, now: float) -> None:
        real(self, failure, now)
        self.error = None

    real = scheduler.PoolWorkerSet._failed
    patch.setattr(scheduler.PoolWorkerSet, "_failed", _failed)


def gives_up_with_workers_at_work(patch: Patch) -> None:
    patch.setattr(scheduler.PoolWorkerSet, "_at_work", lambda _: False)


def hides_that_no_worker_starts(patch: Patch) -> None:
    patch.setattr(scheduler.PoolWorkerSet, "news", lambda *_: "")


def drops_answers(patch: Patch) -> None:
    patch.setattr(PoolExecutor, "on_recalled", lambda *_: None)


def drops_ends_of_workers(patch: Patch) -> None:
    """A handle that does not report a worker that died before it was ready."""

    def exited(self: WorkerHandle, report: Any) -> None:
        if self.worker is not None:
            real(self, report)

    real = WorkerHandle.exited
    patch.setattr(WorkerHandle, "exited", exited)


def never_ends_workers(patch: Patch) -> None:
    patch.setattr(WorkerHandle, "dismiss", lambda _: None)


def forgets_deadlines(patch: Patch) -> None:
    patch.setattr(TimeLimits, "_over", lambda *_: None)


def keeps_deadlines(patch: Patch) -> None:
    patch.setattr(BatchSender, "settled", lambda *_: None)


def reports_twice(patch: Patch) -> None:
    def _put(self: Jobs, receipt: Receipt, *rest: Any) -> None:
        real(self, receipt, *rest)
        real(self, receipt, *rest)

    real = Jobs._put
    patch.setattr(Jobs, "_put", _put)


def reports_to_others(patch: Patch) -> None:
    def _put(self: Jobs, receipt: Receipt, results: list[Any], *rest: Any) -> None:
        real(self, receipt, results[::-1], *rest)

    real = Jobs._put
    patch.setattr(Jobs, "_put", _put)


def hides_losses(patch: Patch) -> None:
    def put_losses(self: Jobs, losses: list[Loss], *rest: Any) -> None:
        real(self, losses[1:], *rest)

    real = Jobs.put_losses
    patch.setattr(Jobs, "put_losses", put_losses)


def pickles_on_the_loop(patch: Patch) -> None:
    def send(self: BatchSender, batch: Batch) -> None:
        assert batch.job is not None
        self._encode(batch.job.owner, batch)

    patch.setattr(BatchSender, "send", send)


def unpickles_on_the_loop(patch: Patch) -> None:
    def _unreadable(self: AnswerReceiver, kind: str, batch: Batch, error: Pickled) -> None:
        error.decode()
        real(self, kind, batch, error)

    real = AnswerReceiver._unreadable
    patch.setattr(AnswerReceiver, "_unreadable", _unreadable)


def blames_dropped_tasks(patch: Patch) -> None:
    patch.setattr(BatchSender, "dropped", lambda *_: None)


def ignores_the_limit(patch: Patch) -> None:
    patch.setattr(InputStream, "_room", lambda _, limit: 1000)


def reads_everything(patch: Patch) -> None:
    def grant(self: InputStream, waiting: int, workers: int, *rest: Any) -> None:
        real(self, waiting, 1000 * workers, *rest)

    real = InputStream.grant
    patch.setattr(InputStream, "grant", grant)


def forgets_calls_that_wait_for_room(patch: Patch) -> None:
    patch.setattr(InputStream, "ask", lambda _: None)


def forgets_calls_that_wait_for_input(patch: Patch) -> None:
    patch.setattr(InputStream, "await_input", lambda _: None)


def never_resumes(patch: Patch) -> None:
    patch.setattr(Jobs, "resume", lambda *_: None)


def holds_no_results_back(patch: Patch) -> None:
    patch.setattr(Job, "has_next", property(lambda job: bool(job.waiting)))


def acts_later(patch: Patch) -> None:
    """Feeds calls, and leaves it to the next event to give them out."""

    def _take(self: Calls, queue: CallQueue) -> None:
        advance, self._advance = self._advance, lambda: None
        real(self, queue)
        self._advance = advance

    real = Calls._take
    patch.setattr(Calls, "_take", _take)


def leases_needed_workers(patch: Patch) -> None:
    patch.setattr(Scheduler, "needs_leased", lambda _: False)


def forgets_calls_that_take_longer(patch: Patch) -> None:
    def _adopt(self: Leases, lease: Lease, call: Call) -> None:
        self._return_idle(lease)

    patch.setattr(Leases, "_adopt", _adopt)


def forgets_workers_that_died_while_leased(patch: Patch) -> None:
    patch.setattr(PoolExecutor, "_back", lambda self, _: self._advance())


def never_takes_back_unreturned_workers(patch: Patch) -> None:
    patch.setattr(Leases, "_return_abandoned", lambda *_: None)


FAULTS: list[Fault] = [
    forgets_unsent_tasks,
    never_replaces_workers,
    never_lets_go,
    grows_too_late,
    grows_too_far,
    never_looks_again,
    forgets_that_somebody_left,
    gives_up_at_once,
    never_gives_up,
    gives_up_with_workers_at_work,
    hides_that_no_worker_starts,
    drops_answers,
    drops_ends_of_workers,
    never_ends_workers,
    forgets_deadlines,
    keeps_deadlines,
    reports_twice,
    reports_to_others,
    hides_losses,
    pickles_on_the_loop,
    unpickles_on_the_loop,
    blames_dropped_tasks,
    ignores_the_limit,
    reads_everything,
    forgets_calls_that_wait_for_room,
    forgets_calls_that_wait_for_input,
    never_resumes,
    holds_no_results_back,
    acts_later,
    leases_needed_workers,
    forgets_calls_that_take_longer,
    forgets_workers_that_died_while_leased,
    never_takes_back_unreturned_workers,
]


@pytest.mark.parametrize("fault", FAULTS)
def test_each_broken_promise_of_the_executor_is_found(fault: Fault, monkeypatch: Patch) -> None:
    fault(monkeypatch)
    first = RARE.get(fault.__name__, 0)
    seeds = [*SEEDS[first:], *SEEDS[:first]]
    assert first_failure(seeds, SUITES["executor"]) is not None
