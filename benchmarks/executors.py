"""Executors: how many tasks a second go through submit and map."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import TYPE_CHECKING, Any

from benchmarks.latency import NO_LAMBDA
from benchmarks.model import WORKERS, Case, Metric
from benchmarks.tasks import after
from benchmarks.throughput import BY_VALUE, OF_MAIN, OTHER_KINDS, rate

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Executors"
ABOUT = f"""\
{WORKERS} workers of a concurrent.futures.Executor, each library with its own executor; loky is the
one within joblib. Tasks return their argument, an int, at once or after a sleep of a millisecond.
`submit` is one call for each task, and then all results. Its function is one of an importable
module, or of the main module, or a lambda, which travels by value. `map` has chunksize 1 unless the
case says otherwise. Dask has `Client.submit` and `Client.map`, which have no chunks, and Ray
`apply_async` and `map` of its Pool. Both get a tenth of the no-op tasks. The value of a round is
the median of up to five batches in a row."""

RATE = Metric("rate", "tasks a second", "1/s")
BASELINE = "concurrent.futures"
SUBMIT = "submit, no-ops"
SUBMIT_OF = {kind: f"submit, {kind}" for kind in OTHER_KINDS}
MAP = "map, no-ops"
IN_CHUNKS = "map, no-ops, chunksize 100"
SLEEPING = "submit, 1 ms tasks"
_CHUNKS = "executor in chunks"

# Name, ability, chunk size (0: submit), seconds of a task, tasks, the no-op.
_CASES = (
    (SUBMIT, "executor", 0, 0.0, 5_000, "no_op"),
    (SUBMIT_OF[OF_MAIN], "executor", 0, 0.0, 5_000, "of_main"),
    (SUBMIT_OF[BY_VALUE], "executor", 0, 0.0, 5_000, "by_value"),
    (MAP, "executor", 1, 0.0, 5_000, "no_op"),
    (IN_CHUNKS, _CHUNKS, 100, 0.0, 100_000, "no_op"),
    (SLEEPING, "executor", 0, 0.001, 1_000, "no_op"),
)


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, fewer tasks."""
    return [
        Case(
            measure="executors",
            name=name,
            group="tasks",
            needs=needs,
            params={
                "chunksize": chunksize,
                "seconds": seconds,
                "tasks": max(100, round(tasks * size)),
                "function": function,
            },
            metrics=(RATE,),
            baseline=BASELINE,
            limit=30.0,
            not_run={BASELINE: NO_LAMBDA} if function == "by_value" else {},
        )
        for name, needs, chunksize, seconds, tasks, function in _CASES
    ]


def run(
    bench: Bench, chunksize: int, seconds: float, tasks: int, function: str
) -> dict[str, float]:
    """Return tasks a second."""
    called = partial(after, seconds) if seconds else getattr(bench, function)

    def batch(count: int) -> Iterable[Any]:
        if chunksize:
            return bench.pool.map(called, range(count), chunksize)
        return bench.pool.submit(called, range(count))

    batch(WORKERS)
    few = not bench.light and not seconds
    return {RATE.name: rate(batch, max(100, tasks // 10) if few else tasks)}
