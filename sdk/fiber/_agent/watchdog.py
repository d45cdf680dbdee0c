"""A pool worker's second thread: no task and no result waits behind a slow task of its own batch.

Short tasks travel many a message, and one of them may turn out long, or wait for something that
the program does once it has the result of another.  So when a batch has run for a while, what it
has so far is sent, and what it has not begun is given back for others to run.
"""

from __future__ import annotations

import queue
import threading
import time

from fiber._agent.batch_results import BatchResults

SPLIT_EAGER_AFTER = 10e-3
"""Seconds that a batch may run before it is taken apart, if its results are wanted one by one."""

SPLIT_AFTER = 40e-3
"""The same for other batches.  Both are some times what a message was meant to carry."""


class Watchdog:
    """Watches over one batch after the other.  Sleeps while there is none."""

    def __init__(self) -> None:
        self._batch: BatchResults | None = None
        self._asleep = False
        self._wake: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._started = False
        self._stopped = False

    def begin(self, batch: BatchResults) -> None:
        """``batch`` starts to run."""
        self._batch = batch
        if self._asleep:
            self._asleep = False
            self._wake.put(None)
        elif not self._started:
            self._started = True
            threading.Thread(target=self._run, name="fiber-watchdog", daemon=True).start()

    def end(self) -> None:
        """It has run."""
        self._batch = None

    def stop(self) -> None:
        """There will be no more."""
        self._stopped = True
        self._wake.put(None)

    def _run(self) -> None:
        seen = None
        while not self._stopped:
            # Nothing to watch, or nothing more to do for it.  What begins between these lines is
            # seen by the second; what begins later puts something in.
            self._asleep = True
            if self._batch is None or self._batch.seq == seen:
                self._wake.get()
            batch = self._wait_for_slow_batch()
            if batch is not None:
                seen = batch.seq
                try:
                    batch.return_unstarted()
                except OSError:  # the executor is gone, and this process will follow
                    return
                del batch  # its results must not live until the next batch

    def _wait_for_slow_batch(self) -> BatchResults | None:
        """Wait for a batch that runs for too long; None if they end before that.

        On a busy machine it may not have begun: a worker keeps one task at least.
        """
        while (batch := self._batch) is not None:
            time.sleep(SPLIT_EAGER_AFTER if batch.eager else SPLIT_AFTER)
            if self._batch is batch and batch.started():
                return batch
        return None
