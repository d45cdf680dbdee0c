"""Generations of evolution strategies a second, with a few and with hundreds of workers."""

from __future__ import annotations

import os
import time
from functools import partial
from typing import TYPE_CHECKING, Any

from benchmarks import peers
from benchmarks.model import Case, Metric
from benchmarks.tasks import no_op

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Evolution strategies"
EPISODE = 0.05
EPISODES = 4
PARAMETERS = 4096
PROCESSES_PER_POD = 8
ABOUT = f"""\
A generation as in examples/02-es: a policy's {PARAMETERS:,} parameters go out with {EPISODES}
episodes for each worker, results come back in any order, one by one, and move the parameters. An
episode sleeps for {EPISODE * 1000:g} ms in place of a simulator, so that one machine has room for
all workers. Without overhead there are {1 / (EPISODE * EPISODES):g} generations a second. Here a
pod runs {PROCESSES_PER_POD} workers."""

RATE = Metric("rate", "generations a second", "1/s")
WORKERS = (8, 40, 200)


def workers(count: int) -> str:
    """Return the name of the case with so many workers."""
    return f"{count} workers"


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, fewer generations."""
    return [
        Case(
            measure="kubernetes_es",
            name=workers(count),
            group="generations a second",
            needs="stream",
            params={"workers": count, "generations": max(2, round(20 * size))},
            metrics=(RATE,),
            fresh=True,
            limit=180.0,
        )
        for count in WORKERS
    ]


def run(bench: Bench, workers: int, generations: int) -> dict[str, float]:
    """Return generations a second, after one that starts all workers."""
    import numpy as np

    if bench.contender == "fiber-kubernetes":
        os.environ["FIBER_PROCESSES_PER_POD"] = str(PROCESSES_PER_POD)
    pool = peers.start(bench.contender, workers)
    theta = np.zeros(PARAMETERS, np.float32)
    try:
        pool.map(no_op, range(workers), 1)
        _generation(pool, theta, workers)
        begin = time.perf_counter()
        for _ in range(generations):
            theta = theta + _generation(pool, theta, workers)
        return {RATE.name: generations / (time.perf_counter() - begin)}
    finally:
        pool.close()


def _generation(pool: peers.Adapter, theta: Any, workers: int) -> float:
    episodes = range(EPISODES * workers)
    returns: list[float] = list(pool.stream(partial(episode, theta), episodes, 1))
    if len(returns) != len(episodes):
        raise RuntimeError(f"{len(episodes)} episodes gave {len(returns)} returns")
    return sum(returns) / len(returns)


def episode(theta: Any, seed: int) -> float:
    """Do what a worker does: sleep as long as an episode takes."""
    time.sleep(EPISODE)
    return float(theta[seed % len(theta)]) + 1e-3 * (seed % 7)
