"""What a person can see of a pool's workers."""

from __future__ import annotations

import contextlib
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple

from fiber._engine.worker_set import WorkerSet
from fiber._runtime.host import Loop
from fiber._runtime.latch import Latch


class WorkerInfo(NamedTuple):
    """One worker, as it was when asked."""

    name: str
    """Of its process."""
    host: str
    """Where it runs, on Kubernetes the name of its pod; empty while it waits for one."""
    node: str
    """The node of its pod; empty elsewhere, or while that is not known."""
    pid: int | None
    """There; None while it is not started."""
    state: str
    """``waiting`` for a host, ``starting``, ``idle``, ``busy`` or ``leaving``."""
    tasks: int
    """How many it has done."""


class WorkerView:
    """Looks at the workers from any thread, and waits for them."""

    def __init__(self, workers: WorkerSet, loop: Loop) -> None:
        self._workers = workers
        self._loop = loop
        self._waiting: list[Latch] = []

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
        self._loop.call_soon(self._join, latch)
        try:
            return latch.wait(timeout)
        finally:
            self._loop.call_soon(self._leave, latch)

    # On the loop's thread

    def changed(self) -> None:
        """Workers are ready, or it is clear that none will be."""
        workers = self._workers
        if workers.size - workers.starting >= workers.minimum or workers.error is not None:
            for latch in self._waiting:
                latch.set()

    def _join(self, latch: Latch) -> None:
        self._waiting.append(latch)
        self.changed()

    def _leave(self, latch: Latch) -> None:
        with contextlib.suppress(ValueError):
            self._waiting.remove(latch)


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
