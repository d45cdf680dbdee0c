"""Ctrl-C at a chosen step of some code."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any


def is_interrupted(action: Callable[[], object], stop: int, files: set[str]) -> bool:
    """Do it, with a KeyboardInterrupt at step ``stop`` of the code in ``files``; False: too short.

    A step is a line, or a return.  The locks of ``threading`` count as in all of them.
    """
    step = -1

    def trace(frame: FrameType, event: str, _arg: Any) -> Any:
        nonlocal step
        if frame.f_code.co_filename not in files and frame.f_globals is not vars(threading):
            return None
        if event in ("line", "return"):
            step += 1
            if step == stop:
                raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        action()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(before)
    return False
