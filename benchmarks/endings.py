"""Endings: how soon pools, tasks and programs end when they are asked to, or are killed."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks import processes
from benchmarks.model import Case, Metric
from benchmarks.tasks import no_op, sleep

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Endings"
ABOUT = """\
How long endings take. Terminate: `terminate` and `join` of a pool of two workers that sleep, with
10,000 tasks queued. Killed process: from SIGKILL until its sentinel is ready in the parent. Task
over its limit: the time that `apply(timeout=0.3)` takes beyond 0.3 s, when the task sleeps;
multiprocessing has no such limit. Ctrl-C: from SIGINT to the whole process group of a program that
waits for a `map` over two workers, until none of its processes is left. Killed program: the same,
but only the program gets SIGKILL. multiprocessing's workers live on then, so it does not take part
in this case."""

TIME = Metric("time", "time to end", "s")
TERMINATE = "terminate"
KILLED_PROCESS = "killed process"
OVER_LIMIT = "task over its limit"
INTERRUPT = "Ctrl-C"
KILLED_PROGRAM = "killed program"
_LIMIT = 0.3
_PROGRAM = Path(__file__).with_name("endless_program.py")
_PATIENCE = 30.0
_PAUSE = 0.002


def cases(size: float) -> list[Case]:
    """Return all endings; the size makes no difference."""
    return [
        Case(
            measure="endings",
            name=name,
            group="endings",
            needs=needs,
            params={"ending": name},
            metrics=(TIME,),
            limit=2 * _PATIENCE,
        )
        for name, needs in (
            (TERMINATE, "endings"),
            (KILLED_PROCESS, "endings"),
            (OVER_LIMIT, "guarded endings"),
            (INTERRUPT, "endings"),
            (KILLED_PROGRAM, "guarded endings"),
        )
    ]


def run(bench: Bench, ending: str) -> dict[str, float]:
    """Bring about the ending, and return how long it took."""
    measure: Callable[[Bench], float] = {
        TERMINATE: _terminate,
        KILLED_PROCESS: _kill_process,
        OVER_LIMIT: _exceed_limit,
        INTERRUPT: lambda bench: _end_program(bench, signal.SIGINT),
        KILLED_PROGRAM: lambda bench: _end_program(bench, signal.SIGKILL),
    }[ending]
    return {TIME.name: measure(bench)}


def _terminate(bench: Bench) -> float:
    pool = bench.processes.Pool(2)
    pool.map(no_op, range(8), 1)
    pool.map_async(sleep, [_PATIENCE] * 10_000, 1)
    return _seconds(lambda: (pool.terminate(), pool.join()))


def _kill_process(bench: Bench) -> float:
    ours, theirs = bench.processes.Pipe()
    process = bench.processes.Process(target=_report_and_sleep, args=(theirs,))
    process.start()
    ours.recv()
    seconds = _seconds(lambda: (process.kill(), process.join()))
    ours.close()
    theirs.close()
    return seconds


def _report_and_sleep(connection: Any) -> None:
    connection.send("here")
    sleep(_PATIENCE)


def _exceed_limit(bench: Bench) -> float:
    pool = bench.processes.Pool(1)
    pool.map(no_op, range(4), 1)

    def exceed() -> None:
        with contextlib.suppress(bench.processes.TimeoutError):
            pool.apply(sleep, (_PATIENCE,), timeout=_LIMIT)

    seconds = _seconds(exceed)
    pool.terminate()
    pool.join()
    return seconds - _LIMIT


def _end_program(bench: Bench, signum: int) -> float:
    """Start a program, send it the signal, and wait until all of its processes are gone."""
    with subprocess.Popen(
        [sys.executable, str(_PROGRAM), bench.contender],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        process_group=0,
    ) as program:
        assert program.stdout is not None
        program.stdout.readline()
        family = [program.pid, *processes.descendants(program.pid)]
        send = os.kill if signum == signal.SIGKILL else os.killpg
        begin = time.perf_counter()
        send(program.pid, signum)
        program.wait(_PATIENCE)
        while any(processes.runs(pid) for pid in family[1:]):
            if time.perf_counter() - begin > _PATIENCE:
                raise TimeoutError(f"processes were left after {_PATIENCE:.0f} s")
            time.sleep(_PAUSE)
        return time.perf_counter() - begin


def _seconds(action: Callable[[], object]) -> float:
    begin = time.perf_counter()
    action()
    return time.perf_counter() - begin
