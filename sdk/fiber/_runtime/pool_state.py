"""State of a pool at one moment, for monitors: its workers, its tasks, and its slowest tasks."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple, Protocol

from fiber._engine.ledger import Ledger
from fiber._runtime.short_forms import short_form, short_form_of_call
from fiber._runtime.work_items import Call

SLOWEST = 10
"""Running tasks that a state names."""


class RunningTask(NamedTuple):
    """Task that a worker runs."""

    task: str
    """Name of the task: the function, and the index of the task in a map."""
    worker: str
    host: str
    seconds: float
    """Time since the worker began the task, or the batch that the task is in."""
    argument: str
    """Short form of the item of a map, or of the arguments of a call; empty if it is not known."""


class PoolState(NamedTuple):
    """State of a pool at one moment."""

    workers: dict[str, int]
    """Number of workers by their state, as in ``WorkerInfo``."""
    waiting: int
    """Tasks that no worker has."""
    held: int
    """Tasks that workers have: they run, or wait in the worker."""
    done: int
    """Tasks that workers have done since the pool began, failed ones included."""
    slowest: list[dict[str, Any]]
    """The tasks that run for longest, as ``RunningTask``, the longest first."""


class WatchedPool(Protocol):
    """Pool that monitors see."""

    def describe(self) -> PoolState:
        """Return the state of the pool.  Runs on the loop thread."""


class Members(Protocol):
    """Workers of a pool."""

    @property
    def members(self) -> Iterable[Any]:
        """Handles of the workers."""


def pool_state(ledger: Ledger, workers: Members, done_before: int, now: float) -> PoolState:
    """Return the state of a pool; ``done_before``: tasks that workers did which are gone."""
    handles = list(workers.members)
    batches = [batch for job in ledger.jobs for batch in job.batches]
    held = sum(len(batch.items) - batch.received for batch in batches)
    return PoolState(
        workers=dict(Counter(handle.state for handle in handles)),
        waiting=sum(job.fed - job.done for job in ledger.jobs) - held,
        held=held,
        done=done_before + sum(handle.tasks for handle in handles),
        slowest=[task._asdict() for task in _slowest(handles, now)],
    )


def _slowest(handles: Iterable[Any], now: float) -> list[RunningTask]:
    busy = [handle for handle in handles if handle.worker is not None and handle.worker.queue]
    oldest = heapq.nsmallest(SLOWEST, busy, key=lambda handle: float(handle.worker.since))
    return [_running_task(handle, now) for handle in oldest]


def _running_task(handle: Any, now: float) -> RunningTask:
    """Return the task that a busy worker runs: the first one of its batch without a result."""
    batch = handle.worker.queue[0]
    name, argument = "a cancelled task", ""
    if batch.job is not None and batch.job.owner is not None:
        at = min(batch.received, len(batch.items) - 1)
        item = batch.items[at]
        name = batch.job.owner.task_name(batch.start + at, item)
        argument = _argument(item)
    seconds = max(0.0, now - handle.worker.since)
    return RunningTask(name, handle.name, handle.host, seconds, argument)


def _argument(item: Any) -> str:
    if isinstance(item, Call):
        return short_form_of_call(item.data, item.buffers)
    return short_form(item)
