"""Decisions after failed starts of workers or agents: when to try again, when to give up.

Pure: ``now`` is an argument.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fiber.errors import FiberError, StartError

RAISED_PATIENCE = 1.0
"""Seconds for which the processes' errors, such as an initializer that raises, may prevent starts
before the failure is final."""

KILLED_PATIENCE = 10.0
"""Seconds for which starting processes may be killed, or refused by the system, before the failure
is final.  Losses of spot nodes and OOM kills come in waves and pass."""

TRIES = 3
"""Number of starts that must have failed before the failure is final, however long that takes."""

FIRST_PAUSE, LAST_PAUSE = 0.05, 1.0
"""Seconds from one wave of failures to the next try, doubled from wave to wave."""

LAST_PAUSE_AT_WORK = 60.0
"""Longest pause, in seconds, while other processes are at work."""

SAID_AFTER = 2.0
"""Seconds of failures after which the user gets a message."""


class StartFailure(NamedTuple):
    """Reason why a process was gone before it was ready."""

    who: str
    reason: str
    text: str = ""
    """Message of the process."""
    killed: bool = False
    """True if a signal ended it, or the system had no room for it: it may not be at fault."""
    cause: BaseException | None = None
    final: FiberError | None = None
    """Error that no process will start without a remedy: another try is of no use."""
    advice: str = ""
    """Note of the error that says what to do, if that is known."""

    def error(self, attempts: int) -> FiberError:
        """Return the error that the user gets."""
        if self.final is not None:
            return self.final
        error = StartError(self.who, self.reason, self.text, attempts)
        error.__cause__ = self.cause
        if self.advice:
            error.add_note(self.advice)
        return error


class StartFailures:
    """Starts that failed in a row, counted in time and in waves.

    ``pause`` is above 0 while one start has to succeed before others follow.
    """

    def __init__(self) -> None:
        self.count = 0
        self.pause = 0.0
        self._since = 0.0
        self._raises = 0  # failures by errors of the processes
        self._raising_since = 0.0
        self._wave_at = 0.0
        self._said = False

    def add(self, failure: StartFailure, now: float, *, at_work: bool) -> None:
        """Count one more failure; ``at_work`` says whether other processes work."""
        if not self.count:
            self._since = now
            self._raises = 0
        self.count += 1
        if not failure.killed:
            self._raising_since = self._raising_since if self._raises else now
            self._raises += 1
        if not self.pause or now >= self.try_at(at_work=at_work):  # else it is in this wave
            self.hold(min(max(2 * self.pause, FIRST_PAUSE), LAST_PAUSE_AT_WORK), now)

    def hold(self, pause: float, now: float) -> None:
        """Start no process for ``pause`` seconds."""
        self.pause = pause
        self._wave_at = now

    def try_at(self, *, at_work: bool) -> float:
        """Return when the pause is over."""
        last = LAST_PAUSE_AT_WORK if at_work else LAST_PAUSE
        return self._wave_at + min(self.pause, last)

    def forget(self) -> None:
        """End the series, since a process has started.  The caller ends the pause."""
        self.count = 0
        self._said = False

    def last(self, failure: StartFailure, now: float, begin: float = -math.inf) -> bool:
        """Return whether failures, counted from ``begin``, have now lasted too long."""
        if failure.final is not None:
            tries, since, patience = TRIES, now, 0.0
        elif failure.killed:
            tries, since, patience = self.count, self._since, KILLED_PATIENCE
        else:
            tries, since, patience = self._raises, self._raising_since, RAISED_PATIENCE
        return tries >= TRIES and now - max(since, begin) >= patience

    def are_news(self, now: float) -> bool:
        """Return True once for each series of failures that lasts."""
        if self._said or not self.count or self.lasted(now) < SAID_AFTER:
            return False
        self._said = True
        return True

    def lasted(self, now: float) -> float:
        """Return the seconds since the first failure of the series."""
        return now - self._since
