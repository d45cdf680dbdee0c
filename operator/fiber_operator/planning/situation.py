"""Situation in which problems are found, and their construction."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from fiber_api.status import MAX_COUNT
from fiber_api.v1alpha1 import FiberPool, Problem
from fiber_operator.planning.attachment import Attachment
from fiber_operator.planning.documents import past
from fiber_operator.planning.failures import Account
from fiber_operator.planning.plans import Memory
from fiber_operator.planning.pods import PodView

SECOND_LOOK = 30.0
"""Seconds after which what may pass by itself has not."""

Severity = Literal["Error", "Warning"]


@dataclass(frozen=True)
class Situation:
    """All that there may be to complain about."""

    pool: FiberPool
    live: Sequence[PodView]
    ended: Sequence[PodView]
    account: Account
    attachment: Attachment
    memory: Memory
    template_hash: str
    wants_more: bool
    """Pods are missing, whether or not they may be created now."""
    creates: bool
    """Pods, or a dry run of one, are asked for now."""
    deletes: bool
    """Something is to be deleted now."""
    now: float

    def previous(self, reason: str) -> Problem | None:
        """The problem of that kind that the status shows."""
        found = next((p for p in self.pool.status.problems if p.reason == reason), None)
        if found is None or past(found.since, self.now) is not None:
            return found
        return found.model_copy(update={"since": float(math.floor(self.now))})

    def severity(self, reason: str, *, again: bool = False) -> Severity:
        """Return the severity of a passing problem: at first a warning, an error ``again``."""
        before = self.previous(reason)
        lasted = before and before.since and self.now - before.since >= SECOND_LOOK
        was_error = before is not None and before.severity == "Error"
        return "Error" if again or lasted or was_error else "Warning"

    def example(self, reason: str, pods: Iterable[PodView]) -> PodView:
        """The pod to name: the one that was named before, else the oldest."""
        before = self.previous(reason)
        named = before.pod if before else None
        return min(pods, key=lambda pod: (pod.name != named, pod.created, pod.name))

    def problem(
        self,
        reason: str,
        message: str,
        *,
        severity: Severity = "Error",
        terminal: bool = False,
        count: int = 1,
        pod: str | None = None,
    ) -> Problem:
        """A problem, since when it is there."""
        before = self.previous(reason)
        since = before.since if before else None
        return Problem(
            reason=reason,
            severity=severity,
            terminal=terminal,
            count=min(count, MAX_COUNT),
            since=since or float(math.floor(self.now)),
            pod=pod,
            message=message,
        )
