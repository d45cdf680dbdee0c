"""Protection of an agent from the processes of its tasks, which run as the same user."""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import os
import signal
import sys
import sysconfig
import time

_PR_SET_DUMPABLE = 4

_DEPENDENCIES = ("cloudpickle", "cryptography", "pynng")
"""Packages that an agent may import late."""

_PAUSE = 0.01
"""Seconds between two checks of processes that end."""


def hide_this_process() -> bool:
    """Have the kernel hide memory and descriptors of this process from the user's other processes.

    Return whether the kernel does.  A seccomp profile may refuse it.
    """
    refused: int = ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
    return not refused


def keep_search_path() -> None:
    """Restrict ``sys.path`` to places that have modules of this process, Python's own first.

    A task may write a module to the working directory or to a folder of ``PYTHONPATH``.
    """
    main = sys.modules["__main__"]  # has a second name, for multiprocessing
    found = [importlib.util.find_spec(name) for name in _DEPENDENCIES]
    files = [spec.origin for spec in found if spec is not None]
    others = [module for module in list(sys.modules.values()) if module is not main]
    files += [getattr(module, "__file__", None) for module in others]
    places = list(dict.fromkeys(map(os.path.abspath, sys.path)))
    used = {_place_of(file, places) for file in files if file is not None}
    own = [sysconfig.get_path(kind) for kind in ("stdlib", "platstdlib", "purelib", "platlib")]
    own += [os.path.join(path, "lib-dynload") for path in own]
    sys.path[:] = sorted(filter(used.__contains__, places), key=lambda place: place not in own)


def _place_of(file: str, places: list[str]) -> str:
    """Return the innermost of the places that the file is in; empty if it is in none."""
    within = [place for place in places if file.startswith(place.rstrip(os.sep) + os.sep)]
    return max(within, key=len, default="")


def end(timeout: float) -> bool:
    """Kill all descendants; return whether none is left after ``timeout`` seconds.

    This process must be a subreaper, or process 1 of its container.  Then orphaned descendants
    become its children.
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
