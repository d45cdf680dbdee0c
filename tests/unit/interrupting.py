"""Ctrl-C at a chosen step of some code."""

from __future__ import annotations

import gc
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

LINES = ("line", "return")
INSTRUCTIONS = ("opcode",)
CALLS = ("call", "c_return")
"""Steps at which CPython runs signal handlers: a function begins, or a C function has returned."""


def ctrl_c() -> None:
    """Do what Python does at Ctrl-C."""
    raise KeyboardInterrupt


def is_interrupted(
    action: Callable[[], object],
    stop: int,
    files: set[str] | None = None,
    *,
    steps: tuple[str, ...] = LINES,
    by: Callable[[], object] = ctrl_c,
) -> bool:
    """Do it, and call ``by`` at step ``stop`` of the code in ``files``; False: too short.

    None stands for all files.  Where steps are lines, the locks of ``threading`` count as in any.
    """
    step = -1

    def counts(frame: FrameType) -> bool:
        if files is None or frame.f_code.co_filename in files:
            return True
        return steps == LINES and frame.f_globals is vars(threading)

    def trace(frame: FrameType, event: str, _arg: Any) -> Any:
        nonlocal step
        if not counts(frame):
            return None
        frame.f_trace_opcodes = steps == INSTRUCTIONS
        if event in steps:
            step += 1
            if step == stop:
                by()
        return trace

    before, collects = sys.gettrace(), gc.isenabled()
    gc.disable()  # a finalizer of other tests' garbage would be struck, and shown
    if steps == CALLS:
        sys.setprofile(trace)
    else:
        sys.settrace(trace)
    try:
        action()
    except KeyboardInterrupt:
        pass
    finally:
        sys.setprofile(None)
        sys.settrace(before)
        if collects:
            gc.enable()
    return step >= stop
