"""Limits of a task's losses: deaths and disruptions are counted apart."""

from __future__ import annotations

import random
from collections import Counter

import pytest

from fiber._engine.chunks import TaskPace
from fiber._engine.ledger import Ledger
from fiber._engine.tasks import Charges, Limits, LossCounts
from unit.ledger_steps import assign_all, job_of


@pytest.mark.parametrize("disrupted", [False, True], ids=["deaths", "disruptions"])
def test_a_task_runs_again_as_often_as_its_limit_says(disrupted: bool) -> None:
    limits = Limits(retries=2, disruptions=5)
    charges = Charges(limits)
    allowed = [charges.charge(7, disrupted=disrupted) for _ in range(limits[disrupted] + 1)]
    assert allowed == [True] * limits[disrupted] + [False]


@pytest.mark.parametrize("seed", range(50))
def test_each_kind_has_its_own_count_for_each_task(seed: int) -> None:
    rng = random.Random(seed)
    limits = Limits(rng.randrange(4), rng.randrange(6))
    charges = Charges(limits)
    seen: Counter[tuple[int, bool]] = Counter()
    for _ in range(100):
        task, disrupted = rng.randrange(3), rng.random() < 0.5
        seen[task, disrupted] += 1
        again = charges.charge(task, disrupted=disrupted)
        assert again == (seen[task, disrupted] <= limits[disrupted])
        if not again:
            assert charges.settle(task) == LossCounts(
                seen.pop((task, False), 0), seen.pop((task, True), 0)
            )
    for task in range(3):
        charges.settle(task)
    assert not charges.deaths
    assert not charges.disruptions


@pytest.mark.parametrize("seed", range(50))
def test_a_lost_task_runs_again_until_one_of_its_counts_is_used_up(seed: int) -> None:
    rng = random.Random(seed)
    limits = Limits(rng.randrange(4), rng.randrange(6))
    ledger = Ledger()
    job = job_of(ledger, ["task"], limits=limits, pace=TaskPace())
    left = list(limits)
    while True:
        worker = ledger.add("worker", 0.0)
        (batch,) = assign_all(ledger)
        disrupted = rng.random() < 0.5
        losses = ledger.lose(worker, (), (batch.seq, 0), disrupted)
        left[disrupted] -= 1
        if losses:
            break
        assert left[disrupted] >= 0
    (loss,) = losses
    assert left[disrupted] == -1
    assert loss.counts == LossCounts(limits.retries - left[0], limits.disruptions - left[1])
    assert job.finished
