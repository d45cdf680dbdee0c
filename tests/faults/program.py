"""Program that uses Fiber, run as a separate process that a test watches, breaks and counts.

Everything that it starts carries its marker, so that what it left can be found under any adopter;
its temporary files lie in a folder of its own.
"""

from __future__ import annotations

import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import census
from patience import PATIENCE

LOOPBACK = {"FIBER_BACKEND": "loopback", "FIBER_AGENTS": "1"}
"""The environment that puts a program's processes behind an agent."""


class Program:
    """A running script.  Its output is read line by line, its stderr kept."""

    def __init__(
        self, script: str, *arguments: str, env: Mapping[str, str] | None = None, **options: Any
    ) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="p-"))
        self.temporary = self.folder / "t"
        self.temporary.mkdir()
        self.script = self.folder / "program.py"
        self.script.write_text(textwrap.dedent(script))
        self._stderr = self.folder / "stderr"
        self._rest = b""
        marker = uuid.uuid4().hex
        self._marker = f"FAULTS_PROGRAM={marker}"
        environ = {
            **os.environ,
            "FAULTS_PROGRAM": marker,
            "TMPDIR": str(self.temporary),
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            **(env or {}),
        }
        with self._stderr.open("wb") as stderr:
            self.process = subprocess.Popen(
                [sys.executable, str(self.script), *arguments],
                **{
                    "stdout": subprocess.PIPE,
                    "stderr": stderr,
                    "env": environ,
                    "cwd": self.folder,
                    **options,
                },
            )

    @property
    def pid(self) -> int:
        return self.process.pid

    @property
    def stderr(self) -> str:
        """Return the text that the program and its processes have written to stderr so far."""
        return self._stderr.read_text(errors="replace")

    @property
    def answer(self) -> str:
        """Content of the file ``answer`` in its working directory."""
        return (self.folder / "answer").read_text()

    def line(self, seconds: float = PATIENCE) -> str:
        """The next line of its stdout."""
        stdout = self.process.stdout
        assert stdout is not None
        deadline = time.monotonic() + seconds
        while b"\n" not in self._rest:
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([stdout], [], [], left)[0]:
                raise AssertionError(f"no line within {seconds:g} s; stderr:\n{self.stderr}")
            data = os.read(stdout.fileno(), 1 << 16)
            if not data:
                raise AssertionError(f"it ended its output; stderr:\n{self.stderr}")
            self._rest += data
        line, _, self._rest = self._rest.partition(b"\n")
        return line.decode()

    def rest(self, seconds: float = PATIENCE) -> str:
        """Return the rest of its stdout, up to the end."""
        stdout = self.process.stdout
        assert stdout is not None
        deadline = time.monotonic() + seconds
        while select.select([stdout], [], [], max(0.0, deadline - time.monotonic()))[0]:
            data = os.read(stdout.fileno(), 1 << 16)
            if not data:
                return self._rest.decode()
            self._rest += data
        raise AssertionError(f"its output did not end within {seconds:g} s")

    def family(self) -> list[census.Found]:
        """Return the processes that it has started and that still exist."""
        return [
            found for found in census.started_by(self.pid, self._marker) if self._is_ours(found)
        ]

    def _is_ours(self, found: census.Found) -> bool:
        return found.pid != self.pid and found.state != "Z"

    def signal(self, signum: int) -> None:
        self.process.send_signal(signum)

    def kill(self) -> None:
        """SIGKILL, and wait for it."""
        self.process.kill()
        self.process.wait(PATIENCE)

    def wait(self, seconds: float = PATIENCE) -> int:
        """Return its exit status, once it has ended by itself."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            family = "\n".join(map(str, self.family()))
            raise AssertionError(
                f"it still runs after {seconds:g} s; stderr:\n{self.stderr}\nand:\n{family}"
            ) from None

    def left(self, seconds: float = PATIENCE) -> list[str]:
        """Name the processes and temporary files that are still there after ``seconds``."""

        def nothing() -> bool:
            return not self.family() and not any(self.temporary.iterdir())

        if census.wait_until(nothing, seconds):
            return []
        files = [str(path) for path in self.temporary.iterdir()]
        return [*map(str, self.family()), *files]

    def finish(self, seconds: float = PATIENCE) -> str:
        """Wait for a good end without leftovers; return the rest of its output."""
        output = self.rest(seconds)
        status = self.wait(seconds)
        assert status == 0, f"exit status {status}; stderr:\n{self.stderr}"
        assert self.left() == []
        return output

    def close(self) -> None:
        """End all that is left."""
        self.process.kill()
        self.process.wait()
        census.kill(self.family())
        if self.process.stdout is not None:
            self.process.stdout.close()
        shutil.rmtree(self.folder)


def wait_for(condition: Callable[[], bool], seconds: float = PATIENCE, what: str = "") -> None:
    """Wait until ``condition`` is true; an AssertionError when it is not within ``seconds``."""
    assert census.wait_until(condition, seconds), f"not within {seconds:g} s: {what or condition}"


def alive(pid: int) -> bool:
    """Return whether a process runs; a zombie does not."""
    found = census.read(pid)
    return found is not None and found.state != "Z"


def stop_and_wait(pid: int) -> None:
    """SIGSTOP, in force when this returns."""
    os.kill(pid, signal.SIGSTOP)
    wait_for(lambda: (found := census.read(pid)) is not None and found.state == "T")
