"""Start of pools in a program whose main module uses JAX, which starts threads at import."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.model import Case, Metric

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Start with JAX"
ABOUT = """\
A separate program, whose main module makes a JAX array when it is imported. JAX starts threads,
and a process with threads cannot be forked safely. The program makes two pools, one after the
other. Times count from the call of `Pool(n)` until a first map is complete whose n tasks multiply
JAX arrays. `fork` does not take part: JAX warns that it is likely to deadlock. The ratio is to
multiprocessing with `forkserver`."""

FIRST = Metric("first", "first pool", "s")
SECOND = Metric("second", "second pool", "s")
WORKERS = (2, 8)
NEEDS = "start with jax"
CONTENDERS = ("fiber", "fiber-loopback", "forkserver", "spawn")
_PROGRAM = Path(__file__).with_name("jax_program.py")
_LIMIT = 120.0


def case_name(workers: int) -> str:
    """Return the name of the case with so many workers."""
    return f"{workers} workers"


def cases(size: float) -> list[Case]:
    """Return the same cases at each size."""
    missing = importlib.util.find_spec("jax") is None
    return [
        Case(
            measure="jax_start",
            name=case_name(workers),
            group="pool",
            needs=NEEDS,
            params={"workers": workers},
            metrics=(FIRST, SECOND),
            limit=_LIMIT,
            baseline="forkserver",
            not_run=dict.fromkeys(CONTENDERS, "jax is not installed") if missing else {},
        )
        for workers in WORKERS
    ]


def run(bench: Bench, workers: int) -> dict[str, float]:
    """Return the times of both pools of a new program."""
    command = [sys.executable, str(_PROGRAM), bench.contender, str(workers)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, timeout=_LIMIT)
    first, second = map(float, done.stdout.split())
    return {FIRST.name: first, SECOND.name: second}
