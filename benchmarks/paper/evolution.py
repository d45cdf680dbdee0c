"""Evolution strategies with many workers: iterations against the bound of list scheduling.

An episode takes as long as a recorded one of BipedalWalkerHardcore. Its worker sleeps meanwhile, so
that two processors have room for a thousand workers. All else is real: the parameters go out, each
worker perturbs them by a slice of the noise table that the processes of a host share, results come
back in any order, and an update moves the parameters.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks import peers, tasks
from benchmarks.model import Case, Metric
from benchmarks.paper import recording
from benchmarks.paper.schedule import list_schedule

if TYPE_CHECKING:
    from benchmarks.contender import Bench

WORKERS = (32, 64, 128, 256, 512, 1024, 2048)
ITERATIONS = 50
POPULATION = 2048
PER_HOST = 8
PARAMETERS = 2804
"""Parameters of a policy with 40 units in each of two hidden layers, as in the paper's domain."""
NOISE = 1 << 20
SIGMA, RATE = 0.1, 0.01
_QUICK_WORKERS = (4, 8)
_QUICK_POPULATION = 64
# A peer's worker is an interpreter that imports the library; the others' are forked.
_MOST_A_PROCESSOR = {
    "fiber": 128,
    "multiprocessing": 128,
    "ipyparallel": 32,
    "ray": 32,
    "dask": 32,
}

TIME = Metric("time", "time of all iterations", "s")
OWN = Metric("own", "processor time of the program, without its workers", "s")


class Job(NamedTuple):
    """Episode to play: where its noise starts, its sign, and the seconds that it takes."""

    noise_index: int
    sign: int
    seconds: float


def workers(count: int) -> str:
    """Return the name of the case with so many workers."""
    return f"{count:,} workers"


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, fewer iterations; far below, few workers, too."""
    quick = size < 0.01
    iterations = max(1, round(ITERATIONS * size))
    population = _QUICK_POPULATION if quick else POPULATION
    return [
        Case(
            measure="paper.evolution",
            name=workers(count),
            group="evolution",
            needs="evolution",
            params={"workers": count, "iterations": iterations, "population": population},
            metrics=(TIME, OWN),
            limit=300.0 + 3 * bound(iterations, population, count),
            fresh=True,
            not_run=_too_many(count),
        )
        for count in (_QUICK_WORKERS if quick else WORKERS)
    ]


def _too_many(count: int) -> dict[str, str]:
    """Return the contenders that need more processes for so many workers than fit this machine."""
    processors = len(os.sched_getaffinity(0))
    return {
        name: f"{count:,} processes do not fit this machine"
        for name, most in _MOST_A_PROCESSOR.items()
        if count > most * processors
    }


def population_of(iteration: int, population: int) -> list[Job]:
    """Return the episodes of an iteration, in the order in which they are submitted."""
    import numpy as np

    rng = np.random.default_rng(iteration)
    seconds = rng.choice(recording.read(recording.WALKER).seconds, population)
    starts = rng.integers(NOISE - PARAMETERS, size=population // 2)
    return [
        Job(int(starts[number // 2]), 1 - 2 * (number % 2), float(each))
        for number, each in enumerate(seconds)
    ]


@cache
def bound(iterations: int, population: int, workers: int) -> float:
    """Return the least seconds of so many iterations with so many workers."""
    return sum(
        list_schedule([job.seconds for job in population_of(iteration, population)], workers)
        for iteration in range(iterations)
    )


def run(bench: Bench, workers: int, iterations: int, population: int) -> dict[str, float]:
    """Return seconds of all iterations, after one that starts all workers.

    The second value is the processor time that this process used for them.
    """
    jobs = [population_of(iteration, population) for iteration in range(iterations)]
    with _pool(bench.contender, workers) as pool, _noise_table() as table:
        _warm(pool, table, workers)
        theta = _zeros()
        begin, used = time.perf_counter(), time.process_time()
        for each in jobs:
            theta = _iteration(pool, theta, table, each)
        took, used = time.perf_counter() - begin, time.process_time() - used
    return {TIME.name: took, OWN.name: used}


def _warm(pool: peers.Adapter, table: Path, workers: int) -> None:
    """Play short episodes until each worker has played, and has the noise table."""
    jobs = [Job(0, 1, 0.05)] * (2 * workers)
    _iteration(pool, _zeros(), table, jobs)


def _zeros() -> Any:
    import numpy as np

    return np.zeros(PARAMETERS, np.float32)


def _iteration(pool: peers.Adapter, theta: Any, table: Path, jobs: list[Job]) -> Any:
    """Return the parameters that the returns of these episodes lead to."""
    import numpy as np

    noise, gradient = open_table(table), np.zeros(PARAMETERS, np.float32)
    returns: list[tuple[int, float]] = list(pool.stream(partial(play, theta, table), jobs, 1))
    if len(returns) != len(jobs):
        raise RuntimeError(f"{len(jobs)} episodes gave {len(returns)} returns")
    for index, value in returns:
        gradient += value * noise[index : index + PARAMETERS]
    return theta + RATE * gradient / (len(returns) * SIGMA)


def play(theta: Any, table: Path, job: Job) -> tuple[int, float]:
    """Perturb the parameters and take as long as the episode: what a worker does."""
    index, sign, seconds = job
    perturbed = theta + sign * SIGMA * open_table(table)[index : index + PARAMETERS]
    tasks.pretend(seconds)
    return index, sign * float(perturbed[0])


@cache
def open_table(path: Path) -> Any:
    """Return this host's noise table, of which the kernel keeps one copy for all processes."""
    import numpy as np

    if not path.exists():
        _make_table(path)
    return np.memmap(path, dtype=np.float32, mode="r", shape=(NOISE,))


def _make_table(path: Path) -> None:
    """Write the table beside its place, and put it there in one step: others may do the same."""
    import numpy as np

    path.parent.mkdir(parents=True, exist_ok=True)  # another host lacks the program's folder
    partial_path = path.with_suffix(f".{os.getpid()}")
    noise = np.random.default_rng(7).standard_normal(NOISE, dtype=np.float32)
    partial_path.write_bytes(noise.tobytes())
    partial_path.replace(path)


@contextmanager
def _noise_table() -> Iterator[Path]:
    path = Path(tempfile.gettempdir()) / f"paper-noise-{os.getpid()}.f32"
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


@contextmanager
def _pool(contender: str, workers: int) -> Iterator[peers.Adapter]:
    if contender == "fiber-hosts":
        with _pretended_hosts(workers) as pool:
            yield pool
        return
    if contender == "fiber-kubernetes":
        os.environ["FIBER_PROCESSES_PER_POD"] = str(PER_HOST)
    pool = peers.start(contender, workers)
    try:
        yield pool
    finally:
        pool.close()


@contextmanager
def _pretended_hosts(workers: int) -> Iterator[peers.Adapter]:
    """Make a pool whose workers are fake children of agents with real links, eight to an agent."""
    from benchmarks.fake_cluster import HOSTS, joined_cluster

    agents = max(1, workers // PER_HOST)
    with joined_cluster(agents, hosts=min(HOSTS, agents)):
        pool = peers.start("fiber", workers)
        try:
            yield pool
        finally:
            pool.close()
