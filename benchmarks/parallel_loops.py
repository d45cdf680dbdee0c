"""joblib's parallel loops: tasks a second by backend."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from benchmarks.model import WORKERS, Case, Metric
from benchmarks.tasks import after, no_op, ones, size
from benchmarks.throughput import MEGABYTE, time_of

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "joblib"
ABOUT = f"""\
Loops of `joblib.Parallel(n_jobs={WORKERS})` on Fiber's backend, on joblib's default loky, and on
Dask's, with running workers. Tasks return an int, at once or after a sleep, or take an array. Each
task gets another array of 1 MB, or all tasks get the same array of 10 MB. loky writes the latter
to a file once, and Fiber copies it to shared memory; their workers map it. The batch size is the
number of tasks that travel together. "auto" begins at 1 in each loop and lets short batches grow.
Dask gets a tenth of the no-ops. The value of a round is the median of up to five loops in a row."""

RATE = Metric("rate", "tasks a second", "1/s")
BASELINE = "joblib"
BATCH_SIZES: dict[str, int | None] = {"batch_size=1": 1, "batch_size=auto": None}
NO_OPS, SHORT, LONGER = "no-ops", "1 ms tasks", "10 ms tasks"
DIFFERENT, SAME = "1 MB arrays", "the same 10 MB array"
TASKS = {NO_OPS: 5_000, SHORT: 1_000, LONGER: 200, DIFFERENT: 100, SAME: 50}
_SECONDS = {SHORT: 0.001, LONGER: 0.01}
_ARRAY_BYTES = {DIFFERENT: MEGABYTE, SAME: 10 * MEGABYTE}


def case_name(kind: str, batch_size: str) -> str:
    """Return the name of the case with tasks of this kind in batches of this size."""
    return f"{kind}, {batch_size}"


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, fewer tasks."""
    return [
        Case(
            measure="parallel_loops",
            name=case_name(kind, name),
            group="arrays" if kind in _ARRAY_BYTES else "tasks",
            needs="parallel",
            params={"kind": kind, "batch_size": batch_size, "tasks": max(10, round(tasks * size))},
            metrics=(RATE,),
            baseline=BASELINE,
            limit=30.0,
        )
        for kind, tasks in TASKS.items()
        for name, batch_size in BATCH_SIZES.items()
    ]


def run(bench: Bench, kind: str, batch_size: int | None, tasks: int) -> dict[str, float]:
    """Return tasks a second."""
    if kind == NO_OPS and not bench.light:
        tasks = max(10, tasks // 10)
    function, items, expected = _loop(kind, tasks)
    bench.pool.map(function, items[:WORKERS], batch_size)
    took = time_of(lambda: sum(bench.pool.map(function, items, batch_size)), expected)
    return {RATE.name: tasks / took}


def _loop(kind: str, tasks: int) -> tuple[Callable[[Any], Any], Sequence[Any], int]:
    """Return the function to call, its arguments, and the sum of the results."""
    if nbytes := _ARRAY_BYTES.get(kind):
        arrays = [ones(nbytes)] * tasks if kind == SAME else [ones(nbytes) for _ in range(tasks)]
        return size, arrays, nbytes * tasks
    function = partial(after, _SECONDS[kind]) if kind in _SECONDS else no_op
    return function, range(tasks), sum(range(tasks))
