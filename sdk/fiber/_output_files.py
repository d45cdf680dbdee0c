"""Files with the output of children, one for each child, in the folder ``log_to``.

A file is opened for each write and closed after it.  So a thousand workers need no descriptors,
and a program that closes or reuses descriptors harms no file.
"""

from __future__ import annotations

import contextlib
import os
import queue
import re
import sys
import threading
import time
import warnings
from collections.abc import Callable

_MOST_OF_ONE_NAME = 1000
"""Files of children with the same name."""

_LONGEST_NAME = 80

_ROOM = 4 << 20
"""Characters that may wait for the disk.  Above that, lines are dropped."""


def program_name() -> str:
    """Return the name of this program: that of its script or module, and its pid."""
    main = sys.modules.get("__main__")
    spec = getattr(main, "__spec__", None)
    path = getattr(main, "__file__", None)
    name = spec.name.removesuffix(".__main__") if spec else os.path.basename(path or "python")
    stem = re.sub("[^a-z0-9]+", "-", name.removesuffix(".py").lower()).strip("-")
    return f"{stem[:40] or 'python'}-{os.getpid()}"


def stem_of(program: str, child: str) -> str:
    """Return the name of a child's file without its suffix; no name leads out of the folder."""
    return f"{program}.{re.sub('[^A-Za-z0-9_-]+', '_', child)[:_LONGEST_NAME]}"


def usable(folder: str | None) -> str | None:
    """Make the folder, and return it; warn and return None if no file can be made in it."""
    if folder is None:
        return None
    import tempfile  # rarely needed

    try:
        os.makedirs(folder, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        warnings.warn(
            f"the output of children is not kept in {folder!r}: {error.strerror or error}. Set "
            "log_to to a folder that can be written to, or leave it out.",
            RuntimeWarning,
            stacklevel=2,
        )
        return None


def with_time(text: str, now: float) -> str:
    """Return lines with the local time before each, to the millisecond: ``now`` in unix time."""
    seconds, milliseconds = divmod(int(now * 1000), 1000)
    stamp = time.strftime(f"%Y-%m-%d %H:%M:%S.{milliseconds:03}", time.localtime(seconds))
    lines, end = text.removesuffix("\n"), "\n" if text.endswith("\n") else ""
    return "\n".join(f"{stamp} {line}" for line in lines.split("\n")) + end


class OutputFile:
    """File for the output of one child.  The first write makes it."""

    def __init__(self, folder: str, program: str, child: str) -> None:
        self._start = os.path.join(folder, stem_of(program, child))
        self._path = ""
        self._lock = threading.RLock()  # a signal handler may print meanwhile
        self.left_out = 0
        """Lines that were dropped since the last write."""

    def append(self, data: bytes) -> None:
        """Append whole lines; OSError if that is not possible."""
        with self._lock:
            descriptor = self._open()
        try:
            while data:
                data = data[os.write(descriptor, data) :]
        finally:
            os.close(descriptor)

    def _open(self) -> int:
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
        if self._path:
            return os.open(self._path, flags, 0o666)
        for number in range(1, _MOST_OF_ONE_NAME):
            path = f"{self._start}{f'.{number}' if number > 1 else ''}.log"
            with contextlib.suppress(FileExistsError):
                descriptor = os.open(path, flags | os.O_EXCL, 0o666)
                self._path = path
                return descriptor
        raise FileExistsError(f"there are {_MOST_OF_ONE_NAME} files {self._start}.*.log")


class OutputKeeper:
    """Writer of the files of children on other hosts, on a thread.  A slow disk blocks no caller.

    ``complain`` gets the first error.
    """

    def __init__(self, folder: str, complain: Callable[[str], None]) -> None:
        self._folder = folder
        self._program = program_name()
        self._complain: Callable[[str], None] | None = complain
        self._queue: queue.SimpleQueue[tuple[OutputFile, str] | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._waiting = 0
        self._thread: threading.Thread | None = None

    def file(self, child: str) -> OutputFile:
        """Return the file for a child."""
        return OutputFile(self._folder, self._program, child)

    def write(self, file: OutputFile, text: str) -> None:
        """Queue lines for a file; return at once."""
        with self._lock:
            if self._waiting > _ROOM:
                file.left_out += text.count("\n") + 1
                return
            self._waiting += len(text)
            left_out, file.left_out = file.left_out, 0
            if left_out:
                text = f"[fiber] {left_out} lines are left out here: the disk was too slow\n{text}"
            self._queue.put((file, text))
            if self._thread is None:
                thread = threading.Thread(target=self._run, name="fiber-output-files", daemon=True)
                with contextlib.suppress(RuntimeError):  # the next line tries again
                    thread.start()
                    self._thread = thread

    def close(self) -> None:
        """Write the queued lines, and end the thread."""
        self._queue.put(None)
        if self._thread is None:
            self._run()
        else:
            self._thread.join(timeout=2)

    def _run(self) -> None:
        while (entry := self._queue.get()) is not None:
            file, text = entry
            try:
                file.append(f"{text}\n".encode(errors="replace"))
            except OSError as error:  # a full disk costs only the lines
                self._fail(error)
            with self._lock:
                self._waiting -= len(text)

    def _fail(self, error: OSError) -> None:
        complain, self._complain = self._complain, None
        if complain is not None:
            complain(
                f"output of children is lost, which {self._folder!r} should keep: "
                f"{error.strerror or error}. The work goes on."
            )
