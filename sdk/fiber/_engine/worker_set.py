"""The workers of a pool: how many there are, how many are wanted, and when to start more.

Pure: ``now`` is an argument.
"""

from __future__ import annotations

from typing import Protocol

from fiber._engine.start_failures import StartFailure, StartFailures
from fiber._engine.tasks import WorkerEntry
from fiber.errors import FiberError

IDLE_DEATHS = 3
"""Deaths of idle workers, above the pool's maximum, after which they are replaced slowly."""

IDLE_PAUSE = 1.0
"""Seconds between slow replacements."""


class PoolMember(Protocol):
    """Process of a worker, from before its start until it is gone."""

    worker: WorkerEntry | None
    """Worker's entry in the ledger, once the worker is ready."""
    leaving: bool
    """True once the process was asked to end, or is about to be."""


class PoolWorkerSet:
    """Workers of a pool, ``minimum`` to ``maximum`` of them.

    ``members`` are the workers whose processes start or run.  ``size`` counts members that stay,
    ``starting`` those of them that are not ready.  ``trouble`` says why no worker starts, once
    that lasts.  If no worker is ready either, it is also the ``error``, and the pool gives up.
    """

    def __init__(self, minimum: int, maximum: int) -> None:
        self.minimum = minimum
        self.maximum = maximum
        self.members: dict[PoolMember, None] = {}
        self.size = 0
        self.starting = 0
        self.trouble: FiberError | None = None
        self.error: FiberError | None = None
        self._failures = StartFailures()
        self._alone_since = 0.0  # when the last ready worker was lost
        self._idle_deaths = 0

    @property
    def failures(self) -> int:
        """Number of failed starts since the last success."""
        return self._failures.count

    def staying(self) -> list[PoolMember]:
        """Return the members that were not asked to end."""
        return [member for member in self.members if not member.leaving]

    def wanted(self, demand: int) -> int:
        """Return how many workers there should be for so many tasks."""
        return min(max(demand, self.minimum), self.maximum)

    def missing(self, demand: int, newcomers: int) -> int:
        """Return how many workers to start for so many tasks.

        Only new workers may run ``newcomers`` of the tasks.
        """
        missing = self.wanted(demand) - self.size
        return max(missing, min(newcomers - self.starting, self.maximum - self.size), 0)

    def startable(self, missing: int, now: float) -> int:
        """Return how many to start now; after failures it is one, once the pause is over."""
        if not self._failures.pause:
            return missing
        return min(missing, 1) if now >= self._try_at() and not self._trying() else 0

    def next_try(self) -> float | None:
        """Return when the pause after failures ends; None without one, or during a try."""
        return self._try_at() if self._failures.pause and not self._trying() else None

    def _trying(self) -> bool:
        """Return whether a worker starts as a try after failures."""
        return bool(self.failures and self.starting)

    def _at_work(self) -> bool:
        return self.size > self.starting

    def _try_at(self) -> float:
        return self._failures.try_at(at_work=self._at_work())

    # Events

    def add(self, member: PoolMember) -> None:
        """Add a worker that is about to be started."""
        self.members[member] = None
        self.size += 1
        self.starting += 1

    def ready(self, member: PoolMember, worker: WorkerEntry) -> None:
        """Note that a worker is ready."""
        member.worker = worker
        self.starting -= 1
        self._failures.forget()
        self.trouble = None
        if self._idle_deaths <= IDLE_DEATHS + self.maximum:
            self._failures.pause = 0.0

    def did_something(self) -> None:
        """Note that a worker sent a result."""
        if self._idle_deaths:
            self._idle_deaths = 0
            if not self.failures:
                self._failures.pause = 0.0

    def give_up(self, error: FiberError) -> None:
        """Note that no more workers can start, because of ``error``."""
        self.error = error

    def let_go(self, member: PoolMember) -> None:
        """Count a worker as leaving; the caller asks it to end, or kills it."""
        self._uncount(member)
        member.leaving = True

    def gone(self, member: PoolMember, now: float, failure: StartFailure | None) -> None:
        """Remove a worker whose process is gone, or could not be started.

        ``failure`` says why, if the worker was not ready.  None: the worker is not to blame, as
        when its host is lost.
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
        """Return a text for the user, once for each series of failures that lasts; else empty."""
        if self.error or not self._failures.are_news(now):
            return ""
        return (
            f"no worker has started for {self._failures.lasted(now):.0f} s, {self.failures} tries: "
            f"{failure.who} ended before it was ready ({failure.reason}). Trying again"
        )

    def _uncount(self, member: PoolMember) -> None:
        if not member.leaving:
            self.size -= 1
            self.starting -= member.worker is None
