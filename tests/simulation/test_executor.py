"""The real executor keeps the pool's promises, on hosts near and far."""

from __future__ import annotations

import pytest

from fiber._engine.scheduler import Scheduler
from fiber._engine.tasks import WorkerEntry
from simulation.explore import run
from simulation.schedule import Job, Kill, Schedule, Task
from simulation.suites import PARTS, SUITES, examine_part


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_the_executor_keeps_the_promises_of_a_pool(part: int) -> None:
    examine_part("executor", part)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_the_executor_keeps_its_promises_over_real_links_to_real_agent_services(part: int) -> None:
    examine_part("remote", part)


@pytest.mark.parametrize("seed", range(10))
def test_answers_of_a_leased_worker_that_dies_count(seed: int) -> None:
    """Recall a call before its caller has looked; then it must not run again."""
    job = Job(0.0, (Task(1e-4),) * 12, bite=3000, pause=0.0, retries=1)
    for at in range(5, 25):
        schedule = Schedule(seed, (job,), faults=(Kill(0, at * 1e-3),))
        assert run(schedule, SUITES["executor"]) is None


class Late:
    """A worker that is ready, and gone, before its starter could note how to reach it."""

    def __init__(self) -> None:
        self.worker: WorkerEntry | None = None
        self.leaving = False


def test_a_worker_that_is_gone_is_not_ready() -> None:
    scheduler = Scheduler(1, 1)
    member = Late()
    scheduler.starting(member)
    scheduler.gone(member, 1.0)
    scheduler.ready(member, 2.0)
    assert not scheduler.ledger.workers
    assert scheduler.decide(3.0).start == 1
