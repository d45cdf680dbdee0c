"""Tasks that run for too long: their workers are killed, and the error says where they were."""

from __future__ import annotations

from collections.abc import Callable

from fiber._engine.scheduler import Scheduler
from fiber._runtime.host import Loop, Timer
from fiber._runtime.jobs import Jobs
from fiber._runtime.worker_handle import WorkerHandle

PATIENCE = 1.0
"""Seconds that the end of a worker may take before its task fails without the stacks."""


class TimeLimits:
    """The time limits of batches.  Runs on the loop thread.

    ``advance`` is called when something follows.
    """

    def __init__(
        self, loop: Loop, scheduler: Scheduler, jobs: Jobs, *, advance: Callable[[], None]
    ) -> None:
        self._loop = loop
        self._scheduler = scheduler
        self._ledger = scheduler.ledger
        self._jobs = jobs
        self._advance = advance
        self._timers: dict[int, Timer] = {}
        self._ending: dict[WorkerHandle, tuple[int, Timer]] = {}
        """Batches whose time is over, with timers that wait for the ends of their workers."""

    def begin(self, seq: int, seconds: float) -> None:
        """Start the time of a batch."""
        self._timers[seq] = self._loop.call_later(seconds, self._over, seq)

    def settled(self, seq: int) -> None:
        """Drop the time limit of a batch, if it has one: its outcome is known."""
        if self._timers:
            timer = self._timers.pop(seq, None)
            if timer is not None:
                timer.cancel()

    def ended(self, handle: WorkerHandle, stack: str) -> None:
        """Fail the task that a worker was killed for, with the stacks that it has written."""
        seq, timer = self._ending.pop(handle, (0, None))
        if timer is None:
            return
        timer.cancel()
        receipt = self._ledger.expire(seq)
        if receipt is not None:
            self._jobs.put_timeout(receipt, handle.name, stack)

    def close(self) -> None:
        """Stop all timers."""
        for timer in (*self._timers.values(), *(timer for _, timer in self._ending.values())):
            timer.cancel()
        self._timers.clear()
        self._ending.clear()

    def _over(self, seq: int) -> None:
        batch = self._ledger.batches.get(seq)
        if self._timers.pop(seq, None) is None or batch is None:
            return
        handle: WorkerHandle = batch.worker.key
        self._ledger.retire(batch.worker)
        self._scheduler.let_go(handle)
        self._ending[handle] = seq, self._loop.call_later(PATIENCE, self._unheard, handle)
        handle.kill_with_stack()
        self._advance()

    def _unheard(self, handle: WorkerHandle) -> None:
        """The worker's host does not answer, or is slow."""
        self.ended(handle, "")
        handle.kill()
        self._advance()
