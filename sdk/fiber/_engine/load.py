"""Workers by load, and the recall of unread batches.

A worker gets its next batch while it runs one, so that a short task need not wait for a message.
The price: the batch waits unread, although another worker might run it.  It is recalled in two
cases:

* **A worker is idle,** and no task waits.
* **The batch before it is late.**  It runs several times longer than its pace predicted, and at
  least ``LATE_AFTER``.  It may run for a minute, or wait for a task of the unread batch.  The
  worker gets no further batch before it has answered.  The tasks that come back are the next to be
  sent.
"""

from __future__ import annotations

import itertools

from fiber._engine.tasks import WorkerEntry

RECALL_AFTER = 2e-3
"""Seconds that a worker may take for a batch before an idle worker recalls the one behind it."""

LATE_AFTER = 50e-3
"""Seconds that each batch may take before it counts as late."""

LATE_TIMES = 4
"""Multiple of its predicted seconds that a batch may take before it counts as late."""

CHECK_EVERY = 50e-3
"""Seconds between two checks for late batches."""


class WorkersByLoad:
    """Ready workers in sets, which are dicts in order to keep the order of insertion.

    ``idle``: workers without a batch; ``idle_pinned``: those of them that have pinned tasks.
    ``queueable``: workers with one batch that may get another.  ``recallable``: workers with two
    batches, whose second one may be recalled; ``recalled``: those whose second one was recalled.
    ``spent``: workers that did all units they may do.  Leased and leaving workers get no batches
    and are neither idle nor queueable.  A worker whose batch is late is not queueable.
    """

    def __init__(self) -> None:
        self.idle: dict[WorkerEntry, None] = {}
        self.idle_pinned: dict[WorkerEntry, None] = {}
        self.queueable: dict[WorkerEntry, None] = {}
        self.recallable: dict[WorkerEntry, None] = {}
        self.recalled: dict[WorkerEntry, None] = {}
        self.spent: dict[WorkerEntry, None] = {}
        self._check_at: float | None = None  # time of the next check for late batches

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
        elif len(queue) == 1 and not (queue[0].alone or queue[0].late or worker.pinned):
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
        return self._recall(
            [worker for worker in self._candidates() if now >= worker.since + RECALL_AFTER]
        )

    def recall_from_late(self, now: float, *, alone: bool) -> list[WorkerEntry]:
        """Return the workers whose unread batch to recall since another is late; mark them.

        Look for them every ``CHECK_EVERY`` seconds, while there are unread batches.  A worker that
        is ``alone`` keeps its batch, as nobody else could run it.
        """
        if alone:
            self._check_at = None
            return []
        if self._check_at is not None and now < self._check_at and self.recallable:
            return []
        due, self._check_at = self._check_at, None
        late = []
        if due is not None:
            late = [worker for worker in self.recallable if now >= _late_at(worker)]
        for worker in late:
            worker.queue[0].late = True
        self._recall(late)
        if self.recallable:
            self._check_at = now + CHECK_EVERY
        return late

    def _recall(self, victims: list[WorkerEntry]) -> list[WorkerEntry]:
        for worker in victims:
            worker.recalled = True
            self.sort(worker)
        return victims

    def next_recall(self) -> float | None:
        """Return the time of the next recall, if no event comes before; None if there is none."""
        due = [worker.since + RECALL_AFTER for worker in self._candidates()]
        if self._check_at is not None and self.recallable:
            due.append(self._check_at)
        return min(due, default=None)

    def _candidates(self) -> list[WorkerEntry]:
        return list(itertools.islice(self.recallable, len(self.idle)))


def _late_at(worker: WorkerEntry) -> float:
    """Return the time from which on the batch that ``worker`` runs is late."""
    return worker.since + max(LATE_AFTER, LATE_TIMES * worker.queue[0].predicted())
