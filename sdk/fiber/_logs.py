"""Text on stderr: the logger ``fiber``, and the output of children on other hosts.

The logger is a child of multiprocessing's logger once that exists.
"""

from __future__ import annotations

import contextlib
import io
import os
import queue
import select
import sys
import threading
import time
from functools import partial
from multiprocessing import util
from typing import Any

from fiber._output_files import OutputFile, OutputKeeper, with_time

_mp: Any = util  # typeshed does not list its private names

USUAL = "WARNING"
"""Level at which Fiber sets up no handler."""


_loggers: list[Any] = []
"""The logger, once it was used.  ``getLogger`` takes logging's lock.  A Ctrl-C at the wrong moment
leaves that lock locked for ever, and then Fiber's threads must go on."""


def debug(message: str, *args: object) -> None:
    """Log an event.  Does nothing if ``logging`` is not imported."""
    if not _loggers:
        # Another thread may be importing the module at this moment.
        get_logger: Any = getattr(sys.modules.get("logging"), "getLogger", None)
        if get_logger is None:
            return
        _loggers.append(get_logger("fiber"))
    logger = _loggers[0]
    if _mp._logger is not None:
        logger.parent = _mp._logger  # from now on its level and handlers count
    try:
        logger.debug(message, *args)
    except Exception:  # an error of the user's handler must not end Fiber's threads
        import traceback

        with contextlib.suppress(Exception):
            traceback.print_exc()


def show(level: str) -> None:
    """Show records of ``level`` and above on stderr, in children too, as ``log_to_stderr`` does."""
    if level == USUAL:
        return
    if _mp._log_to_stderr:
        util.get_logger().setLevel(level)
    else:
        util.log_to_stderr(level)


_ROOM = 4 << 20
"""Characters that may wait for stderr.  Above that, lines are dropped until half of it is free."""


_ERASE = "\r\x1b[K"
"""Control characters that erase the last line of a terminal."""


write_around: Any = contextlib.nullcontext
"""Context manager around each write to stderr: a bar of the progress clears the line there."""


class OutputWriter:
    """Writer of lines to stderr, on a thread.  A slow, stuck or broken stderr blocks no caller.

    Lines for which there is no room are dropped.  A line in their place says how many.  With
    ``folder``, each child's lines go to a file there, too.  With ``times``, a child's line begins
    with the time at which it came.
    """

    def __init__(self, folder: str | None = None, times: bool = False) -> None:
        self._times = times
        self._keeper = (
            None if folder is None else OutputKeeper(folder, partial(self.write, "fiber"))
        )
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()
        self._waiting = 0
        """Characters that are in the queue or being written."""
        self._left_out = 0
        """Lines dropped since the last line that was accepted."""
        self._line = ""
        """Status line below the output; empty if there is none."""
        self._redraws = False
        """True if the thread must draw the status line again."""

    def write(self, who: str, text: str) -> None:
        """Queue lines of ``who``; return at once."""
        self._start()
        lines = "".join(f"[{who}] {line}\n" for line in text.split("\n"))
        with self._lock:
            if self._waiting > (_ROOM // 2 if self._left_out else _ROOM):
                self._left_out += lines.count("\n")
            else:
                self._say_what_is_left_out()
                self._put(lines)

    def write_child(
        self, name: str, host: str, text: str, file: OutputFile | None
    ) -> OutputFile | None:
        """Queue lines of a child, as ``write`` does; return its file, to be given the next time."""
        if self._times:
            text = with_time(text, time.time())
        self.write(f"{name}@{host}", text)
        if self._keeper is not None:
            file = file or self._keeper.file(name)
            self._keeper.write(file, text)
        return file

    def show(self, line: str) -> None:
        """Show ``line`` as the status line of the terminal; return at once.

        It replaces the earlier status line, and stays below the lines that are written.
        """
        self._start()
        with self._lock:
            self._line = line
            if not self._redraws:
                self._redraws = True
                self._lines.put("")

    def close(self) -> None:
        """Write the queued lines, and end the thread."""
        if self._keeper is not None:
            self._keeper.close()
        if self._line:
            self.show("")
        with self._lock:
            self._say_what_is_left_out()
        self._lines.put(None)
        if self._thread is None:
            self._run()
        else:
            self._thread.join(timeout=2)

    def _start(self) -> None:
        with self._lock:
            if self._thread is None:
                thread = threading.Thread(target=self._run, name="fiber-output", daemon=True)
                # The system may have no thread to give.  Then the next line starts it, or ``close``
                # writes the lines.
                with contextlib.suppress(RuntimeError):
                    thread.start()
                    self._thread = thread

    def _say_what_is_left_out(self) -> None:
        number, self._left_out = self._left_out, 0
        if number:
            self._put(
                f"[fiber] {number} lines are left out here: stderr took them more slowly than they "
                "came\n"
            )

    def _put(self, lines: str) -> None:
        self._waiting += len(lines)
        self._lines.put(lines)

    def _run(self) -> None:
        shown = ""
        while (lines := self._lines.get()) is not None:
            with self._lock:
                line, self._redraws = self._line, False
            # A full disk or a closed terminal costs only the lines.
            with contextlib.suppress(OSError, ValueError), write_around():
                _write(f"{_ERASE if shown else ''}{lines}{line}")
            shown = line
            with self._lock:
                self._waiting -= len(lines)
                if not self._waiting:
                    self._say_what_is_left_out()


def _write(text: str) -> None:
    stream = sys.stderr
    if not isinstance(stream, io.TextIOWrapper) or stream is not sys.__stderr__:
        stream.write(text)
        stream.flush()
        return
    # Not through the stream's buffer, in which half a line of another thread may be.
    descriptor = stream.fileno()
    data = text.encode(stream.encoding, stream.errors or "strict")
    while data:
        # A pipe keeps the bytes of one call together, up to this size.
        end = data.rfind(b"\n", 0, select.PIPE_BUF) + 1
        if not end:  # a longer line, or the last one
            end = data.find(b"\n") + 1 or len(data)
        data = data[os.write(descriptor, data[:end]) :]
