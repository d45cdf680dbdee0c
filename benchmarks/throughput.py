"""Throughput: no-op tasks a second, and how fast large data passes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from statistics import median
from typing import TYPE_CHECKING, Any

from benchmarks import latency
from benchmarks.model import WORKERS, Case, Metric
from benchmarks.tasks import no_op, ones, size, sleep

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Throughput"
ABOUT = f"""\
{WORKERS} workers. No-op tasks return their argument, an int. Their function is one of an importable
module or, where the case says so, of the main module, as in most scripts, or a lambda, which
travels by value, as the functions of a notebook do. Contenders with servers
(Dask, ipyparallel, Ray, Spark) get a tenth of the no-op tasks, so that a round ends in bearable
time. A batch of arrays has 100 different arrays of 1 MB, sent with chunksize 1.

The long task stands in the middle of its batch, which is sent in default chunks. The time shows
whether short tasks wait behind the long one, and whether the long one waited for its turn. Each
other value of a round is the median of up to five batches in a row."""

RATE = Metric("rate", "tasks a second", "1/s")
TIME = Metric("time", "time of the batch", "s")
NO_OPS = "no-op tasks"
ARRAYS = "arrays of 1 MB"
LONG = "one long task"
MEGABYTE = 1 << 20
OF_MAIN = "function of __main__"
BY_VALUE = "function by value"
OTHER_KINDS = (OF_MAIN, BY_VALUE)
"""Kinds of functions that are not importable."""

# Name, ability, method, chunk size, tasks.
_NO_OPS: tuple[tuple[str, str, str, int | None, int], ...] = (
    ("map, chunksize 1", "map", "map", 1, 10_000),
    ("map, default chunks", "map", "map", None, 100_000),
    ("imap_unordered, chunksize 1", "stream", "stream", 1, 10_000),
    ("imap_unordered, chunksize 100", "stream in chunks", "stream", 100, 100_000),
    ("apply_async", "submit", "submit", None, 10_000),
    (f"map, chunksize 1, {OF_MAIN}", "map", "map", 1, 10_000),
    (f"apply_async, {OF_MAIN}", "submit", "submit", None, 10_000),
    (f"apply_async, {BY_VALUE}", "submit", "submit", None, 10_000),
)
ARRAY_KINDS = {
    "1 MB arguments": "arguments",
    "1 MB results": "results",
    "1 MB arguments and results": "both",
}
LONG_NAME = "1 s among 10,000 no-ops"


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, fewer tasks."""

    def case(name: str, group: str, needs: str, metric: Metric, **params: Any) -> Case:
        not_run = latency.NOT_BY_VALUE if name.endswith(BY_VALUE) else {}
        return Case("throughput", name, group, needs, params, (metric,), not_run=not_run)

    return [
        *(
            case(
                name,
                NO_OPS,
                needs,
                RATE,
                kind=method,
                tasks=max(100, round(tasks * size)),
                chunksize=chunksize,
                function=_function_of(name),
            )
            for name, needs, method, chunksize, tasks in _NO_OPS
        ),
        *(
            case(
                name, ARRAYS, "map", TIME, kind=kind, tasks=max(10, round(100 * size)), chunksize=1
            )
            for name, kind in ARRAY_KINDS.items()
        ),
        case(LONG_NAME, LONG, "map", TIME, kind="long", tasks=10_000, chunksize=None),
    ]


def _function_of(name: str) -> str:
    """Return the name of the no-op of a case."""
    if name.endswith(BY_VALUE):
        return "by_value"
    return "of_main" if name.endswith(OF_MAIN) else "no_op"


def run(
    bench: Bench, kind: str, tasks: int, chunksize: int | None, *, function: str = "no_op"
) -> dict[str, float]:
    """Return tasks a second for no-ops; for the others the seconds of the batch."""
    if kind == "long":
        return _long(bench, tasks)
    if kind in ARRAY_KINDS.values():
        return _arrays(bench, kind, tasks)
    tasks = tasks if bench.light else max(100, tasks // 10)
    return _no_ops(bench, kind, getattr(bench, function), tasks, chunksize)


def _no_ops(
    bench: Bench, method: str, function: Callable[[int], int], tasks: int, chunksize: int | None
) -> dict[str, float]:
    pool = bench.pool

    def batch(items: Sequence[int]) -> Iterable[Any]:
        if method == "map":
            return pool.map(function, items, chunksize)
        if method == "stream":
            return pool.stream(function, items, chunksize or 1)
        return pool.submit(function, items)

    sum(batch(range(WORKERS)))
    return {RATE.name: rate(lambda count: batch(range(count)), tasks)}


def rate(batch: Callable[[int], Iterable[Any]], tasks: int) -> float:
    """Return tasks a second, for a batch that returns the numbers below its argument."""
    return tasks / time_of(lambda: sum(batch(tasks)), sum(range(tasks)))


def _arrays(bench: Bench, kind: str, tasks: int) -> dict[str, float]:
    arrays = [ones(MEGABYTE) for _ in range(tasks)]

    def batch(count: int) -> int:
        if kind == "arguments":
            return sum(bench.pool.map(size, arrays[:count], 1))
        if kind == "results":
            return sum(size(each) for each in bench.pool.map(ones, [MEGABYTE] * count, 1))
        return sum(size(each) for each in bench.pool.map(no_op, arrays[:count], 1))

    batch(2 * WORKERS)
    return {TIME.name: time_of(lambda: batch(tasks), tasks * MEGABYTE)}


def _long(bench: Bench, tasks: int) -> dict[str, float]:
    naps = [0.0] * tasks
    naps[tasks // 2] = 1.0
    bench.pool.map(nap, naps[:WORKERS], None)
    begin = time.perf_counter()
    bench.pool.map(nap, naps, None)
    return {TIME.name: time.perf_counter() - begin}


def nap(seconds: float) -> None:
    """Sleep if there is a time to sleep; even a sleep of 0 s is a system call."""
    if seconds:
        sleep(seconds)


def time_of(batch: Callable[[], int], expected: int) -> float:
    """Return seconds of a batch whose results add up to this.

    The median of up to five batches, or of as many as fit in half a second, at least one.
    """
    clock, times, end = time.perf_counter, list[float](), time.perf_counter() + 0.5
    while not times or (len(times) < 5 and clock() < end):
        begin = clock()
        total = batch()
        times.append(clock() - begin)
        if total != expected:
            raise RuntimeError(f"the results add up to {total}, not to {expected}")
    return median(times)
