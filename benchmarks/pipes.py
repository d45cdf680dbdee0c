"""Pipes: round trips between two processes, and a vector step over many environments."""

from __future__ import annotations

import importlib
import os
import time
from collections.abc import Callable
from statistics import median
from typing import TYPE_CHECKING, Any

from benchmarks.model import Case, Metric
from benchmarks.tasks import echo, ones

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Pipes"
ABOUT = """\
Round trip: this process sends, a process at the other end of a `Pipe()` receives and sends
back, this process receives and touches every page of the message. From 28 KB (an Atari
observation) up the message is a NumPy array. The value of a round is the median of its round
trips. The time depends much on where the kernel puts the two processes. So it is also measured with
both held on one processor, and with one on each of two. Vector step: one `step` of Gymnasium's
AsyncVectorEnv with `shared_memory=False` over environments that do nothing; Fiber runs it by
`fiber.adopt("gymnasium.vector.async_vector_env")`."""

ROUND_TRIP = Metric("round trip", "round trip", "s")
STEP = Metric("step", "vector step", "s")
TRIPS = "round trip"
PLACED = "round trip in a given place"
STEPS = "vector step"

# Name, bytes (0: an int), round trips.
MESSAGES = (
    ("int", 0, 5000),
    ("100 B", 100, 5000),
    ("28 KB", 84 * 84 * 4, 2000),
    ("1 MB", 1 << 20, 300),
    ("16 MB", 1 << 24, 20),
)
PLACES = {"one processor": 1, "two processors": 2}
_ENVIRONMENTS = {8: 800, 32: 200}
_PAGE = 4096
_MODULE = "gymnasium.vector.async_vector_env"


def environments(count: int) -> str:
    """Return the name of the case with `count` environments."""
    return f"{count} environments"


def placed(message: str, place: str) -> str:
    """Return the name of the case with this message and the processes held in this place."""
    return f"{message}, {place}"


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, fewer round trips."""
    trips = [
        (TRIPS, name, ROUND_TRIP, {"nbytes": nbytes}, count) for name, nbytes, count in MESSAGES
    ]
    in_places = [
        (PLACED, placed(name, place), ROUND_TRIP, {"nbytes": nbytes, "processors": number}, count)
        for name, nbytes, count in MESSAGES
        for place, number in PLACES.items()
        if number <= len(os.sched_getaffinity(0))
    ]
    steps = [
        (STEPS, environments(n), STEP, {"environments": n}, count)
        for n, count in _ENVIRONMENTS.items()
    ]
    return [
        Case(
            measure="pipes",
            name=name,
            group=group,
            needs="placed pipes" if group == PLACED else "pipes",
            params={**params, "count": max(5, round(count * size)), "seconds": 2.0 * size},
            metrics=(metric,),
            fresh=True,
        )
        for group, name, metric, params, count in [*trips, *in_places, *steps]
    ]


def run(
    bench: Bench,
    count: int,
    seconds: float,
    nbytes: int = 0,
    environments: int = 0,
    processors: int = 0,
) -> dict[str, float]:
    """Return the median of up to `count` round trips or vector steps, as many as fit in
    `seconds`."""
    if environments:
        return _vector_step(bench, environments, count, seconds)
    if not processors:
        return _round_trip(bench, nbytes, count, seconds, None)
    allowed = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {allowed[0]})
    try:
        return _round_trip(bench, nbytes, count, seconds, allowed[processors - 1])
    finally:
        os.sched_setaffinity(0, allowed)


def _round_trip(
    bench: Bench, nbytes: int, count: int, seconds: float, processor: int | None
) -> dict[str, float]:
    message = 1 if not nbytes else b"x" * nbytes if nbytes < 1000 else ones(nbytes)
    here, there = bench.processes.Pipe()
    child = bench.processes.Process(target=echo, args=(there, processor), daemon=True)
    child.start()
    there.close()

    def trip() -> None:
        here.send(message)
        reply = here.recv()
        if nbytes >= _PAGE:
            reply[::_PAGE].max()

    try:
        return {ROUND_TRIP.name: _median_time(trip, count, seconds)}
    finally:
        # Not by closing: a forked child holds this end too and would never see its end.
        child.terminate()
        child.join()
        here.close()


def _vector_step(bench: Bench, environments: int, count: int, seconds: float) -> dict[str, float]:
    module: Any = importlib.import_module(_MODULE)
    still = importlib.import_module("benchmarks.environment").Still
    if bench.contender.startswith("fiber"):
        importlib.import_module("fiber").adopt(_MODULE)
    vector = module.AsyncVectorEnv([still] * environments, shared_memory=False)
    try:
        vector.reset()
        actions = [0] * environments
        return {STEP.name: _median_time(lambda: vector.step(actions), count, seconds)}
    finally:
        vector.close()


def _median_time(action: Callable[[], object], count: int, seconds: float) -> float:
    for _ in range(max(3, count // 10)):
        action()
    clock, times, end = time.perf_counter, list[float](), time.perf_counter() + seconds
    while len(times) < count and (not times or clock() < end):
        begin = clock()
        action()
        times.append(clock() - begin)
    return median(times)
