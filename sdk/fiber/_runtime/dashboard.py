"""Live page of this program: the command ``fiber dashboard`` as a process beside it.

The process asks the program's monitor as any other client does.  It ends when its standard input
ends, so it also ends with a program that is killed.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys

from fiber._agent.zygote_process import interpreter_arguments, is_standard_stream

_STATEMENT = "from fiber._cli.main import main; main()"

_ENDS_WITHIN = 3.0
"""Seconds in which the process shows the end of the program to its pages, and ends."""


class DashboardProcess:
    """Process that serves the page of this program, and prints its address on stderr.

    If it cannot serve, it says so on stderr, and ends.
    """

    def __init__(self, monitor: str, name: str) -> None:
        """Start it, for the program whose monitor has the socket ``monitor``; OSError."""
        self._process = subprocess.Popen(
            [*interpreter_arguments(sys.executable, _STATEMENT), "dashboard", "--for-program"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=None if is_standard_stream(2) else subprocess.DEVNULL,
            bufsize=0,
            process_group=0,  # Ctrl-C in the terminal is for the program
        )
        line = json.dumps({"monitor": monitor, "name": name}).encode() + b"\n"
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended already
            self._process.stdin.write(line)

    def close(self) -> None:
        """End the process, after a last look at the program.  Not on the loop thread."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(_ENDS_WITHIN)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def forget(self) -> None:
        """Close this process's copy of the pipe, after a fork."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.returncode = 0  # keeps its destructor from a warning
