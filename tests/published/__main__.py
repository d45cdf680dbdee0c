"""Published programs on Fiber, compared with the same programs on multiprocessing:

    python -m published CLONES [--only NAME …] [--backends local loopback kubernetes]

CLONES is a folder with a clone of each project.  The results go to docs/published.json and into the
table of docs/published.md.  The exit status is 0 if all programs ran and gave the same values.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from published import checks, table
from published.comparing import difference, leaves
from published.records import Program, programs

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "published.json"
PAGE = ROOT / "docs" / "published.md"
_END = 60.0
"""Seconds in which killed processes have ended."""


@dataclass(frozen=True)
class Ended:
    """End of one run: what it wrote, or why it failed."""

    result: dict[str, Any] | None
    failure: str = ""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the chosen programs; return 0 if each ran and repeated multiprocessing's values."""
    every = programs()
    options = _parse(every, arguments)
    failed = []
    for name in options.only:
        if not compare(every[name], options.clones, options.backends):
            failed.append(name)
    if failed:
        print(f"published: not run, or not the same: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def compare(program: Program, clones: Path, backends: Sequence[str]) -> bool:
    """Run one program on all backends and write its results; False if one is missing or differs."""
    if line := checks.missing(program, clones):
        print(line, file=sys.stderr)
        return False
    clone = clones / program.clone
    _note_other_commit(program, clone)
    outcome: dict[str, str] = {}
    changed: list[str] = []
    expected = _run(program, clone, program.reference).result
    for backend in backends:
        ended = _run(program, clone, backend) if expected else Ended(None, "no reference")
        if expected and ended.result:
            changed = ended.result["changed"]
        outcome[backend] = verdict(expected, ended)
        print(f"{program.name} on {backend}: {outcome[backend]}", flush=True)
    if expected:
        _write(program.name, checks.commit(clone), changed, outcome)
    return bool(expected) and all(each.startswith("same") for each in outcome.values())


def _note_other_commit(program: Program, clone: Path) -> None:
    """Say which commit ran before if it is not that of the clone."""
    before = table.read(RESULTS).get(program.name, {}).get("commit")
    now = checks.commit(clone)
    if before and now != before:
        print(
            f"{program.name}: {clone} is at commit {now}, and the table has {before}. If it fails, "
            f"check out that one: git -C {clone} checkout {before}",
            file=sys.stderr,
        )


def _write(name: str, commit: str, changed: list[str], outcome: dict[str, str]) -> None:
    """Add results to the file and the page, so that an interrupted run keeps what it has found."""
    results = table.read(RESULTS)
    table.add(results, name, commit, changed, outcome)
    table.write(RESULTS, results)
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(table.put_into(page, table.rows(programs(), results)), encoding="utf-8")


def verdict(expected: dict[str, Any] | None, ended: Ended) -> str:
    """Return the result of a backend's run in the words of the table."""
    if expected is None:
        return "not run: it failed with multiprocessing"
    if ended.result is None:
        return f"failed: {ended.failure}"
    found = difference(expected["values"], ended.result["values"])
    if found:
        return f"differs: {found}"
    values = list(leaves(expected["values"]).values())
    if not values:
        return "failed: it gave no values to compare"
    failures = sum(value in ("failure", "error") for value in values)
    return f"same ({len(values)} values{f', {failures} of them failures' if failures else ''})"


def _run(program: Program, clone: Path, backend: str) -> Ended:
    """Run the program once, in a process of its own session."""
    with tempfile.TemporaryDirectory(prefix="published-", ignore_cleanup_errors=True) as parent:
        folder = Path(parent, "run")
        folder.mkdir()
        names = [program.name, backend, str(clone), str(folder)]
        process = subprocess.Popen(
            [sys.executable, "-m", "published.child", *names],
            cwd=folder,
            env=_environment(),
            stdout=sys.stderr,
            start_new_session=True,
        )
        try:
            status = process.wait(program.seconds)
        except subprocess.TimeoutExpired:
            return Ended(None, f"it took longer than {program.seconds:g} seconds")
        finally:
            _end(process)
        written = Path(f"{folder}.json")
        if status or not written.exists():
            return Ended(None, f"status {status}; its output is above")
        return Ended(json.loads(written.read_text(encoding="utf-8")))


def _environment() -> dict[str, str]:
    """Return the environment of runs.

    Libraries have one thread each, so that sums are the same, and children may take long to import
    them on a busy machine.
    """
    paths = [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    single = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    ours = {
        "FIBER_START_TIMEOUT": "600",
        "PYTHONHASHSEED": "0",
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
    }
    return {**os.environ, **single, **ours}


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill the processes that a run has left in its session, also those of other groups."""
    deadline = time.monotonic() + _END
    while (left := _living(process.pid)) and time.monotonic() < deadline:
        for pid in left:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.05)
    if left:
        print(f"published: these processes do not end: {left}", file=sys.stderr)


def _living(session: int) -> list[int]:
    """Return the processes of a session, without those that have ended."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended
            state, _parent, _group, its_session = path.read_text().rpartition(")")[2].split()[:4]
            if int(its_session) == session and state not in "ZX":
                found.append(int(path.parent.name))
    return found


def _parse(every: dict[str, Program], arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="published")
    parser.add_argument("clones", help="folder with a clone of each project")
    parser.add_argument("--only", nargs="+", metavar="NAME", default=list(every))
    parser.add_argument("--backends", nargs="+", choices=table.BACKENDS, default=available())
    options = parser.parse_args(arguments)
    if not options.clones:
        parser.error("name the folder with the clones: make published CLONES=folder")
    options.clones = Path(options.clones)
    if not options.clones.is_dir():
        parser.error(f"{options.clones} is no folder: name the folder with the clones")
    if unknown := [name for name in options.only if name not in every]:
        parser.error(f"there is no program {unknown[0]}: choose from {', '.join(every)}")
    if unable := [name for name in options.backends if name not in available()]:
        parser.error(f"{unable[0]} needs a cluster and an image: set KUBECONFIG and FIBER_IMAGE")
    options.clones = options.clones.resolve()
    return options


def available() -> list[str]:
    """Return the backends that can run here: pods need a cluster and an image."""
    pods = os.environ.get("KUBECONFIG") and os.environ.get("FIBER_IMAGE")
    return [name for name in table.BACKENDS if name != "kubernetes" or pods]


if __name__ == "__main__":
    sys.exit(main())
