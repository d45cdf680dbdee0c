"""Work items of a pool that are not done: their jobs in the ledger, their input, their futures.

Single calls with the same options share a queue, and a job of the ledger that stays open.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from fiber import _logs
from fiber._agent.interface import ExitReport
from fiber._engine.chunks import FLOOR, TaskPace
from fiber._engine.ledger import Ledger
from fiber._engine.scheduler import Scheduler
from fiber._engine.tasks import Job, Limits, Loss, Receipt, WorkerEntry
from fiber._runtime.answers import Pickled, TaskFailure
from fiber._runtime.pool_activity import PoolActivity
from fiber._runtime.work_items import Call, WorkItem, is_wanted
from fiber._transport.loop import Loop
from fiber._wire import work
from fiber.errors import TimeoutError, WorkerDied, block

TICK = 1e-4
"""Shortest delay of a timer, in seconds.

A rounding error could make a shorter timer fire too early, and the executor would set it again.
"""


class Jobs:
    """Opens, feeds and ends jobs, and hands their outcomes to futures.  Runs on the loop thread."""

    def __init__(
        self, ledger: Ledger, limits: Limits, activity: PoolActivity, *, retry: bool
    ) -> None:
        self._ledger = ledger
        self._limits = limits
        self._activity = activity
        self._retry = retry
        self._streams: dict[WorkItem, None] = {}

    def open(self, item: WorkItem) -> Job:
        """Open the job of a work item."""
        function = item.function
        pace = TaskPace(function.pace if function is not None else None)
        if function is not None:
            function.pace = pace
        item.job = job = self._ledger.open(
            item,
            pace=pace,
            limits=item.limits or self._limits,
            unit=item.unit,
            alone=item.timeout is not None,
            eager=item.eager,
        )
        return job

    def run(self, item: WorkItem, tasks: Sequence[Any]) -> None:
        """Open the job of a work item that has all of its tasks."""
        self._ledger.feed(self.open(item), tasks)
        self.close(item)

    def close(self, item: WorkItem) -> None:
        """Close the job of a work item to further tasks."""
        if item.job is not None and item.job.owner is item:
            self._ledger.close(item.job)
            self.check_finished(item.job)

    # Streams

    def open_stream(self, item: WorkItem) -> None:
        """Open the job of a stream."""
        self.open(item)
        self._streams[item] = None
        self.top_up(item)

    def top_up(self, item: WorkItem) -> bool:
        """Feed the tasks that a stream has read, and let it read on; False if there were none."""
        stream, job, ledger = item.stream, item.job, self._ledger
        if item not in self._streams or stream is None or job is None:
            return False
        tasks = stream.take()
        if not tasks and not job.waiting:
            stream.await_input()
            tasks = stream.take()
        ledger.feed(job, tasks)
        stream.grant(len(job.waiting), len(ledger.workers), job.pace, job.target)
        return bool(tasks)

    def top_up_all(self, items: Iterable[WorkItem | None]) -> bool:
        """Top up the streams among ``items``; return False if none had tasks."""
        if not self._streams:
            return False
        found = False
        for item in {item for item in items if item is not None and item.stream is not None}:
            found |= self.top_up(item)
        return found

    def resume(self, item: WorkItem) -> None:
        """Run further tasks of ``item``, if its future has room for results again."""
        if item.job is not None and item.future is not None and item.future.has_room():
            self._ledger.pause(item.job, False)

    def lift_limits(self) -> None:
        """Lift all limits: no results are read from now on."""
        for job in self._ledger.jobs:
            if job.owner.future is not None:
                job.owner.future.lift_bound()
            self._ledger.pause(job, False)
        for item in list(self._streams):
            if item.stream is not None:
                item.stream.lift_limit()
                self.top_up(item)

    def close_streams(self) -> None:
        """Have the streams with a limit read what they may read now, and no more later."""
        for item in self._streams:
            if item.stream is not None:
                item.stream.close()

    def end_stream(self, item: WorkItem, error: BaseException | None) -> None:
        """End the stream of ``item``.  An ``error`` takes the place of the next task."""
        job = item.job
        if item not in self._streams or item.stream is None or job is None:
            return  # it has failed or was cancelled
        self._ledger.feed(job, item.stream.take())
        if error is not None and item.future is not None:
            item.future.add_results(job.fed, [TaskFailure(error)], True)
        self.close(item)
        self._streams.pop(item, None)

    # Outcomes

    def put(
        self, receipt: Receipt, results: list[Any], *, mixed: bool = True, size: int = 0
    ) -> None:
        """Hand results of ``size`` bytes to their futures.  Tasks that may retry run again."""
        if mixed and self._retry:
            for at, result in enumerate(results):
                again = type(result) is Pickled and result.kind == work.AGAIN
                index = receipt.start + at
                if again and self._ledger.retry(receipt, index):
                    self._activity.retried()
                else:
                    self._put(receipt._replace(start=index), [result], True, size // len(results))
        else:
            self._put(receipt, results, mixed, size)
        self.check_finished(receipt.job)

    def _put(self, receipt: Receipt, results: list[Any], mixed: bool, size: int) -> None:
        item: WorkItem = receipt.job.owner
        if item.future is not None:
            if item.future.add_results(receipt.start, results, mixed, size):
                self._ledger.pause(receipt.job, True)
            return
        for task, outcome in enumerate(results, receipt.start):
            receipt.job.charges.settle(task)  # the job of calls stays open
            future = receipt.item(task).future
            future.add_results(0, [outcome], mixed)
            future.set_done()

    def put_timeout(self, receipt: Receipt, worker: str, stack: str) -> None:
        """Fail a task that took too long; ``stack`` says where it was."""
        item: WorkItem = receipt.job.owner
        name = item.task_name(receipt.start, receipt.item(receipt.start))
        lines = [
            f"{name} took longer than its timeout of {item.timeout:g} s; "
            f"its worker {worker!r} was killed"
        ]
        if stack:
            lines.append(block("Where it was:", stack.splitlines()))
        self.put(receipt, [TaskFailure(TimeoutError("\n".join(lines)))])

    def put_losses(
        self, losses: list[Loss], worker: str, pid: int | None, report: ExitReport
    ) -> None:
        """Fail the tasks that have no tries left after the loss of a worker."""
        for loss in losses:
            item: WorkItem = loss.job.owner
            error = WorkerDied(
                task=item.task_name(loss.task, loss.item),
                worker=worker,
                host=report.host,
                pid=pid,
                exitcode=report.exitcode,
                reason=report.reason,
                log=report.log,
                stack=report.stack,
                attempts=loss.counts.deaths,
                disruptions=loss.counts.disruptions,
                pod=report.pod or None,
                node=report.node or None,
            )
            _logs.debug("%s is given up: %s", error.task, report.describe())
            if item.future is not None:
                item.future.add_results(loss.task, [TaskFailure(error)], True)
            else:
                loss.item.future.add_results(0, [TaskFailure(error)], True)
                loss.item.future.set_done()
        for job in {loss.job for loss in losses}:
            self.check_finished(job)

    # The end

    def check_finished(self, job: Job) -> None:
        """End a job if all of its tasks are done."""
        item: WorkItem | None = job.owner
        if job.finished and item is not None:
            future = item.future
            self._over(item)
            if future is not None:
                future.set_done()

    def fail(self, job: Job, error: BaseException) -> None:
        """Fail all tasks of a job that are not done."""
        item: WorkItem | None = job.owner
        if item is None:
            return
        if item.future is not None:
            item.future.set_exception(error)
        else:
            call: Call
            for call in self._ledger.unfinished(job):
                call.future.set_exception(error)
        self._ledger.cancel(job)
        self._over(item)

    def cancel(self, item: WorkItem) -> list[WorkerEntry]:
        """Drop the rest of ``item``; return the workers whose unread tasks to recall."""
        if item.job is None or item.job.owner is not item:
            return []  # it was never submitted, or is done
        holders = self._ledger.cancel(item.job)
        self._over(item)
        return holders

    def _over(self, item: WorkItem) -> None:
        if item in self._streams and item.stream is not None:
            del self._streams[item]
            item.stream.end()
        if item.job is not None:
            item.job.owner = None
        item.future = item.stream = None
        item.grants.clear()


class CallQueue:
    """Queue of calls that share their options."""

    __slots__ = ("called", "item", "stale", "watched")

    def __init__(
        self,
        *,
        limits: Limits | None = None,
        timeout: float | None = None,
        cancellable: bool = False,
    ) -> None:
        self.item = WorkItem(
            work.CALLS, eager=True, timeout=timeout, limits=limits, cancellable=cancellable
        )
        self.called: deque[Call] = deque()
        """Calls that the loop has not taken.  Any thread appends."""
        self.stale = False
        """True while the loop is about to drop cancelled calls."""
        self.watched = False
        """True while the loop is about to look for more calls, so callers need not wake it.  Only
        the loop sets it, so an interrupted caller leaves it as it is."""


class Calls:
    """Queues of calls of one pool.

    ``refusal`` returns the error for calls of a pool that takes none.  ``advance`` is called when
    the scheduler has to decide again.
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
        """Drop the cancelled calls, so that no worker starts for them."""
        if not queue.stale:
            queue.stale = True
            try:
                self._loop.call_soon(self._drop_cancelled, queue)
            except BaseException:  # interrupted: the next caller must ask again
                queue.stale = False
                raise

    def close(self, queue: CallQueue) -> None:
        """Close a queue to further calls."""
        self._loop.call_soon(self._close, queue)

    # The loop thread

    def take_all(self) -> None:
        """Take all calls that were made until now."""
        for queue in list(self._queues):
            self._take(queue)

    def close_all(self) -> None:
        """Close all queues to further calls."""
        for queue in list(self._queues):
            self._close(queue)

    def cancel_all(self) -> None:
        """Cancel the calls that no worker has, in queues whose calls can be cancelled."""
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
        """Take the calls of a queue.  If short calls come fast, several travel together.

        Otherwise each would wake a worker, which takes longer than the call.
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
        # One call for each idle worker: a slow call then delays no other.
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
