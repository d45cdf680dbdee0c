"""How many workers a pool has and should have, and whether it is any use to start more.

Pure: ``now`` is an argument.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from fiber._engine.tasks import Worker
from fiber.errors import FiberError, StartError

RAISED_PATIENCE = 1.0
"""Seconds for which workers may fail to start by their own doing, as by an initializer that raises,
before that is the answer."""

KILLED_PATIENCE = 10.0
"""The same for those that are killed, or refused by the system: spot nodes and OOM killers come in
waves, and go."""

TRIES = 3
"""Workers that must have failed, however long it took."""

FIRST_PAUSE, LAST_PAUSE = 0.05, 1.0
"""Seconds from one wave of failures to the next try, doubled from wave to wave."""

LAST_PAUSE_AT_WORK = 60.0
"""The same, at most, while other workers are at work."""

IDLE_DEATHS = 3
"""Workers more than the pool's maximum that may die with nothing to do before they are replaced
slowly."""

IDLE_PAUSE = 1.0
"""Seconds before one is replaced then."""

SAID_AFTER = 2.0
"""Seconds of failures after which whoever waits is told."""


class Member(Protocol):
    """A worker's process, from before it is started until it is gone."""

    worker: Worker | None
    """Its entry in the ledger, once it is ready."""
    leaving: bool
    """It was told to go, or will be at once."""


class StartFailure(NamedTuple):
    """Why a worker was gone before it was ready."""

    who: str
    reason: str
    text: str = ""
    """What it said."""
    killed: bool = False
    """By a signal, or the system had no room for it: it may have done nothing wrong."""
    cause: BaseException | None = None
    final: FiberError | None = None
    """What keeps every worker from starting: another try is of no use."""

    def error(self, attempts: int) -> FiberError:
        """What the pool's user hears."""
        if self.final is not None:
            return self.final
        error = StartError(self.who, self.reason, self.text, attempts)
        error.__cause__ = self.cause
        return error


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
        self.failures = 0
        self.trouble: FiberError | None = None
        self.error: FiberError | None = None
        self._failing_since = 0.0
        self._raises = 0  # those of the failures that were the workers' own doing
        self._raising_since = 0.0
        self._alone_since = 0.0  # when the last one at work was lost
        self._said = False
        self._pause = 0.0
        self._wave_at = 0.0
        self._idle_deaths = 0

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
        if not self._pause:
            return missing
        return min(missing, 1) if now >= self._try_at() and not self._trying() else 0

    def next_try(self) -> float | None:
        """When the pause after failures is over; None while one is tried, or there is none."""
        return self._try_at() if self._pause and not self._trying() else None

    def _trying(self) -> bool:
        """Whether one that is to show that workers can start again is under way."""
        return bool(self.failures and self.starting)

    def _at_work(self) -> bool:
        return self.size > self.starting

    def _try_at(self) -> float:
        last = LAST_PAUSE_AT_WORK if self._at_work() else LAST_PAUSE
        return self._wave_at + min(self._pause, last)

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
        self.failures = 0
        self._said = False
        self.trouble = None
        if self._idle_deaths <= IDLE_DEATHS + self.maximum:
            self._pause = 0.0

    def did_something(self) -> None:
        """Some worker had a result."""
        if self._idle_deaths:
            self._idle_deaths = 0
            if not self.failures:
                self._pause = 0.0

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
            self._pause = IDLE_PAUSE
            self._wave_at = now

    def _failed(self, failure: StartFailure, now: float) -> None:
        if not self.failures:
            self._failing_since = now
            self._raises = 0
        self.failures += 1
        if not failure.killed:
            self._raising_since = self._raising_since if self._raises else now
            self._raises += 1
        if not self._pause or now >= self._try_at():  # else it is of the same wave
            self._pause = min(max(2 * self._pause, FIRST_PAUSE), LAST_PAUSE_AT_WORK)
            self._wave_at = now
        if failure.final is not None:
            tries, since, patience = TRIES, now, 0.0
        elif failure.killed:
            tries, since, patience = self.failures, self._failing_since, KILLED_PATIENCE
        else:
            tries, since, patience = self._raises, self._raising_since, RAISED_PATIENCE
        if tries >= TRIES and now - since >= patience:
            self.trouble = failure.error(self.failures)
            if not self._at_work() and now - max(since, self._alone_since) >= patience:
                self.error = self.trouble

    def news(self, failure: StartFailure, now: float) -> str:
        """What to tell a person who waits, once when failures last; else nothing."""
        lasts = now - self._failing_since
        if self.error or self._said or not self.failures or lasts < SAID_AFTER:
            return ""
        self._said = True
        return (
            f"no worker has started for {lasts:.0f} s, {self.failures} tries: {failure.who} "
            f"ended before it was ready ({failure.reason}). Trying again"
        )

    def _uncount(self, member: Member) -> None:
        if not member.leaving:
            self.size -= 1
            self.starting -= member.worker is None
