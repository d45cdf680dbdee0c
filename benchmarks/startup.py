"""Start-up: time until the last of n workers works, their memory, their end; the import."""

from __future__ import annotations

import contextlib
import os
import resource
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from benchmarks import processes
from benchmarks.model import Case, Metric, rounds_with
from benchmarks.tasks import announce, no_op

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Start-up"
ABOUT = """\
Each pool is made in a process that has done nothing before. Started: from the call of
`Pool(n)` until every worker has run its initializer and a first map of four no-ops for each
worker is complete. Memory: of the program and everything below it after that map, as PSS (a
page shared by n processes counts 1/n for each). Stopped: `terminate` and `join`. The soft
limit of open files is raised to the hard one. Import: the time that the import statement takes
in a new interpreter that has imported nothing else."""

START = Metric("start", "started", "s")
MEMORY = Metric("memory", "memory", "B")
STOP = Metric("stop", "stopped", "s")
IMPORT = Metric("import", "import", "s")
WORKERS = (1, 5, 64, 1024)
IMPORT_NAME = "import"
_MOST = 3200
_IMPORT_OF = {"fiber": "fiber", "multiprocessing": "multiprocessing.pool"}
_PATIENCE = 40.0


def workers(count: int) -> str:
    """Return the name of the case with `count` workers."""
    return f"{count:,} worker{'s' if count > 1 else ''}"


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, without the largest pools."""
    counts = [n for n in WORKERS if n <= 5 or n <= _MOST * size]
    pools = [
        Case(
            measure="startup",
            name=workers(n),
            group="pool",
            needs="start",
            params={"workers": n},
            metrics=(START, MEMORY, STOP),
            fresh=True,
            limit=_PATIENCE,
            rounds=rounds_with(n),
        )
        for n in counts
    ]
    params = {"interpreters": max(2, round(10 * size))}
    return [*pools, Case("startup", IMPORT_NAME, "import", "import", params, (IMPORT,))]


def run(bench: Bench, workers: int = 0, interpreters: int = 0) -> dict[str, float]:
    """Return time and memory of a pool of `workers`, or the median import time over new
    `interpreters`."""
    if interpreters:
        return {
            IMPORT.name: median(
                _import_time(_IMPORT_OF[bench.contender]) for _ in range(interpreters)
            )
        }
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    with meeting_point() as (path, fd):
        begin = time.perf_counter()
        pool = bench.processes.Pool(workers, initializer=announce, initargs=(path,))
        try:
            first = pool.map_async(no_op, range(4 * workers), 1)
            _wait_for(fd, workers)
            first.get(_PATIENCE)
            started = time.perf_counter() - begin
            memory = processes.memory(os.getpid())
        finally:
            begin = time.perf_counter()
            pool.terminate()
            pool.join()
    return {START.name: started, MEMORY.name: memory, STOP.name: time.perf_counter() - begin}


@contextlib.contextmanager
def meeting_point() -> Iterator[tuple[str, int]]:
    """Named pipe into which every worker writes one byte."""
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder, "workers"))
        os.mkfifo(path)
        # Open for writing too, or it would be at its end whenever no worker has it open.
        fd = os.open(path, os.O_RDWR | os.O_NONBLOCK)
        try:
            yield path, fd
        finally:
            os.close(fd)


def _wait_for(fd: int, workers: int) -> None:
    present, end = 0, time.monotonic() + _PATIENCE
    while present < workers:
        if not select.select([fd], [], [], max(0.0, end - time.monotonic()))[0]:
            raise TimeoutError(f"{present} of {workers} workers were up after {_PATIENCE:.0f} s")
        present += len(os.read(fd, workers))


def _import_time(module: str) -> float:
    clock = "time.perf_counter()"
    program = f"import time; begin = {clock}; import {module}; print({clock} - begin)"
    return float(
        subprocess.run([sys.executable, "-c", program], check=True, capture_output=True).stdout
    )
