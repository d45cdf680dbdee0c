"""Reachability of the program from pods that run.

Pure: ``now`` is an argument.
"""

from __future__ import annotations

import enum
import math

DOUBTED_AFTER = 8.0
"""Seconds from the first running pod until the missing agent is reported.  An agent needs a second
or two to start and to dial."""

GIVEN_UP_AFTER = 60.0
"""Seconds from that report to the error."""

_LATE = 2.0
"""Seconds by which a judgement may be late.  A longer delay means that this program was stopped or
held up, and that agents had to wait for it."""


class Verdict(enum.Enum):
    """Conclusion from running pods that send no agent."""

    OPEN = enum.auto()
    DOUBTFUL = enum.auto()
    UNREACHABLE = enum.auto()


class Reachability:
    """Record of the running pods of one pool, and of the first sign of an agent."""

    def __init__(self) -> None:
        self.due = math.inf
        """Time of the next judgement that can differ from the last."""
        self._proven = False
        self._running = 0
        self._since = math.inf
        self._newest = math.inf

    def prove(self) -> None:
        """Note that an agent has dialled: the address works."""
        self._proven = True
        self.due = math.inf

    def judge(self, running: int, now: float) -> Verdict:
        """Return the conclusion, with ``running`` pods there now."""
        late, self.due = now > self.due + _LATE, math.inf
        if not running or self._proven:
            self._running = 0
            return Verdict.OPEN
        if not self._running or late:
            self._since = now
        if running > self._running or late:
            self._newest = now  # as much time for this pod's agent as for the first
        self._running = running
        doubted_at = self._since + DOUBTED_AFTER
        given_up_at = max(doubted_at + GIVEN_UP_AFTER, self._newest + DOUBTED_AFTER)
        if now >= given_up_at:
            return Verdict.UNREACHABLE
        self.due = given_up_at if now >= doubted_at else doubted_at
        return Verdict.OPEN if now < doubted_at else Verdict.DOUBTFUL
