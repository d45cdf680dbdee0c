"""Start methods: the one in force for this program, and what the zygote imports for it.

A child starts with its parent's.
"""

from __future__ import annotations

import sys
from multiprocessing.process import current_process

from fiber._agent.child import UnguardedMainError

START_METHODS = ("forkserver", "spawn", "fork")
"""``forkserver`` and ``fork`` both fork from Fiber's zygote; the default comes first."""

chosen: str | None = None
"""Start method that ``set_start_method`` set, or that the first use settled."""

preload: list[str] = []
"""Modules that the zygote imports before it forks."""


def settle() -> str:
    """The start method in force; from now on it counts as set."""
    choose(chosen or START_METHODS[0])
    return chosen or START_METHODS[0]


def choose(method: str | None) -> None:
    """Set it, or forget what was set."""
    global chosen
    chosen = method


def inherit(method: str | None, modules: list[str]) -> None:
    """Take over the settings of the parent, in a child."""
    choose(method)
    preload[:] = modules


def zygote_method(method: str | None) -> str:
    """Return the action of the zygote for a start method; None is the one in force."""
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
