"""A long task delays no other one, however many tasks wait behind them."""

from __future__ import annotations

from functools import partial

import pytest

from fiber._engine.ledger import Ledger
from fiber._engine.load import CHECK_EVERY, LATE_AFTER
from fiber._engine.tasks import Batch
from simulation.ledger_master import LedgerMaster
from simulation.schedule import Job, Schedule, Task
from simulation.workers import Ref, Worker
from simulation.world import World

SHORT, LONG = 2e-3, 60.0

SLACK = 50e-3
"""Seconds for the recall, for the message that the next worker runs, and for the one behind it."""


class Delays(Ledger):
    """Ledger that notes when each task was sent first."""

    def __init__(self) -> None:
        super().__init__()
        self.sent: dict[int, float] = {}

    def assign(self, now: float) -> Batch | None:
        batch = super().assign(now)
        if batch is not None:
            for index in range(batch.start, batch.stop):
                self.sent.setdefault(index, now)
        return batch


def longest_delay(seed: int) -> float:
    """Return the seconds from a task's message until it begins, at most, beside a long task."""
    tasks = [Task(SHORT)] * 5000
    tasks[700] = Task(LONG)
    plan = Schedule(seed, (Job(0.0, tuple(tasks), 5000, 0.0),), min_workers=3, max_workers=3)
    ledger = Delays()
    world = World(plan, partial(LedgerMaster, ledger=ledger))
    begun: dict[int, float] = {}
    note = world.oracle.begins

    def begins(ref: Ref, worker: Worker) -> None:
        begun.setdefault(ref.task, world.loop.now())
        note(ref, worker)

    world.oracle.begins = begins  # type: ignore[method-assign]
    world.run()
    assert max(begun[at] for at in begun if at != 700) < begun[700] + LONG
    return max(begun[at] - ledger.sent[at] for at in begun)


@pytest.mark.parametrize("seed", range(5))
def test_a_long_task_in_a_stream_of_short_ones_delays_none_of_them(seed: int) -> None:
    assert longest_delay(seed) < LATE_AFTER + CHECK_EVERY + SLACK
