"""Objects that the schedules drive, by name."""

from __future__ import annotations

import os

from fiber._engine.ledger import Ledger
from simulation.executor_master import ExecutorMaster, for_pool
from simulation.explore import Suite, examine
from simulation.ledger_master import LedgerMaster, for_ledger
from simulation.remote_hosts import RemoteHost
from simulation.world import World

SCHEDULES = int(os.environ.get("SIMULATION_SCHEDULES", "2000"))
"""Seeds for the ledger in one test session; the slower suites run a part of them."""

PARTS = 5
"""Tests over which a suite is spread."""


def with_ledger(world: World) -> LedgerMaster:
    """The ledger, driven by the least that makes it go."""
    return LedgerMaster(world, Ledger())


SUITES = {
    "ledger": Suite(with_ledger, adapt=for_ledger),
    "executor": Suite(ExecutorMaster, adapt=for_pool, share=0.6),
    "remote": Suite(ExecutorMaster, adapt=for_pool, share=0.25, remote=RemoteHost),
}
"""``remote`` is the executor again, with everything between it and the far workers real but the
connection."""


def again(suite: str, seed: int) -> str:
    """The command that runs one seed again."""
    return f"python tests/simulation/run.py {suite} {seed}"


def examine_part(suite: str, part: int) -> None:
    """Run every PARTS-th schedule."""
    for seed in range(part, int(SCHEDULES * SUITES[suite].share), PARTS):
        examine(seed, SUITES[suite], again(suite, seed))
