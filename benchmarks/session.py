"""Session with a contender process: start it, ask it, stop it, and leave none of its processes
behind."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks import processes
from benchmarks.contenders import Contender
from benchmarks.model import Case

ROOT = Path(__file__).resolve().parent.parent
_STAND_INS = ROOT / "tests" / "stand_ins"
_ORDERLY = 20.0
_STRAGGLERS = 3.0


class Failed(Exception):
    """Failure of a contender in a case; the text says why. Its session is of no more use.

    `after`: the seconds after which it was stopped, if it was merely too slow.
    """

    def __init__(self, why: str, after: float | None = None) -> None:
        super().__init__(why)
        self.after = after


class Session:
    """Contender process, and every process below it."""

    def __init__(self, contender: Contender, scratch: Path) -> None:
        self.contender = contender
        self._log = scratch / f"{contender.name}.log"
        self._rest = b""
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "benchmarks.contender",
                    contender.name,
                    "servers" if contender.servers else "light",
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                cwd=scratch,
                env=_environment(contender, scratch),
                process_group=0,  # Ctrl-C is for the run, which stops the contenders
            )

    @property
    def pid(self) -> int:
        """Return the pid of the contender process."""
        return self._process.pid

    def run(self, case: Case) -> dict[str, float]:
        """Return the contender's sample for the case; `Failed` if it raised, died, or was too
        slow."""
        request = {"measure": case.measure, "params": dict(case.params)}
        try:
            self._stdin().write(json.dumps(request).encode() + b"\n")
            self._stdin().flush()
        except BrokenPipeError:
            raise Failed(self._died()) from None
        reply = json.loads(self._line(case.limit))
        if "error" in reply:
            raise Failed(reply["error"])
        sample: dict[str, float] = reply["values"]
        return sample

    def stop(self) -> None:
        """Let it end by itself; if it does not, kill it and all below it."""
        self._close_stdin()
        self._end(_ORDERLY)

    def interrupt(self) -> None:
        """Stop it even in the middle of a case: first as Ctrl-C would, then by force."""
        self._process.send_signal(signal.SIGINT)
        self._close_stdin()
        self._end(_STRAGGLERS)

    def _kill(self) -> None:
        """Stop it and all below it by force."""
        for pid in (self.pid, *processes.descendants(self.pid)):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._end(_ORDERLY)

    def _close_stdin(self) -> None:
        with contextlib.suppress(BrokenPipeError):
            self._stdin().close()

    def _end(self, patience: float) -> None:
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            self._kill()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def _stdin(self) -> Any:
        assert self._process.stdin is not None
        return self._process.stdin

    def _line(self, limit: float) -> bytes:
        """Return the next line of the contender, and keep what follows for later."""
        assert self._process.stdout is not None
        fd, end = self._process.stdout.fileno(), time.monotonic() + limit
        while b"\n" not in self._rest:
            # In short waits, since a child that outlives a dead contender keeps the pipe open.
            readable = select.select([fd], [], [], 0.5)[0]
            data = os.read(fd, 1 << 16) if readable else b""
            self._rest += data
            if not data and (readable or self._process.poll() is not None):
                raise Failed(self._died())
            if not data and time.monotonic() > end:
                raise Failed(f"not finished after {limit:.0f} s", after=limit)
        line, _, self._rest = self._rest.partition(b"\n")
        return line

    def _died(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_STRAGGLERS)
        words = [
            line for line in self._log.read_text(errors="replace").splitlines() if line.strip()
        ]
        message = words[-1][:200] if words else "no message"
        return f"ended with exit status {self._process.returncode}: {message}"


def sweep(living: set[int]) -> list[str]:
    """Kill what ended sessions left behind, and return its names; allow a moment to end first.

    This process adopts orphans, so every process that was left behind is a child of it that is in
    no living session.
    """
    end = time.monotonic() + _STRAGGLERS
    while (left := _left(living)) and time.monotonic() < end:
        _reap(left)
        time.sleep(0.02)
    killed = []
    for top in _left(living):
        for pid in (top, *processes.descendants(top)):
            killed.append(processes.name_of(pid))
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
    while left := _left(living):
        _reap(left)
        time.sleep(0.02)
    return killed


def _left(living: set[int]) -> list[int]:
    below = processes.children_of_all(zombies=True).get(os.getpid(), [])
    return [pid for pid in below if pid not in living]


def _reap(pids: list[int]) -> None:
    for pid in pids:
        with contextlib.suppress(ChildProcessError):
            os.waitpid(pid, os.WNOHANG)


def _environment(contender: Contender, scratch: Path) -> dict[str, str]:
    # Absolute, as a contender works in the scratch folder.
    given = os.environ.get("PYTHONPATH", "")
    paths = [str(ROOT), *(os.path.abspath(path) for path in given.split(os.pathsep) if path)]
    if contender.needs_stand_in():
        paths.append(str(_STAND_INS))
    return {
        **os.environ,
        **contender.environment,
        "PYTHONPATH": os.pathsep.join(paths),
        "TMPDIR": str(scratch),
        "IPYTHONDIR": str(scratch / "ipython"),
        "DASK_TEMPORARY_DIRECTORY": str(scratch),
        "PYSPARK_PYTHON": sys.executable,
        "SPARK_LOCAL_IP": "127.0.0.1",
        "JAVA_TOOL_OPTIONS": "-XX:-UsePerfData",
        "RAY_USAGE_STATS_ENABLED": "0",
        "PYTHONWARNINGS": "ignore",
    }
