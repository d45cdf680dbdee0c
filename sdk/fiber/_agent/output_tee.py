"""Output of a child of this host, which goes to a file, too.

The child itself writes the file, so its output stays as it is: the same terminal and the same
order.  Only what leaves by ``sys.stdout`` and ``sys.stderr`` is kept, and
not what native code and other programs write to the descriptors.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import sys
import time
from multiprocessing import process as mp_process
from typing import Any

from fiber._agent.child import write_whole_lines
from fiber._output_files import OutputFile, with_time

_LONGEST = 1 << 16
"""Bytes of a line without an end that are kept back."""

passed: tuple[str, str, bool] | None = None
"""Arguments of ``install`` in this process, which its children get, too; None if not installed."""


def install(folder: str, program: str, times: bool) -> None:
    """Have the standard streams of this process write to its file in ``folder``, too.

    ``times``: put the time before each line in the file.
    """
    global passed
    passed = folder, program, times
    file = OutputFile(folder, program, mp_process.current_process().name)
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        # The user may have closed or replaced the stream.
        with contextlib.suppress(AttributeError, OSError, ValueError):
            stream: Any = getattr(sys, name)
            if type(stream) is io.TextIOWrapper and stream.fileno() == descriptor:
                _tee(stream, TeeStream(descriptor, f"<{name}>", file, times))
    write_whole_lines()


def _tee(stream: Any, tee: TeeStream) -> None:
    """Put ``tee`` below a stream, which stays the same object for those that have it."""
    form = {"encoding": stream.encoding, "errors": stream.errors}
    stream.detach()
    stream.__init__(io.BufferedWriter(tee), **form)
    atexit.register(tee.finish, stream)


class TeeStream(io.FileIO):
    """Raw stream of a descriptor, whose whole lines go to a file, too."""

    def __init__(self, descriptor: int, name: str, file: OutputFile, times: bool = False) -> None:
        super().__init__(descriptor, "wb", closefd=False)
        self.name = name
        self._file = file
        self._times = times
        self._rest = b""

    def write(self, data: Any) -> int:
        """Write to the descriptor, and add what was written to the file."""
        written = super().write(data)
        if written:
            lines, end, self._rest = (self._rest + bytes(memoryview(data)[:written])).rpartition(
                b"\n"
            )
            self._append(lines + end)
            if len(self._rest) > _LONGEST:
                self._append(self._rest)
                self._rest = b""
        return written

    def finish(self, stream: Any) -> None:
        """Add a last line without an end."""
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
        if self._rest:
            self._append(self._rest + b"\n")
            self._rest = b""

    def _append(self, data: bytes) -> None:
        if data and self._times:
            data = with_time(data.decode(errors="surrogateescape"), time.time()).encode(
                errors="surrogateescape"
            )
        if data:
            # A full disk, or a folder that is gone, costs only the lines in the file.
            with contextlib.suppress(OSError):
                self._file.append(data)
