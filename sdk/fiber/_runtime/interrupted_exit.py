"""End of a process by an uncaught Ctrl-C.  Its children get SIGINT, as in multiprocessing.

A terminal sends SIGINT to the program only, because children have their own process group.
"""

from __future__ import annotations

import os
import sys
from multiprocessing import util
from multiprocessing.process import BaseProcess, active_children
from typing import Any

from fiber import _logs
from fiber._runtime.popen import Popen
from fiber._runtime.state import runtime

_PATIENCE = 2.0
"""Seconds that children get to end before the user learns that the program waits for them."""

_PRIORITY = 1000  # before pools and managers end: children may still use them

_prepared: int | None = None
"""Pid of the process in which ``prepare`` has done its work."""


def prepare() -> None:
    """Register the exit function, once in each process that starts others."""
    global _prepared
    if _prepared != os.getpid():
        util.Finalize(None, _interrupt_children, exitpriority=_PRIORITY)
        _prepared = os.getpid()


def _interrupt_children() -> None:
    """Send SIGINT to the children if KeyboardInterrupt ends this process.

    multiprocessing's exit function waits for the children afterwards.
    """
    if not _ends_by_interrupt():
        return
    waited_for = [child for child in active_children() if not child.daemon]
    children = [(child, popen) for child in waited_for if (popen := _popen_of(child))]
    if not children:
        return
    _end_quietly_when_interrupted_again()
    for _, popen in children:
        popen.interrupt()
    runtime().loop.call_later(_PATIENCE, _name_running, children)


def _ends_by_interrupt() -> bool:
    # Up to Python 3.12, a child runs its exit functions while it handles the exception.  In a
    # program the interpreter has noted it.  A prompt notes the errors of its commands there, too.
    error = sys.exc_info()[1]
    if error is None and not hasattr(sys, "ps1"):
        error = getattr(sys, "last_value", None)
    return isinstance(error, KeyboardInterrupt)


def _popen_of(child: BaseProcess) -> Popen | None:
    """Return the ``Popen`` of a process of Fiber; None for one of multiprocessing."""
    popen = child._popen  # type: ignore[attr-defined]
    return popen if isinstance(popen, Popen) else None


def _end_quietly_when_interrupted_again() -> None:
    """Have the interpreter print no traceback if Ctrl-C ends the wait for the children."""
    report = sys.unraisablehook

    def report_others(unraisable: Any) -> None:
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            report(unraisable)

    sys.unraisablehook = report_others


def _name_running(children: list[tuple[BaseProcess, Popen]]) -> None:
    """Write which children still run."""
    names = [child.name for child, popen in children if popen.returncode is None]
    if names:
        _logs.OutputWriter().write(
            "fiber",
            f"the program waits for processes that go on after Ctrl-C: {', '.join(names)}. "
            "Another Ctrl-C ends the program and its processes at once",
        )
