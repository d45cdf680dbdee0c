"""Who may be given work: the ready workers, by how much each holds."""

from __future__ import annotations

import itertools

from fiber._engine.tasks import Worker

PATIENCE = 2e-3
"""Seconds that a worker's current batch may take before idle ones ask for what lies behind it."""


class WorkersByLoad:
    """The ready workers.  Dicts serve as sets that remember the order of insertion.

    ``idle`` hold nothing, ``idle_pinned`` are those of them that have pinned tasks to run.
    ``queueable`` hold one batch, and could be given another.  ``recallable`` hold two, of which the
    second could be recalled, and is in those of ``recalled``.  ``spent`` did all that they may do.
    Who is lent or leaves is in none of them.
    """

    def __init__(self) -> None:
        self.idle: dict[Worker, None] = {}
        self.idle_pinned: dict[Worker, None] = {}
        self.queueable: dict[Worker, None] = {}
        self.recallable: dict[Worker, None] = {}
        self.recalled: dict[Worker, None] = {}
        self.spent: dict[Worker, None] = {}

    def sort(self, worker: Worker) -> None:
        """Put ``worker`` where one that holds as much as it does belongs."""
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
        if worker.lent:
            return
        if not queue:
            self.idle[worker] = None
            self.sort_pinned(worker)
        elif len(queue) == 1 and not queue[0].alone and not worker.pinned:
            self.queueable[worker] = None

    def sort_pinned(self, worker: Worker) -> None:
        """The same when its pinned tasks have changed, and nothing else."""
        if worker.pinned and worker in self.idle:
            self.idle_pinned[worker] = None
        else:
            self.idle_pinned.pop(worker, None)

    def last_idle(self) -> Worker | None:
        """The worker that became idle last: its memory is warm, and the others may leave."""
        return next(reversed(self.idle), None)

    def queueable_after(self, spared: int) -> Worker | None:
        """The worker that will need something to do first, sparing some that will before it."""
        return next(itertools.islice(self.queueable, spared, None), None)

    def recall(self, now: float) -> list[Worker]:
        """Workers to ask for what they have not read, one for each idle one; marks them."""
        victims = [worker for worker in self._candidates() if now >= worker.since + PATIENCE]
        for worker in victims:
            worker.recalled = True
            self.sort(worker)
        return victims

    def next_recall(self) -> float | None:
        """When ``recall`` could next return something, if nothing else happens."""
        return min((worker.since + PATIENCE for worker in self._candidates()), default=None)

    def _candidates(self) -> list[Worker]:
        return list(itertools.islice(self.recallable, len(self.idle)))
