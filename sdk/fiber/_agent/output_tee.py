"""Output of a child of this host, which goes to a file, too.

The child itself writes the file, so its output stays as it is: the same terminal and the same
order.  Only what leaves by ``sys.stdout`` and ``sys.stderr`` is kept, and
not what native code and other programs write to the descriptors.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import os
import sys
import threading
import time
from multiprocessing import process as mp_process
from typing import Any

from fiber._agent.child import write_whole_lines
from fiber._output_files import OutputFile, with_time

passed: tuple[str, str, bool] | None = None
"""Arguments of ``install`` in this process, which its children get, too; None if not installed."""


def install(folder: str, program: str, times: bool) -> None:
    """Have the standard streams of this process write to its file in ``folder``, too.

    ``times``: put the time before each line in the file.
    """
    global passed
    passed = folder, program, times
    file = TeeFile(OutputFile(folder, program, mp_process.current_process().name), times)
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        # The user may have closed or replaced the stream.
        with contextlib.suppress(AttributeError, OSError, ValueError):
            stream: Any = getattr(sys, name)
            if type(stream) is io.TextIOWrapper and stream.fileno() == descriptor:
                _tee(stream, TeeStream(descriptor, f"<{name}>", file))
    write_whole_lines()


def _tee(stream: Any, tee: TeeStream) -> None:
    """Put ``tee`` below a stream, which stays the same object for those that have it."""
    form = {"encoding": stream.encoding, "errors": stream.errors}
    stream.detach()
    stream.__init__(io.BufferedWriter(tee), **form)
    atexit.register(tee.finish, stream)


class TeeStream(io.FileIO):
    """Raw stream of a descriptor, whose output goes to a file, too."""

    def __init__(self, descriptor: int, name: str, file: TeeFile) -> None:
        super().__init__(descriptor, "wb", closefd=False)
        self.name = name
        self._file = file

    def write(self, data: Any) -> int:
        """Write to the descriptor, and add what was written to the file."""
        written = super().write(data)
        if written:
            self._file.write(self, bytes(memoryview(data)[:written]))
        return written

    def finish(self, stream: Any) -> None:
        """Write what ``stream`` has buffered, and end the last line in the file."""
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
        self._file.end_line(self)


class TeeFile:
    """File to which both streams of a child write.

    What a stream writes is there at once, so the last words of a killed child are there.  A stream
    that writes while the line of the other one has no end begins a new line.  ``times``: put the
    time before each line.
    """

    def __init__(self, file: OutputFile, times: bool = False) -> None:
        self._file = file
        self._times = times
        # A signal handler or finalizer of this thread may print meanwhile.
        self._lock = threading.RLock()
        os.register_at_fork(after_in_child=self._renew_lock)
        self._open: TeeStream | None = None
        """Stream whose line has no end."""

    def write(self, stream: TeeStream, data: bytes) -> None:
        """Append the output of a stream."""
        with self._lock:
            goes_on, before = self._open is stream, self._open is not None
            self._open = None if data.endswith(b"\n") else stream
            if self._times:
                data = _with_times(data, goes_on)
            self._append(data if goes_on or not before else b"\n" + data)

    def _renew_lock(self) -> None:
        # Another thread may have had it when the process forked.
        self._lock = threading.RLock()

    def end_line(self, stream: TeeStream) -> None:
        """End the line of a stream."""
        with self._lock:
            if self._open is stream:
                self._open = None
                self._append(b"\n")

    def _append(self, data: bytes) -> None:
        # A full disk, or a folder that is gone, costs only the lines in the file.
        with contextlib.suppress(OSError):
            self._file.append(data)


def _with_times(data: bytes, goes_on: bool) -> bytes:
    """Return lines with the time before each; the first one may go on with an earlier line."""
    text = data.decode(errors="surrogateescape")
    first, end, rest = text.partition("\n") if goes_on else ("", "", text)
    timed = with_time(rest, time.time()) if rest else ""
    return f"{first}{end}{timed}".encode(errors="surrogateescape")
