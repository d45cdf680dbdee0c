"""The real executor keeps the pool's promises, on hosts near and far."""

from __future__ import annotations

import pytest

from simulation.explore import run
from simulation.schedule import Job, Kill, Schedule, Task
from simulation.suites import PARTS, SUITES, examine_part


@pytest.mark.parametrize("part", range(PARTS))
def test_the_executor_keeps_the_promises_of_a_pool(part: int) -> None:
    examine_part("executor", part)


@pytest.mark.parametrize("part", range(PARTS))
def test_it_keeps_them_over_real_links_to_real_agent_services(part: int) -> None:
    examine_part("remote", part)


@pytest.mark.parametrize("seed", range(10))
def test_what_a_lent_worker_answers_before_it_dies_counts(seed: int) -> None:
    """Its caller may not have looked yet; then the call must not run again."""
    job = Job(0.0, (Task(1e-4),) * 12, bite=3000, pause=0.0, retries=1)
    for at in range(5, 25):
        schedule = Schedule(seed, (job,), faults=(Kill(0, at * 1e-3),))
        assert run(schedule, SUITES["executor"]) is None
