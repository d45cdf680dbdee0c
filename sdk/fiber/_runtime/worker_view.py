"""View of a pool's workers for users."""

from __future__ import annotations

from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple

from fiber._engine.worker_set import WorkerSet
from fiber._runtime.host import Loop
from fiber._runtime.latch import Latch


class WorkerInfo(NamedTuple):
    """State of a worker at one moment."""

    name: str
    """Name of its process."""
    host: str
    """Host that it runs on, on Kubernetes the name of its pod; empty while it waits for one."""
    node: str
    """Node of its pod; empty without Kubernetes, or while the node is not known."""
    pid: int | None
    """Pid on that host; None while it is not started."""
    state: str
    """``waiting`` for a host, ``starting``, ``idle``, ``busy`` or ``leaving``."""
    tasks: int
    """Number of tasks that it has done."""


class WorkerView:
    """Looks at the workers from any thread, and waits for them."""

    def __init__(self, workers: WorkerSet, loop: Loop) -> None:
        self._workers = workers
        self._loop = loop
        self._waiting: list[Latch] = []
        """Any thread adds and removes its own."""
        self._over = False

    def processes(self) -> list[BaseProcess]:
        """The processes of those that are there."""
        handles: list[Any] = list(self._workers.members)
        return [handle.process for handle in handles if handle.process is not None]

    def describe(self) -> list[WorkerInfo]:
        """All that are there, the oldest first."""
        return [_describe(handle) for handle in list(self._workers.members)]

    def wait_until_up(self, timeout: float | None) -> bool:
        """Wait until the pool's least number of workers are ready, or it is clear that they will
        not be; False if ``timeout`` seconds are over first.
        """
        latch = Latch()
        # Both sides note first and look then: one of both sees the other.
        self._waiting.append(latch)
        try:
            self._loop.call_soon(self.changed)
            return self._over or latch.wait(timeout)
        finally:
            self._waiting.remove(latch)

    # On the loop's thread

    def changed(self) -> None:
        """Workers are ready, or it is clear that none will be."""
        workers = self._workers
        if (
            self._over
            or workers.size - workers.starting >= workers.minimum
            or workers.error is not None
        ):
            for latch in list(self._waiting):
                latch.set()

    def end(self) -> None:
        """Note that there will be no more workers."""
        self._over = True
        self.changed()


def _describe(handle: Any) -> WorkerInfo:
    child, worker = handle.child, handle.worker
    if child is None or child.waiting:
        return WorkerInfo(handle.name, "", "", None, "waiting", 0)
    if handle.leaving:
        state = "leaving"
    elif worker is None:
        state = "starting"
    else:
        state = "busy" if worker.queue or worker.lent else "idle"
    return WorkerInfo(handle.name, child.host, child.node, child.pid, state, handle.tasks)
