"""A pool's part of the program's activity: what its workers did, and what was sent to them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from fiber._engine.activity import SEVERAL, Activity, WorkReport, WorkSource
from fiber._engine.tasks import Receipt, WorkerEntry
from fiber._runtime.answers import is_failure
from fiber._runtime.work_items import WorkItem
from fiber._runtime.workers import WorkerHandle
from fiber._transport.loop import Loop

CANCELLED = "(cancelled tasks)"
"""Function of work whose results do not count."""


class PoolActivity:
    """Notes of one pool for the program's activity.  Runs on the loop thread."""

    def __init__(self, activity: Activity, loop: Loop) -> None:
        self._activity = activity
        self._loop = loop
        self._pool = activity.add_pool()
        self.done_before = 0
        """Tasks that workers did which are gone."""

    def ready(self, handle: WorkerHandle) -> None:
        """Note that a worker is ready for tasks."""
        if handle.record is not None:
            self._activity.ready(handle.record, self._loop.now(), self._pool)

    def sent(self, pickling: float, data: bytes, buffers: Sequence[memoryview]) -> None:
        """Note a message to a worker, and the seconds in which its tasks were pickled."""
        activity = self._activity
        activity.pickling += pickling
        activity.bytes_sent += len(data)
        if buffers:
            activity.bytes_sent += sum([buffer.nbytes for buffer in buffers])

    def answered(
        self,
        handle: WorkerHandle,
        since: float,
        receipt: Receipt | None,
        answer: tuple[float, list[Any], bool, int],
    ) -> None:
        """Note an answer: its seconds of work, values, whether they are mixed, and bytes.

        ``since``: when the worker began the batch.  Without a receipt the results do not count.
        """
        record = handle.record
        if record is None:
            return
        seconds, values, mixed, size = answer
        now = self._loop.now()
        record.held += now - max(since, record.noted)
        record.noted = now
        self._activity.bytes_received += size
        failed = sum(map(is_failure, values)) if mixed else 0
        name = CANCELLED if receipt is None else _function(receipt)
        chunk = 1 if receipt is None else receipt.job.unit
        self._activity.worked(
            record, WorkReport(name, now - seconds, now, seconds, len(values), failed, 1, chunk)
        )

    def leased(self, handle: WorkerHandle, work: WorkReport) -> None:
        """Note calls that their callers sent to a worker themselves."""
        record = handle.record
        if record is not None:
            record.held += work.seconds  # the caller may have paused between the calls
            record.noted = work.end
            self._activity.worked(record, work)

    def notes_of(self, source: WorkSource) -> None:
        """Have ``source`` note its work before the activity is read."""
        self._activity.sources.add(source)

    def retried(self) -> None:
        """Note that a task runs again after an error."""
        self._activity.retried += 1

    @contextmanager
    def losing(self, handle: WorkerHandle, worker: WorkerEntry | None) -> Iterator[None]:
        """Note the runs that are lost with a worker, while its tasks are given back."""
        self.done_before += handle.tasks
        batches = list(worker.queue) if worker is not None else []
        if worker is not None and batches and handle.record is not None:
            name = batches[0].job and _function_of(batches[0].job.owner, batches[0].items[:1])
            now = self._loop.now()
            begin = max(worker.since, handle.record.noted)
            self._activity.worked(handle.record, WorkReport(name or CANCELLED, begin, now, 0.0, 0))
        jobs = {batch.job for batch in batches if batch.job is not None}
        before = _lost(jobs)
        yield
        self._activity.lost += _lost(jobs) - before


def _lost(jobs: Iterable[Any]) -> int:
    return sum(job.charges.lost for job in jobs)


def _function(receipt: Receipt) -> str:
    """Return the name of the function whose tasks a receipt is for."""
    owner, batch = receipt.job.owner, receipt.batch
    first = receipt.start - batch.start
    return _function_of(owner, batch.items[first : first + receipt.size])


def _function_of(owner: WorkItem | None, items: Sequence[Any]) -> str:
    if owner is None:
        return CANCELLED
    if owner.function is not None:
        return owner.function.name
    names = {call.name for call in items}
    return names.pop() if len(names) == 1 else SEVERAL
