"""Time limit for the calls of an environment."""

from __future__ import annotations

import signal
from multiprocessing import TimeoutError as TookTooLong
from types import FrameType


class TimeLimit:
    """Context that raises ``multiprocessing.TimeoutError`` in a block that takes too long.

    It uses an alarm (SIGALRM).  So it works only in a main thread, and only while Python code runs
    or a system call waits: it does not end native code that never returns.  The alarm is repeated,
    since the block may have caught the error.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._inside = False
        signal.signal(signal.SIGALRM, self._ring)

    def __enter__(self) -> None:
        self._inside = True
        signal.setitimer(signal.ITIMER_REAL, self._seconds, self._seconds)

    def __exit__(self, *_: object) -> None:
        self._inside = False  # first: an alarm may strike yet
        signal.setitimer(signal.ITIMER_REAL, 0)

    def _ring(self, _signal: int, _frame: FrameType | None) -> None:
        if self._inside:
            raise TookTooLong(f"it took longer than {self._seconds:g} s (timeout)")
