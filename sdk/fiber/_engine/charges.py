"""Counts of tasks that were lost with their workers, and the bounds of these counts.

A lost task runs again.  Two bounds limit that, for two causes of the loss:

* **Deaths.**  The task may have killed its worker.  It runs again at most ``retries`` times.
* **Disruptions.**  The cluster ended the worker: a drain, an eviction, a preemption, a lost node.
  The task is not to blame, so this uses up no retry.  ``disruptions`` bounds it nevertheless:
  a task that takes longer than any worker lives would run again without end.

Pure.
"""

from __future__ import annotations

from typing import NamedTuple


class Limits(NamedTuple):
    """Number of times that one task may run again, by the cause of its worker's end."""

    retries: int = 3
    disruptions: int = 20


class Counts(NamedTuple):
    """Number of times that one task was lost."""

    deaths: int
    disruptions: int


class Charges:
    """Losses that are charged to the tasks of one job, by their indices."""

    __slots__ = ("deaths", "disruptions", "limits")

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.deaths: dict[int, int] = {}
        self.disruptions: dict[int, int] = {}

    def charge(self, task: int, *, disrupted: bool = False) -> bool:
        """Count one more lost run; return False if the task may not run again."""
        counts = self.disruptions if disrupted else self.deaths
        limit = self.limits.disruptions if disrupted else self.limits.retries
        counts[task] = count = counts.get(task, 0) + 1
        return count <= limit

    def settle(self, task: int) -> Counts:
        """Forget a task that is done; return its counts."""
        return Counts(self.deaths.pop(task, 0), self.disruptions.pop(task, 0))
