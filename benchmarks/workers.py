"""Many workers: the master's processor time to start one more."""

from __future__ import annotations

import gc
import threading
import time
from statistics import median
from typing import TYPE_CHECKING

from benchmarks.model import Case, Metric, rounds_with

if TYPE_CHECKING:
    from benchmarks.contender import Bench
    from benchmarks.fake_agents import FakeAgent

TITLE = "Many workers"
ABOUT = """\
Cost of one worker for the master until it is ready, in a pool of n. It is the processor time of the
whole process from the call of `Pool(n)` until the last worker is ready, less that of a pool of one,
divided by the n - 1 others. The master is real, with its runtime, pool and scheduler. Its one agent
is an object that answers at once, and its workers are objects too. So only the master is measured,
and thousands of workers fit here. The objects' cost is included, and the same for each. Small pools
are started up to 30 times, and the median counts."""

COST = Metric("cost", "processor time a worker", "s")
WORKERS = (10, 1000, 5000)
_ENOUGH = 300
_SINGLES = 15
_PATIENCE = 100.0


def workers(count: int) -> str:
    """Return the name of the case with so many."""
    return f"a pool of {count:,}"


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, smaller pools in the larger cases' places."""
    numbers = {n: max(10, round(n * size)) for n in WORKERS}
    return [
        Case(
            measure="workers",
            name=workers(n),
            group="processor time",
            needs="fake workers",
            params={"workers": number, "pools": max(1, _ENOUGH // number)},
            metrics=(COST,),
            limit=_PATIENCE + 20,
            fresh=True,
            rounds=rounds_with(n),
        )
        for n, number in numbers.items()
    ]


def run(bench: Bench, workers: int, pools: int) -> dict[str, float]:
    """Return processor seconds for one worker, from so many pools of so many."""
    from benchmarks.fake_agents import FakeAgent, FakeBackend, TaskRunner

    from fiber._runtime.state import runtime, shutdown

    ours = runtime()
    ours.backend.close()
    agent = FakeAgent(ours.loop, "fake", TaskRunner())
    ours.backend = FakeBackend(agent)
    try:
        _one_pool(bench, agent, 1)  # not kept: it imports
        single = median(_one_pool(bench, agent, 1) for _ in range(_SINGLES))
        many = median(_one_pool(bench, agent, workers) for _ in range(pools))
    finally:
        shutdown()
    return {COST.name: (many - single) / (workers - 1)}


def _one_pool(bench: Bench, agent: FakeAgent, workers: int) -> float:
    """Return processor seconds until all of them are ready."""
    all_ready = threading.Event()
    left = iter(range(workers - 1, -1, -1))

    def ready() -> None:
        if not next(left):
            all_ready.set()

    agent.on_ready = ready
    gc.collect()
    begin = time.process_time()
    pool = bench.processes.Pool(workers)
    try:
        if not all_ready.wait(_PATIENCE):
            raise TimeoutError(f"the pool of {workers} was not ready after {_PATIENCE:g} s")
        return time.process_time() - begin
    finally:
        pool.terminate()
        pool.join()
