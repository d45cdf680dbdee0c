"""Overhead: five workers sleep for one second each, in ever shorter tasks, as in the paper."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from benchmarks.model import WORKERS, Case, Metric
from benchmarks.tasks import sleep

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Overhead"
ABOUT = f"""\
{WORKERS} workers, one second of work for each, cut into tasks that sleep for 1 s down to 100
µs: the figure in the paper's section "Framework overhead", with one more column. Without any
overhead each batch would take 1 s (more at 100 µs, as Linux may let a sleep last 50 µs longer than
asked). With "default chunks" no chunk size is given, and each library uses its default;
concurrent.futures then sends one task at a time."""

DURATIONS = {1.0: "1 s", 0.1: "100 ms", 0.01: "10 ms", 0.001: "1 ms", 0.0001: "100 µs"}
CHUNKS: dict[str, int | None] = {"chunksize 1": 1, "default chunks": None}
TIME = Metric("time", "time of the batch", "s")


def case_name(duration: float, chunks: str) -> str:
    """Return the name of the case for tasks of `duration` seconds."""
    return f"{DURATIONS[duration]} tasks, {chunks}"


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, less work for each worker."""
    return [
        Case(
            measure="overhead",
            name=case_name(duration, chunks),
            group=chunks,
            needs="map",
            params={
                "duration": duration,
                "tasks": WORKERS * max(1, round(size / duration)),
                "chunksize": chunksize,
            },
            metrics=(TIME,),
            limit=90.0 if duration >= 0.001 else 15.0,
        )
        for chunks, chunksize in CHUNKS.items()
        for duration in DURATIONS
    ]


def run(bench: Bench, duration: float, tasks: int, chunksize: int | None) -> dict[str, float]:
    """Return seconds from handing over the batch to having all results."""
    bench.pool.map(sleep, [0] * WORKERS, chunksize)
    begin = time.perf_counter()
    results = bench.pool.map(sleep, [duration] * tasks, chunksize)
    took = time.perf_counter() - begin
    if len(results) != tasks:
        raise RuntimeError(f"{tasks} tasks gave {len(results)} results")
    return {TIME.name: took}
