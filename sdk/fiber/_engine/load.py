"""Ready workers, sorted by how much work each has."""

from __future__ import annotations

import itertools

from fiber._engine.tasks import WorkerEntry

PATIENCE = 2e-3
"""Seconds that a worker may take for a batch before the unread one behind it is recalled."""


class WorkersByLoad:
    """Ready workers in sets, which are dicts in order to keep the order of insertion.

    ``idle``: workers without a batch; ``idle_pinned``: those of them that have pinned tasks.
    ``queueable``: workers with one batch that may get another.  ``recallable``: workers with two
    batches, whose second one may be recalled; ``recalled``: those whose second one was recalled.
    ``spent``: workers that did all units they may do.  Leased and leaving workers get no batches
    and are neither idle nor queueable.
    """

    def __init__(self) -> None:
        self.idle: dict[WorkerEntry, None] = {}
        self.idle_pinned: dict[WorkerEntry, None] = {}
        self.queueable: dict[WorkerEntry, None] = {}
        self.recallable: dict[WorkerEntry, None] = {}
        self.recalled: dict[WorkerEntry, None] = {}
        self.spent: dict[WorkerEntry, None] = {}

    def sort(self, worker: WorkerEntry) -> None:
        """Move ``worker`` to the sets for the work that it has now."""
        self.idle.pop(worker, None)
        self.idle_pinned.pop(worker, None)
        self.queueable.pop(worker, None)
        queue = worker.queue
        if len(queue) < 2:
            self.recallable.pop(worker, None)
            self.recalled.pop(worker, None)
        elif worker.recalled:
            self.recallable.pop(worker, None)
            self.recalled[worker] = None
        elif worker not in self.recallable:
            self.recalled.pop(worker, None)
            self.recallable[worker] = None
        if worker.leaving or worker.left == 0:
            if not queue and not worker.leaving:
                self.spent[worker] = None
            return
        if worker.leased:
            return
        if not queue:
            self.idle[worker] = None
            self.sort_pinned(worker)
        elif len(queue) == 1 and not queue[0].alone and not worker.pinned:
            self.queueable[worker] = None

    def sort_pinned(self, worker: WorkerEntry) -> None:
        """Update ``idle_pinned`` if only the pinned tasks of ``worker`` have changed."""
        if worker.pinned and worker in self.idle:
            self.idle_pinned[worker] = None
        else:
            self.idle_pinned.pop(worker, None)

    def last_idle(self) -> WorkerEntry | None:
        """Return the worker that became idle last: its caches are warm, and others may end."""
        return next(reversed(self.idle), None)

    def queueable_after(self, spared: int) -> WorkerEntry | None:
        """Return the queueable worker that will be idle first, after ``spared`` others."""
        return next(itertools.islice(self.queueable, spared, None), None)

    def recall(self, now: float) -> list[WorkerEntry]:
        """Return the workers whose unread batch to recall, one for each idle one; mark them."""
        victims = [worker for worker in self._candidates() if now >= worker.since + PATIENCE]
        for worker in victims:
            worker.recalled = True
            self.sort(worker)
        return victims

    def next_recall(self) -> float | None:
        """Return the time of the next recall, if no event comes before; None if there is none."""
        return min((worker.since + PATIENCE for worker in self._candidates()), default=None)

    def _candidates(self) -> list[WorkerEntry]:
        return list(itertools.islice(self.recallable, len(self.idle)))
