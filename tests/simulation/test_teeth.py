"""The simulation finds the faults that it is for: each fault here breaks one promise."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from fiber._engine.ledger import Ledger
from fiber._engine.tasks import Batch, Job, Loss, Receipt, WorkerEntry, WrongAnswer
from simulation.explore import Failure, Suite, examine, first_failure, run
from simulation.ledger_master import LedgerMaster, for_ledger
from simulation.schedule import draw
from simulation.suites import SUITES, again

pytestmark = pytest.mark.slow

SEEDS = range(600)
"""Among these each fault must show."""


class ForgetsLostBatches(Ledger):
    def lose(
        self, worker: WorkerEntry, unread: Iterable[int], running: Any, disrupted: bool = False
    ) -> list[Loss]:
        for batch in worker.queue:
            del self.batches[batch.seq]
        worker.queue.clear()
        return super().lose(worker, unread, running, disrupted)


class KeepsLostBatches(Ledger):
    """Late results of a lost worker count."""

    def lose(
        self, worker: WorkerEntry, unread: Iterable[int], running: Any, disrupted: bool = False
    ) -> list[Loss]:
        batches = dict(self.batches)
        losses = super().lose(worker, unread, running, disrupted)
        self.batches = batches
        return losses


class TakesResultsTwice(Ledger):
    def receive(self, worker: WorkerEntry, seq: int, offset: int, *rest: Any, **more: Any) -> Any:
        batch = self.batches.get(seq)
        return super().receive(worker, seq, batch.received if batch else offset, *rest, **more)


class BelievesAnyone(Ledger):
    def held(self, worker: WorkerEntry, seq: int) -> Batch | None:
        return self.batches.get(seq)


class IgnoresWrongAnswers(Ledger):
    def receive(self, *args: Any, **options: Any) -> Receipt | None:
        try:
            return super().receive(*args, **options)
        except WrongAnswer:
            return None


class ChargesUnread(Ledger):
    def lose(
        self, worker: WorkerEntry, unread: Iterable[int], running: Any, disrupted: bool = False
    ) -> list[Loss]:
        return super().lose(worker, (), running)


class ChargesAllThatWasRead(Ledger):
    def lose(
        self, worker: WorkerEntry, unread: Iterable[int], running: Any, disrupted: bool = False
    ) -> list[Loss]:
        return super().lose(worker, unread, None)


class BlamesNoTask(Ledger):
    def lose(
        self, worker: WorkerEntry, unread: Iterable[int], running: Any, disrupted: bool = False
    ) -> list[Loss]:
        return super().lose(worker, [batch.seq for batch in worker.queue], running)


class GivesUpTooEarly(Ledger):
    def open(self, owner: Any = None, **options: Any) -> Job:
        job = super().open(owner, **options)
        retries = max(0, job.charges.limits.retries - 1)
        job.charges.limits = job.charges.limits._replace(retries=retries)
        return job


class RetriesForEver(Ledger):
    def retry(self, receipt: Receipt, index: int) -> bool:
        receipt.job.charges.deaths.pop(index, None)
        return super().retry(receipt, index)


class LetsTheBusyLeave(Ledger):
    def leave(self, worker: WorkerEntry) -> bool:
        super().leave(worker)
        worker.leaving = True
        return True


class GivesToWhoLeaves(Ledger):
    def leave(self, worker: WorkerEntry) -> bool:
        return not worker.queue and not worker.pinned


class DropsWhatIsTakenBack(Ledger):
    def put_back(self, worker: WorkerEntry, seqs: Iterable[int], now: float) -> None:
        seqs = list(seqs)
        for seq in seqs:
            if seq in self.batches:
                self.batches[seq].job = None
        super().put_back(worker, seqs, now)


class IgnoresWhatIsKept(Ledger):
    def receive(self, *args: Any, **options: Any) -> Receipt | None:
        return super().receive(*args, **{**options, "kept": None})


class NeverRecalls(Ledger):
    def recall(self, now: float) -> list[WorkerEntry]:
        return []


class RecallsForTheIdleOnly(Ledger):
    def recall(self, now: float) -> list[WorkerEntry]:
        return super().recall(now) if self.idle() else []


class ForgetsToRecallLater(Ledger):
    def next_recall(self) -> float | None:
        return None


class ForgetsToCancel(Ledger):
    def cancel(self, job: Job) -> list[WorkerEntry]:
        self.jobs.discard(job)
        return []


class IgnoresMaxTasks(Ledger):
    def add(self, key: Any, now: float, left: int | None = None) -> WorkerEntry:
        return super().add(key, now, left and left + 1)


class PinsToAnyone(Ledger):
    def pin(self, job: Job, worker: WorkerEntry | None, item: Any) -> None:
        super().pin(job, next(iter(self.workers), worker), item)


class NeverFinishes(Ledger):
    def _drop_if_finished(self, job: Job) -> bool:
        return False


class LendsTheBusy(Ledger):
    def lease(self, worker: WorkerEntry) -> bool:
        worker.leased = True
        return True


class GivesToLeasedWorkers(Ledger):
    def lease(self, worker: WorkerEntry) -> bool:
        if not super().lease(worker):
            return False
        self._load.idle[worker] = None
        return True


class ForgetsWhoIsBack(Ledger):
    def return_idle(self, worker: WorkerEntry, now: float) -> None:
        worker.leased = False


class ForgetsWhatIsAdopted(Ledger):
    def return_busy(self, worker: WorkerEntry, seq: int, *rest: Any) -> None:
        super().return_busy(worker, self.next_seq(), *rest)


BROKEN = [
    ForgetsLostBatches,
    KeepsLostBatches,
    TakesResultsTwice,
    BelievesAnyone,
    IgnoresWrongAnswers,
    ChargesUnread,
    ChargesAllThatWasRead,
    BlamesNoTask,
    GivesUpTooEarly,
    RetriesForEver,
    LetsTheBusyLeave,
    GivesToWhoLeaves,
    DropsWhatIsTakenBack,
    IgnoresWhatIsKept,
    NeverRecalls,
    RecallsForTheIdleOnly,
    ForgetsToRecallLater,
    ForgetsToCancel,
    IgnoresMaxTasks,
    PinsToAnyone,
    NeverFinishes,
    LendsTheBusy,
    GivesToLeasedWorkers,
    ForgetsWhoIsBack,
    ForgetsWhatIsAdopted,
]


def with_broken(broken: type[Ledger]) -> Suite:
    return Suite(lambda world: LedgerMaster(world, broken()), adapt=for_ledger)


@pytest.mark.parametrize("broken", BROKEN)
def test_each_broken_promise_of_the_ledger_is_found(broken: type[Ledger]) -> None:
    assert first_failure(SEEDS, with_broken(broken)) is not None


@contextmanager
def failing(ledger: type[Ledger]) -> Iterator[pytest.ExceptionInfo[Failure]]:
    suite = with_broken(ledger)
    found = first_failure(SEEDS, suite)
    assert found is not None
    with pytest.raises(Failure) as caught:
        examine(found[0], suite, again("ledger", found[0]))
    yield caught


def test_a_failure_is_made_small_and_says_how_to_run_it_again() -> None:
    with failing(ForgetsLostBatches) as caught:
        schedule = caught.value.schedule
        assert len(schedule.faults) <= 1
        assert sum(len(job.tasks) for job in schedule.jobs) <= 8
        text = str(caught.value)
        assert f"python tests/simulation/run.py ledger {schedule.seed}" in text
        assert "Violation: " in text
        assert "is gone: unread" in text


@pytest.mark.parametrize("suite", SUITES)
def test_a_seed_runs_exactly_the_same_again(suite: str) -> None:
    for seed in range(20):
        first: list[str] = []
        second: list[str] = []
        assert run(draw(seed), SUITES[suite], first) is None
        assert run(draw(seed), SUITES[suite], second) is None
        assert first == second


TELLING = {
    "ledger": (
        "crashes while it starts",
        "crashes before it reads",
        "crashes before it notes what it has read",
        "crashes in a task",
        "crashes after a task",
        "crashes before it sends",
        "crashes after it sent",
        "is stopped for",
        "is cut off",
        "host 1 is given up",
        "Ref(job=0, task=0) is given up",
        "is back",
        "is late: Results",
        "is leased",
        "is returned",
        "Unreadable",
        "kept=1",
        "gives back [",
        "is cancelled",
        "leaves",
        "in None",
        "which another worker has",
        "which it never had",
        "tasks and",
    ),
    "executor": (
        "a map",
        "a call",
        "a stream",
        "a broadcast",
        "Unknown(",
        "Broken(",
        "cannot be sent",
        "the start of a worker is refused",
        "is aborted",
        "is refused",
        "the pool is closed",
        "the pool is terminated",
        "the input of job 0 is broken",
        "a direct call",
        "is leased",
        "is called directly",
        "is interrupted",
        "is held back",
        "comes too late",
        "the user is told: no worker has started",
        "the pool does not start",
        "StartError",
    ),
    "remote": (
        "host 1 is back",
        "host 1 is given up",
        "the master hears that",
        "gives back [",
    ),
}


@pytest.mark.parametrize("suite", TELLING)
def test_each_kind_of_event_happens_in_the_simulation(suite: str) -> None:
    missing = set(TELLING[suite])
    for seed in range(600):
        trace: list[str] = []
        run(draw(seed), SUITES[suite], trace)
        text = "\n".join(trace)
        missing = {word for word in missing if word not in text}
        if not missing:
            return
    raise AssertionError(f"in none of these schedules happens {missing}")
