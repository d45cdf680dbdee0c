"""Protection of an agent from the processes of its tasks, which run as the same user."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import time

_PR_SET_DUMPABLE = 4

_PAUSE = 0.01
"""Seconds between two looks at processes that end."""


def hide_this_process() -> bool:
    """Have the kernel keep others of this user from memory and descriptors of this process.

    Return whether the kernel does.  A seccomp profile may refuse it.
    """
    refused: int = ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
    return not refused


def end(timeout: float) -> bool:
    """Kill all descendants; return whether none is left after ``timeout`` seconds.

    This process must be a subreaper, or the first one of its container: a process whose parent ends
    becomes its child then, however it was started.
    """
    deadline = time.monotonic() + timeout
    while True:
        for pid in _descendants():
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        if not _reap():
            return True
        if time.monotonic() > deadline:
            return False
        time.sleep(_PAUSE)


def _reap() -> bool:
    """Collect children that have ended; return whether there are others."""
    try:
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
    except ChildProcessError:
        return False
    return True


def _descendants() -> list[int]:
    parents = {}
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            with contextlib.suppress(OSError), open(f"/proc/{entry}/stat", "rb") as file:
                parents[int(entry)] = int(file.read().rpartition(b")")[2].split()[1])
    found = [os.getpid()]
    for pid in found:
        found += [child for child, parent in parents.items() if parent == pid]
    return found[1:]
