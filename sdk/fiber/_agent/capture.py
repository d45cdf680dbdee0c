"""Capture of a remote child's output: read by lines, passed on, its last lines kept."""

from __future__ import annotations

import fcntl
import os
from collections import deque
from collections.abc import Callable

from fiber._transport.loop import Loop
from fiber._transport.unix import naming_the_limit

LAST_LINES = 20
"""Lines kept to explain a death."""

_CHUNK = 1 << 16
_LONGEST = 1 << 13
"""Bytes after which a line without an end is passed on in pieces."""


class Capture:
    """Pipe for one child's stdout and stderr.  Runs on the loop's thread."""

    def __init__(self, loop: Loop, write: Callable[[str], None], busy: Callable[[], bool]) -> None:
        self._loop = loop
        self._write = write
        self._busy = busy
        with naming_the_limit("capturing the output of a process"):
            self._reader, self._writer = os.pipe2(os.O_CLOEXEC)
        os.set_blocking(self._reader, False)
        self._rest = b""
        self._lines: deque[str] = deque(maxlen=LAST_LINES)
        self._closed = False
        loop.register(self._reader, self._readable)

    @property
    def stdio(self) -> tuple[int, int]:
        """Descriptors for the child's stdout and stderr."""
        return self._writer, self._writer

    def started(self) -> None:
        """Close the writing end: the child has its own now."""
        if self._writer >= 0:
            os.close(self._writer)
            self._writer = -1

    def finish(self) -> tuple[str, ...]:
        """Read the rest of a dead child's output; return its last lines."""
        if not self._closed:
            self._closed = True
            self._loop.unregister(self._reader)
            # No more than the pipe's size: a process that the child started may write for ever.
            left = fcntl.fcntl(self._reader, fcntl.F_GETPIPE_SZ)
            while left > 0 and (size := self._read()):
                left -= size
            self._pass_on(b"\n" if self._rest else b"")
            os.close(self._reader)
            self.started()
        return tuple(self._lines)

    def _readable(self) -> None:
        if self._busy():
            # The link is behind: let the child wait for room in the pipe, as at a slow terminal.
            self._loop.unregister(self._reader)
            self._loop.call_later(0.05, self._resume)
        else:
            self._read()

    def _resume(self) -> None:
        if not self._closed:
            self._loop.register(self._reader, self._readable)

    def _read(self) -> int:
        try:
            data = os.read(self._reader, _CHUNK)
        except BlockingIOError:
            return 0
        if data:
            self._pass_on(data)
        elif not self._closed:
            # All writers have closed the pipe, though the child may still run.
            self._loop.unregister(self._reader)
        return len(data)

    def _pass_on(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        while len(self._rest) > _LONGEST:
            lines.append(self._rest[:_LONGEST])
            self._rest = self._rest[_LONGEST:]
        if lines:
            texts = [line.decode(errors="replace").removesuffix("\r") for line in lines]
            self._lines.extend(texts)
            self._write("\n".join(texts))
