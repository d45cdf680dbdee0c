"""Health of the operator, for /healthz and /readyz.

Not alive means that a restart may help: something in this process is stuck.  Not ready means that
pools are not served as they should be, whoever is to blame; a restart would change nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from fiber_operator.leader_election import LeaderElector
from fiber_operator.resync import Resync
from fiber_operator.watches import Watches
from fiber_operator.workqueue import Queue

LATE_TURN = 30.0
"""Seconds that a pool may wait for its reconcile while the operator is ready."""
STUCK_TURN = 600.0
"""Longer than any reconcile takes whose every call ends by its timeout."""
STUCK_QUEUE = 120.0
"""Seconds without the end of any reconcile while a pool waits."""
MISSED_RESYNCS = 2.5


@dataclass
class Health:
    """Both checks.  Each returns what is wrong, a sentence each."""

    elector: LeaderElector
    queue: Queue
    resync: Resync
    watches: Watches
    clock: Callable[[], float]

    def __post_init__(self) -> None:
        self._began = self.clock()

    def alive(self) -> list[str]:
        """Why this process should be restarted."""
        now, statistics = self.clock(), self.queue.statistics()
        wrong = []
        if statistics.longest_run > STUCK_TURN:
            wrong.append(f"the reconcile of a pool takes {statistics.longest_run:.0f} s so far")
        if min(statistics.longest_wait, statistics.since_last_end) > STUCK_QUEUE:
            wrong.append(
                f"no reconcile has ended for {statistics.since_last_end:.0f} s, and pools wait"
            )
        tried = now - (self._began if self.resync.tried is None else self.resync.tried)
        # One list takes as long as its timeout where the API server is silent.
        if tried > 2 * self.resync.seconds + 120:
            wrong.append(f"the pools were not even tried to be listed for {tried:.0f} s")
        return wrong

    def ready(self) -> list[str]:
        """Why pools are not served as they should be."""
        now, statistics = self.clock(), self.queue.statistics()
        wrong = list(self.resync.failures.values())
        if not self.elector.is_leader:
            wrong.append(f"this operator does not act: {self.elector.why}")
        if self.resync.succeeded is None:
            wrong.append("the pools were not listed yet")
        elif now - self.resync.succeeded > MISSED_RESYNCS * self.resync.seconds:
            wrong.append(f"the pools were last listed {now - self.resync.succeeded:.0f} s ago")
        wrong += self.watches.wrong()
        if statistics.longest_wait > LATE_TURN:
            wrong.append(f"a pool waits for its reconcile for {statistics.longest_wait:.0f} s")
        return wrong
