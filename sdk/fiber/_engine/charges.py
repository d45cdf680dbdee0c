"""How often the tasks of one job may be lost with their workers, and how often each was.

A task that is lost runs again.  Two counts bound that, since they have different causes:

* **Deaths.**  The task may have killed its worker.  It runs again at most ``retries`` times.
* **Disruptions.**  The cluster ended the worker: a drain, an eviction, a preemption, a lost node.
  The task is not to blame, so this uses up no retry.  ``disruptions`` bounds it all the same:
  a task that is longer than any worker lives would run again without end.

Pure.
"""

from __future__ import annotations

from typing import NamedTuple


class Limits(NamedTuple):
    """How often one task may run again, by what ended its worker."""

    retries: int = 3
    disruptions: int = 20


class Counts(NamedTuple):
    """How often one task was lost."""

    deaths: int
    disruptions: int


class Charges:
    """What the tasks of one job, known by their indices, are charged with."""

    __slots__ = ("deaths", "disruptions", "limits")

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.deaths: dict[int, int] = {}
        self.disruptions: dict[int, int] = {}

    def charge(self, task: int, *, disrupted: bool = False) -> bool:
        """Count one more run that came to nothing; False if that was the last one allowed."""
        counts = self.disruptions if disrupted else self.deaths
        limit = self.limits.disruptions if disrupted else self.limits.retries
        counts[task] = count = counts.get(task, 0) + 1
        return count <= limit

    def settle(self, task: int) -> Counts:
        """Forget a task that is done; return its counts."""
        return Counts(self.deaths.pop(task, 0), self.disruptions.pop(task, 0))
