"""Single calls, from the threads that make them to the ledger.

Calls with the same options share a queue, and a job of the ledger that stays open.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from fiber._engine.charges import Limits
from fiber._engine.chunks import FLOOR
from fiber._engine.ledger import Job
from fiber._engine.scheduler import Scheduler
from fiber._runtime.host import TICK, Loop
from fiber._runtime.jobs import Jobs
from fiber._runtime.work_items import Call, WorkItem, is_wanted
from fiber._wire import work


class CallQueue:
    """Calls that share their options, in the order in which they were made."""

    __slots__ = ("called", "item", "stale", "watched")

    def __init__(
        self,
        *,
        limits: Limits | None = None,
        timeout: float | None = None,
        cancellable: bool = False,
    ) -> None:
        self.item = WorkItem(
            work.CALLS, exact=True, timeout=timeout, limits=limits, cancellable=cancellable
        )
        self.called: deque[Call] = deque()
        """Calls that the loop has not taken.  Any thread appends."""
        self.stale = False
        """True while the loop is about to drop cancelled calls."""
        self.watched = False
        """True while the loop is about to look for more calls, and need not be told.  Only the loop
        sets it, so an interrupted caller leaves it as it is."""


class Calls:
    """All the queues of one pool.

    ``refusal`` says why no call is taken any more; ``advance`` is called when something follows.
    """

    def __init__(
        self,
        loop: Loop,
        scheduler: Scheduler,
        jobs: Jobs,
        *,
        refusal: Callable[[], BaseException | None],
        advance: Callable[[], None],
    ) -> None:
        self._loop = loop
        self._workers = scheduler.workers
        self._ledger = scheduler.ledger
        self._jobs = jobs
        self._refusal = refusal
        self._advance = advance
        self._queues: dict[CallQueue, None] = {}
        """Queues with open jobs."""
        self._without_options = CallQueue()
        self._took = -math.inf

    # Any thread

    def put(self, call: Call, queue: CallQueue | None = None) -> None:
        """Add a call.  Without ``queue`` it has no options."""
        if queue is None:
            queue = self._without_options
        queue.called.append(call)
        if call.blocking or not queue.watched:
            self._loop.call_soon(self._take, queue)

    def drop_cancelled(self, queue: CallQueue) -> None:
        """Calls were cancelled: let no worker be started for them."""
        if not queue.stale:
            queue.stale = True
            try:
                self._loop.call_soon(self._drop_cancelled, queue)
            except BaseException:  # interrupted: the next one must not rely on it
                queue.stale = False
                raise

    def close(self, queue: CallQueue) -> None:
        """No call of it will come any more."""
        self._loop.call_soon(self._close, queue)

    # The loop's thread

    def take_all(self) -> None:
        """Take what was called until now."""
        for queue in list(self._queues):
            self._take(queue)

    def close_all(self) -> None:
        """No call will come any more."""
        for queue in list(self._queues):
            self._close(queue)

    def cancel_all(self) -> None:
        """Cancel the calls that no worker was given, where they can be cancelled."""
        self.take_all()
        for queue in self._queues:
            if queue.item.cancellable and queue.item.job is not None:
                for call in self._ledger.unfinished(queue.item.job):
                    call.future.cancel()
                self._drop_cancelled(queue)

    def _close(self, queue: CallQueue) -> None:
        if queue in self._queues:
            self._take(queue)
            del self._queues[queue]
            self._jobs.close(queue.item)

    def _drop_cancelled(self, queue: CallQueue) -> None:
        queue.stale = False
        job = queue.item.job
        if job is not None:
            self._ledger.drop_waiting(job, is_wanted)
            self._jobs.check_finished(job)
            self._advance()

    def _take(self, queue: CallQueue) -> None:
        """Calls have come.  Of many short ones in a row, several travel together.

        Each would else wake a worker, which costs more than the call.
        """
        called = queue.called
        calls = [called.popleft() for _ in range(len(called))]
        refusal = self._refusal()
        if refusal is not None:
            for call in calls:
                call.future.set_exception(refusal)
        if not calls or refusal is not None:
            return
        job = self._job(queue)
        now = self._loop.now()
        hurried = now - self._took < FLOOR and job.pace.short
        self._took = now
        busy = job.fed - job.done >= self._workers.size
        # One for each who is idle: whoever turns out to be stuck then holds up no other.
        alone = self._ledger.idle_count()
        for call in calls[:alone]:
            self._ledger.feed(job, [call])
            self._advance()
        together = calls[alone:]
        self._ledger.feed(job, together)
        if not hurried or not busy or (together and together[-1].blocking):
            self._advance()
        elif not queue.watched:
            queue.watched = True
            self._loop.call_later(TICK, self._take_more, queue)

    def _take_more(self, queue: CallQueue) -> None:
        queue.watched = False
        self._take(queue)
        self._advance()

    def _job(self, queue: CallQueue) -> Job:
        if queue not in self._queues:
            self._queues[queue] = None
            self._jobs.open(queue.item)
        assert queue.item.job is not None
        return queue.item.job
