"""Start method of this program, and the zygote's start before the rest of Fiber is imported.

A child begins with the start method and the preloaded modules of its parent.
"""

from __future__ import annotations

import contextlib
import resource
import sys
from multiprocessing.process import current_process

from fiber._agent.child import UnguardedMainError

START_METHODS = ("forkserver", "spawn", "fork")
"""Start methods, the default first.  ``forkserver`` and ``fork`` both fork from the zygote."""

chosen: str | None = None
"""Start method that ``set_start_method`` set, or that the first use settled."""

_FEW_DESCRIPTORS = 64
"""Limit of open files below which the zygote is not started early: the step that needs it first
reports what is missing."""

_LOCAL = ("local", "auto")
"""Backends whose children are this process's own, or may be."""

preload: list[str] = []
"""Modules that the zygote imports before it forks."""


def settle() -> str:
    """Return the start method in force.  From now on it counts as set."""
    choose(chosen or START_METHODS[0])
    return chosen or START_METHODS[0]


def choose(method: str | None) -> None:
    """Set the start method; None makes it unset again."""
    global chosen
    chosen = method


def inherit(method: str | None, modules: list[str]) -> None:
    """Take over the settings of the parent, in a child."""
    choose(method)
    preload[:] = modules


def zygote_method(method: str | None) -> str:
    """Return what the zygote does for a start method; None stands for the one in force."""
    return "spawn" if (method or settle()) == "spawn" else "fork"


def check_main() -> None:
    """Raise UnguardedMainError if this process is still importing its parent's main module."""
    if not getattr(current_process(), "_inheriting", False):
        return
    frame = sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__") != "__mp_main__":
        frame = frame.f_back
    raise UnguardedMainError(
        f"{frame.f_code.co_filename}, line {frame.f_lineno}, starts a process each time it is "
        "imported. A new process imports the main module first, so processes would start without "
        'end. Put the lines that start processes under: if __name__ == "__main__":'
    )


def start_zygote() -> None:
    """Have the zygote start and import while this process does."""
    from fiber import config  # not for children, which only inherit the start method
    from fiber._agent import zygote_process

    if "fiber._runtime.state" in sys.modules or config.current().backend not in _LOCAL:
        return
    if resource.getrlimit(resource.RLIMIT_NOFILE)[0] < _FEW_DESCRIPTORS:
        return
    with contextlib.suppress(OSError):  # the first child tries again and reports the error
        zygote_process.start_early()
