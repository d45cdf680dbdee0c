"""Cold start: from the start of an interpreter to the first worker and the first map."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from benchmarks.model import Case, Metric
from benchmarks.startup import meeting_point

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Cold start"
ABOUT = """\
A separate program, started as a user starts one: `python program.py`. It imports the library,
makes `Pool(n)` with an initializer, and maps a no-op over n items in default chunks. Times count
from the moment at which the interpreter is started, so they include its start.
Ready: the last of the n workers has run its initializer. First map: `map` has returned. The value
of a round is the median of its programs. Bytecode is cached, except in the last case. There no
module has any, not even the standard library's, as in a first run on a new machine. `import fiber`
alone is on the page [Start-up](startup.md)."""

READY = Metric("ready", "workers ready", "s")
MAP = Metric("map", "first map", "s")
WORKERS = (1, 5)
_PROGRAM = Path(__file__).with_name("cold_program.py")
_PATIENCE = 20.0
_FAST = 5
Stamps = list[tuple[str, int]]


def case_name(workers: int, *, cached: bool = True) -> str:
    """Return the name of the case with so many workers."""
    name = f"{workers} worker{'s' if workers > 1 else ''}"
    return name if cached else f"{name}, no cached bytecode"


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, fewer programs."""
    return [
        Case(
            measure="coldstart",
            name=case_name(workers, cached=cached),
            group="with cached bytecode" if cached else "without cached bytecode",
            needs="cold start",
            params={
                "workers": workers,
                "cached": cached,
                "programs": max(1, round((_FAST if cached else 3) * size)),
            },
            metrics=(READY, MAP),
            limit=30.0,
        )
        for workers, cached in ((1, True), (5, True), (5, False))
    ]


def run(bench: Bench, workers: int, cached: bool, programs: int) -> dict[str, float]:
    """Return the median times over so many programs, after one that writes the bytecode."""
    times = []
    with _bytecode_folder(writable=cached) as environment:
        if cached:
            _times_of_one(bench.contender, workers, environment)
        for _ in range(programs):
            times.append(_times_of_one(bench.contender, workers, environment))
    return {name: median(each[name] for each in times) for name in (READY.name, MAP.name)}


@contextmanager
def _bytecode_folder(*, writable: bool) -> Iterator[dict[str, str]]:
    """Return an environment in which only the cached bytecode of `folder` is found, if any may be.

    All contenders then have the same cache, regardless of the machine's settings.
    """
    with tempfile.TemporaryDirectory() as folder:
        forbidden = "" if writable else "1"
        yield {"PYTHONPYCACHEPREFIX": folder, "PYTHONDONTWRITEBYTECODE": forbidden}


def _times_of_one(contender: str, workers: int, environment: Mapping[str, str]) -> dict[str, float]:
    command = [sys.executable, str(_PROGRAM), contender, str(workers)]
    with meeting_point() as (path, fd):
        begin = time.monotonic_ns()
        with subprocess.Popen(
            [*command, path], stdin=subprocess.PIPE, env={**os.environ, **environment}
        ) as program:
            try:
                stamps = _stamps(fd, workers + 1)
            except BaseException:
                program.kill()
                raise
            assert program.stdin is not None
            program.stdin.close()
        if program.returncode:
            raise RuntimeError(f"the program ended with exit status {program.returncode}")
    return times_from(begin, stamps)


def times_from(begin: int, stamps: Sequence[tuple[str, int]]) -> dict[str, float]:
    """Return nanoseconds from `begin` to the last worker and to the end of the map."""
    moments = dict(sorted(stamps, key=lambda stamp: stamp[1]))  # the last line of each kind wins
    return {
        READY.name: (moments["worker"] - begin) / 1e9,
        MAP.name: (moments["map"] - begin) / 1e9,
    }


def _stamps(fd: int, count: int) -> Stamps:
    text, end = b"", time.monotonic() + _PATIENCE
    while text.count(b"\n") < count:
        if not select.select([fd], [], [], max(0.0, end - time.monotonic()))[0]:
            raise TimeoutError(f"{text!r} was all that came from the program in {_PATIENCE:g} s")
        text += os.read(fd, 4096)
    return [(what, int(at)) for what, at in (line.split() for line in text.decode().splitlines())]
