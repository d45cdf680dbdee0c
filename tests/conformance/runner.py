"""Runner of groups of CPython's tests in separate interpreters, which survives hangs and crashes.

One group is one class in one interpreter. A test over its limit is named, every process of the
group prints its stacks and is killed, and the rest of the group goes on in a new interpreter. What
did not pass in company is tried once more alone, to tell a fault of the test's own from one that
an earlier test left; the first verdict stands.
"""

from __future__ import annotations

import itertools
import json
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any

import census

TESTS = Path(__file__).resolve().parents[1]
WORKER = (sys.executable, "-m", "conformance.cpython_suite.worker")
MARKER = "CONFORMANCE_GROUP"
TRACKER = "multiprocessing.resource_tracker import main"
START_LIMIT = 60.0  # seconds for an interpreter to begin its first, or its next, test
EXIT_LIMIT = 10.0  # seconds for an interpreter to end after its last test
GONE_LIMIT = 5.0  # seconds for the processes of an ended interpreter to be gone
TAIL = 6000  # characters of output kept for a failure

_serial = itertools.count()


@dataclass(frozen=True)
class Target:
    """Object under test, and how it is tested."""

    module: str
    method: str
    tiers: frozenset[str]
    limit: float  # seconds for one test
    environment: tuple[tuple[str, str], ...] = ()
    lend: Callable[[], AbstractContextManager[Mapping[str, str]]] = lambda: nullcontext({})
    """Provider of an interpreter's private environment variables, while it runs."""

    def variables(self) -> dict[str, str]:
        """The environment of an interpreter that runs tests."""
        path = [str(TESTS), os.environ.get("PYTHONPATH", "")]
        return {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, path)),
            "PYTHONFAULTHANDLER": "1",
            "MP_MODULE": self.module,
            "MP_START_METHOD": self.method,
            "MP_TIERS": ",".join(sorted(self.tiers)),
            **dict(self.environment),
        }


@dataclass(frozen=True)
class Outcome:
    """Result of one test: pass, skip, fail, hang or crash."""

    id: str
    result: str
    seconds: float = 0.0
    detail: str = ""

    @property
    def class_name(self) -> str:
        return self.id.partition(".")[0]


@dataclass
class Report:
    """Result of a group, or of all of them."""

    outcomes: list[Outcome] = field(default_factory=list)
    fallbacks: set[str] = field(default_factory=set)
    missing: set[str] = field(default_factory=set)

    def extend(self, other: Report) -> None:
        self.outcomes += other.outcomes
        self.fallbacks |= other.fallbacks
        self.missing |= other.missing


def list_cases(target: Target) -> list[dict[str, Any]]:
    """Every test that the running Python has, as `build.Case` describes it."""
    done = subprocess.run(
        [*WORKER, "list"],
        env=target.variables(),
        capture_output=True,
        text=True,
        timeout=target.limit,
    )
    if done.returncode:
        raise RuntimeError(f"CPython's tests do not load with {target.module}:\n{done.stderr}")
    return [json.loads(line) for line in done.stdout.splitlines()]


def run_groups(target: Target, groups: Sequence[Sequence[str]], jobs: int) -> Report:
    """Every test of every group, `jobs` groups at a time."""
    report = Report()
    with ThreadPoolExecutor(jobs) as executor:
        for one in executor.map(lambda ids: run_group(target, ids), groups):
            report.extend(one)
    return report


def run_group(target: Target, ids: Sequence[str]) -> Report:
    """Every test of one group, in as few interpreters as their hangs and crashes allow."""
    report = Report()
    rest = list(ids)
    while rest:
        interpreter = _Interpreter(target, rest)
        report.extend(interpreter.run())
        rest = rest[interpreter.reached :]
    if len(ids) > 1:
        report.outcomes = [_tried_alone(target, outcome) for outcome in report.outcomes]
    return report


def _tried_alone(target: Target, outcome: Outcome) -> Outcome:
    if outcome.result in ("pass", "skip") or not _is_test(outcome.id):
        return outcome
    alone = _Interpreter(target, [outcome.id]).run().outcomes[0]
    return replace(outcome, detail=f"{outcome.detail}\nAlone in an interpreter: {alone.result}.")


def _is_test(id_: str) -> bool:
    return not id_.endswith(">")


