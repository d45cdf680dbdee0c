"""How many workers a pool has and should have, and whether it is any use to start more.

Pure: ``now`` is an argument.
"""

from __future__ import annotations

from typing import Protocol

from fiber._engine.start_failures import StartFailure, StartFailures
from fiber._engine.tasks import Worker
from fiber.errors import FiberError

IDLE_DEATHS = 3
"""Workers more than the pool's maximum that may die with nothing to do before they are replaced
slowly."""

IDLE_PAUSE = 1.0
"""Seconds before one is replaced then."""


class Member(Protocol):
    """A worker's process, from before it is started until it is gone."""

    worker: Worker | None
    """Its entry in the ledger, once it is ready."""
    leaving: bool
    """It was told to go, or will be at once."""


class WorkerSet:
    """The workers of a pool, ``minimum`` to ``maximum`` of them.

    ``members`` are those whose processes are being started or run, ``size`` counts those that are
    to stay, ``starting`` those of them that are not ready.  ``trouble`` says why none starts, once
    that lasts; with nobody at work it is also the ``error``, and there is no point in going on.
    """

    def __init__(self, minimum: int, maximum: int) -> None:
        self.minimum = minimum
        self.maximum = maximum
        self.members: dict[Member, None] = {}
        self.size = 0
        self.starting = 0
        self.trouble: FiberError | None = None
        self.error: FiberError | None = None
        self._failures = StartFailures()
        self._alone_since = 0.0  # when the last one at work was lost
        self._idle_deaths = 0

    @property
    def failures(self) -> int:
        """How many have failed to start since the last that did."""
        return self._failures.count

    def staying(self) -> list[Member]:
        """Those that were not told to go."""
        return [member for member in self.members if not member.leaving]

    def wanted(self, demand: int) -> int:
        """How many workers there should be for so many tasks."""
        return min(max(demand, self.minimum), self.maximum)

    def missing(self, demand: int, newcomers: int) -> int:
        """Workers to start for so many tasks, ``newcomers`` of which only new workers may run."""
        missing = self.wanted(demand) - self.size
        return max(missing, min(newcomers - self.starting, self.maximum - self.size), 0)

    def startable(self, missing: int, now: float) -> int:
        """How many of them to start now: after failures one, and only once the pause is over."""
        if not self._failures.pause:
            return missing
        return min(missing, 1) if now >= self._try_at() and not self._trying() else 0

    def next_try(self) -> float | None:
        """When the pause after failures is over; None while one is tried, or there is none."""
        return self._try_at() if self._failures.pause and not self._trying() else None

    def _trying(self) -> bool:
        """Whether one that is to show that workers can start again is under way."""
        return bool(self.failures and self.starting)

    def _at_work(self) -> bool:
        return self.size > self.starting

    def _try_at(self) -> float:
        return self._failures.try_at(at_work=self._at_work())

    # What happens to them

    def add(self, member: Member) -> None:
        """It is about to be started."""
        self.members[member] = None
        self.size += 1
        self.starting += 1

    def ready(self, member: Member, worker: Worker) -> None:
        """It is ready to work."""
        member.worker = worker
        self.starting -= 1
        self._failures.forget()
        self.trouble = None
        if self._idle_deaths <= IDLE_DEATHS + self.maximum:
            self._failures.pause = 0.0

    def did_something(self) -> None:
        """Some worker had a result."""
        if self._idle_deaths:
            self._idle_deaths = 0
            if not self.failures:
                self._failures.pause = 0.0

    def let_go(self, member: Member) -> None:
        """It is not to stay; the caller sees to it that it hears of that, or dies."""
        self._uncount(member)
        member.leaving = True

    def gone(self, member: Member, now: float, failure: StartFailure | None) -> None:
        """Its process is gone, or was never there.

        ``failure`` says why, if it was not ready; None if it could not help it, as when its host
        is lost.
        """
        if member not in self.members:
            return
        del self.members[member]
        self._uncount(member)
        if member.worker is not None and not self._at_work():
            self._alone_since = now
        if member.leaving:
            return
        if member.worker is not None:
            if not member.worker.queue:
                self._died_idle(now)
        elif failure is not None:
            self._failed(failure, now)

    def _died_idle(self, now: float) -> None:
        self._idle_deaths += 1
        if self._idle_deaths > IDLE_DEATHS + self.maximum:
            self._failures.hold(IDLE_PAUSE, now)

    def _failed(self, failure: StartFailure, now: float) -> None:
        self._failures.add(failure, now, at_work=self._at_work())
        if self._failures.last(failure, now):
            self.trouble = failure.error(self.failures)
            if not self._at_work() and self._failures.last(failure, now, self._alone_since):
                self.error = self.trouble

    def news(self, failure: StartFailure, now: float) -> str:
        """What to tell a person who waits, once when failures last; else nothing."""
        if self.error or not self._failures.are_news(now):
            return ""
        return (
            f"no worker has started for {self._failures.lasted(now):.0f} s, {self.failures} tries: "
            f"{failure.who} ended before it was ready ({failure.reason}). Trying again"
        )

    def _uncount(self, member: Member) -> None:
        if not member.leaving:
            self.size -= 1
            self.starting -= member.worker is None
