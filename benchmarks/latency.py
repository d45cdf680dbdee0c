"""Latency: one call and its result, again and again."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from benchmarks.model import WORKERS, Case, Metric
from benchmarks.samples import percentile

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Latency"
ABOUT = f"""\
Time of one `apply` of a no-op to an idle pool of {WORKERS} workers: up to 2,000 calls, one
after the other, or as many as fit in 2 s. The function is one of an importable module, or of the
main module, as in most scripts, or a lambda, which travels by value, as the functions of a notebook
do. Half of the calls stay below p50, and 95 % below p95. Libraries without such a call
use the nearest one: submit, and wait for the result; for Spark a job of one task."""

P50 = Metric("p50", "p50", "s")
P95 = Metric("p95", "p95", "s")
NAME = "apply"
OF_MAIN = "apply, function of __main__"
BY_VALUE = "apply, function by value"
NO_LAMBDA = "it pickles no lambda"
NOT_BY_VALUE = dict.fromkeys(("multiprocessing", "concurrent.futures"), NO_LAMBDA)
"""Contenders that have no functions by value."""


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, fewer calls."""
    params = {"calls": max(20, round(2000 * size)), "seconds": 2.0 * size}
    return [
        Case(
            "latency",
            name,
            "one call",
            "apply",
            {**params, "function": function},
            (P50, P95),
            not_run=NOT_BY_VALUE if name == BY_VALUE else {},
        )
        for name, function in ((NAME, "no_op"), (OF_MAIN, "of_main"), (BY_VALUE, "by_value"))
    ]


def run(bench: Bench, calls: int, seconds: float, function: str = "no_op") -> dict[str, float]:
    """Return percentiles of up to `calls` calls, or of as many as fit in `seconds`."""
    called = getattr(bench, function)
    for _ in range(max(5, calls // 20)):
        bench.pool.apply(called, 0)
    clock, times, end = time.perf_counter, list[float](), time.perf_counter() + seconds
    while len(times) < calls and (not times or clock() < end):
        begin = clock()
        bench.pool.apply(called, 0)
        times.append(clock() - begin)
    return {P50.name: percentile(times, 50), P95.name: percentile(times, 95)}