class _Interpreter:
    """Run of some tests in one interpreter; `reached` is how many of them need no other one."""

    def __init__(self, target: Target, ids: Sequence[str]) -> None:
        self.target = target
        self.ids = ids
        self.reached = 0
        self.report = Report()
        self.current: str | None = None
        self.done = False
        self.broken = ""
        self._marker = f"{os.getpid()}-{next(_serial)}"
        self._partial = b""

    def run(self) -> Report:
        reports, writer = os.pipe()
        os.set_blocking(reports, False)
        with tempfile.TemporaryFile() as output, self.target.lend() as lent:
            try:
                process = self._start(writer, output, lent)
                os.close(writer)
                hung = not self._watch(process, reports)
                self._conclude(process, output, hung)
            finally:
                os.close(reports)
        return self.report

    def _start(
        self, writer: int, output: IO[bytes], lent: Mapping[str, str]
    ) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [*WORKER, "run", str(writer), *self.ids],
            env={**self.target.variables(), **lent, MARKER: self._marker},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            pass_fds=[writer],
            start_new_session=True,
        )

    def _watch(self, process: subprocess.Popen[bytes], reports: int) -> bool:
        """Follows the interpreter to its end; False when a test, or the end, took too long."""
        with selectors.DefaultSelector() as selector, _pidfd(process.pid) as ended:
            selector.register(reports, selectors.EVENT_READ)
            selector.register(ended, selectors.EVENT_READ)
            deadline = time.monotonic() + self._limit()
            while True:
                ready = {key.fd for key, _ in selector.select(deadline - time.monotonic())}
                if reports in ready:
                    if not self._read(reports):
                        selector.unregister(reports)
                    deadline = time.monotonic() + self._limit()
                elif ended in ready:
                    process.wait()
                    return True
                elif time.monotonic() >= deadline:
                    return False

    def _limit(self) -> float:
        """Return the seconds until the next report must come."""
        if self.done:
            return EXIT_LIMIT
        return self.target.limit if self.current else max(START_LIMIT, self.target.limit)

    def _read(self, reports: int) -> bool:
        chunk = os.read(reports, 1 << 16)
        *lines, self._partial = (self._partial + chunk).split(b"\n")
        for line in lines:
            self._take(json.loads(line))
        return bool(chunk)

    def _take(self, report: dict[str, Any]) -> None:
        match report.pop("event"):
            case "start":
                self.current = report["id"]
            case "end":
                report["result"] = report.pop("outcome")
                self._record(Outcome(**report))
            case "broken":
                self.broken += report["detail"]
            case "done":
                self.done = True
                self.report.fallbacks.update(report["fallbacks"])
                self.report.missing.update(report["missing"])

    def _record(self, outcome: Outcome) -> None:
        self.report.outcomes.append(outcome)
        self.current = None
        if _is_test(outcome.id):
            self.reached += 1

    def _conclude(self, process: subprocess.Popen[bytes], output: IO[bytes], hung: bool) -> None:
        if hung:
            self._dump_stacks(process)
            census.kill(self._started(process, trackers=False))
            process.kill()
            process.wait()
        left = self._left_behind(process)
        census.kill(left)
        output.seek(0)
        tail = output.read().decode(errors="replace")[-TAIL:]
        if hung:
            self._blame("hang", f"over {self.target.limit:g} s; every process's stacks:\n{tail}")
        elif not self.done:
            self._blame("crash", f"interpreter ended with {process.returncode}:\n{tail}")
        elif left:
            listing = "\n".join(map(str, left))
            self._record(Outcome(self._pseudo("left behind"), "fail", GONE_LIMIT, listing))
        self._give_up_on_unreached(tail)

    def _blame(self, result: str, detail: str) -> None:
        """Lays a hang or a crash on the running test, or on the time after the last one."""
        self._record(Outcome(self.current or self._pseudo("exit"), result, detail=detail))

    def _give_up_on_unreached(self, tail: str) -> None:
        """Tests that an ended, unbroken interpreter never reported cannot be had by another one."""
        if self.reached and not self.done:
            return
        ran = {outcome.id for outcome in self.report.outcomes}
        for id_ in self.ids:
            if id_ not in ran:
                self._record(Outcome(id_, "fail", detail=self.broken or f"never ran:\n{tail}"))

    def _pseudo(self, what: str) -> str:
        return f"{self.ids[0].partition('.')[0]}.<{what}>"

    def _dump_stacks(self, process: subprocess.Popen[bytes]) -> None:
        """SIGABRT makes faulthandler print the stacks of all threads of a process."""
        for pid in (process.pid, *(found.pid for found in self._started(process, trackers=False))):
            try:
                os.kill(pid, signal.SIGABRT)
            except ProcessLookupError:
                pass  # the process has ended, so it does not hang
        census.wait_until(lambda: process.poll() is not None, 2)

    def _left_behind(self, process: subprocess.Popen[bytes]) -> list[census.Found]:
        census.wait_until(lambda: not self._started(process), GONE_LIMIT)
        return self._started(process)

    def _started(
        self, process: subprocess.Popen[bytes], *, trackers: bool = True
    ) -> list[census.Found]:
        """Find its processes.  Resource trackers, which clean up for others, end after them."""
        found = census.started_by(process.pid, f"{MARKER}={self._marker}")
        return [one for one in found if trackers or TRACKER not in one.command]


@contextmanager
def _pidfd(pid: int) -> Iterator[int]:
    descriptor = os.pidfd_open(pid)
    try:
        yield descriptor
    finally:
        os.close(descriptor)
