"""How long an environment may take."""

from __future__ import annotations

import signal
from multiprocessing import TimeoutError as TookTooLong
from types import FrameType


class TimeLimit:
    """Raises ``multiprocessing.TimeoutError`` in what is done inside it, if that takes too long.

    By an alarm (SIGALRM), so only in a main thread, and only where Python code runs or a system
    call waits: native code that does not return is left to others to end.  The alarm is repeated,
    since what it raised may have been caught.
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
