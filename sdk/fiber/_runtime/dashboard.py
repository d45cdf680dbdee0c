"""Live page of this program: the command ``fiber dashboard`` as a process beside it.

The process asks the program's monitor as any other client does.  It ends when its standard input
ends, so it also ends with a program that is killed.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading

from fiber._agent.zygote_process import interpreter_arguments
from fiber._logs import OutputWriter
from fiber._transport.loop import Loop

_STATEMENT = "from fiber._cli.main import main; main()"

_ENDS_WITHIN = 3.0
"""Seconds in which the process shows the end of the program to its pages, and ends."""

_PIECE = 1 << 12


class DashboardProcess:
    """Process that serves the page of this program.

    What it prints comes to the program's stderr, also in a notebook: the address of the page, or
    why there is none.
    """

    def __init__(self, loop: Loop, monitor: str, name: str) -> None:
        """Start it, for the program whose monitor has the socket ``monitor``; OSError.

        Runs on the loop thread.
        """
        self._loop = loop
        self._output = OutputWriter()
        self._read = b""
        executable, *arguments = interpreter_arguments(sys.executable, _STATEMENT)
        self._process = subprocess.Popen(
            # -P: the working directory may have modules with the names of other ones.
            [executable, "-P", *arguments, "dashboard", "--for-program"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            bufsize=0,
            process_group=0,  # Ctrl-C in the terminal is for the program
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._stdin, self._stdout = self._process.stdin, self._process.stdout
        os.set_blocking(self._stdout.fileno(), False)
        loop.register(self._stdout.fileno(), self._show)
        line = json.dumps({"monitor": monitor, "name": name}).encode() + b"\n"
        with contextlib.suppress(BrokenPipeError):  # it has ended already
            self._stdin.write(line)

    def _show(self) -> None:
        """Pass on the lines that have come.  Runs on the loop thread."""
        while not self._stdout.closed:
            data: bytes | None = self._stdout.read(_PIECE)
            if data is None:
                return
            *lines, self._read = (self._read + data).split(b"\n")
            if lines:
                self._output.write("fiber", b"\n".join(lines).decode(errors="replace"))
            if not data:
                self._loop.unregister(self._stdout.fileno())
                self._stdout.close()

    def close(self) -> None:
        """End the process, after a last look at the program.  Not on the loop thread."""
        self._stdin.close()
        try:
            self._process.wait(_ENDS_WITHIN)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        shown = threading.Event()
        self._loop.call_soon(self._show)
        self._loop.call_soon(shown.set)
        shown.wait(_ENDS_WITHIN)
        self._output.close()

    def forget(self) -> None:
        """Close this process's copies of the pipes, after a fork."""
        self._stdin.close()
        self._stdout.close()
        self._process.returncode = 0  # keeps its destructor from a warning
