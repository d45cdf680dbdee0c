"""What can be driven through the schedules, by name."""

from __future__ import annotations

import os

from fiber._engine.ledger import Ledger
from simulation.dispatcher_master import DispatcherMaster, for_pool
from simulation.explore import Suite, examine
from simulation.ledger_master import LedgerMaster
from simulation.world import World

SCHEDULES = int(os.environ.get("SIMULATION_SCHEDULES", "4000"))
"""Seeds that each suite runs in a test session."""

PARTS = 10
"""Tests over which they are spread."""


def with_ledger(world: World) -> LedgerMaster:
    """The ledger, driven by the least that makes it go."""
    return LedgerMaster(world, Ledger())


SUITES = {
    "ledger": Suite(with_ledger),
    "dispatcher": Suite(DispatcherMaster, for_pool),
}


def again(suite: str, seed: int) -> str:
    """The command that runs one seed again."""
    return f"python tests/simulation/run.py {suite} {seed}"


def examine_part(suite: str, part: int) -> None:
    """Run every PARTS-th schedule."""
    for seed in range(part, SCHEDULES, PARTS):
        examine(seed, SUITES[suite], again(suite, seed))
