"""The watchdog: a pool worker's second thread, which splits slow batches.

A message carries many short tasks.  One of them may turn out long, or wait until the program has
the result of another.  So when a batch has run for a while, the watchdog sends its results and
gives back the tasks that have not begun, for other workers.
"""

from __future__ import annotations

import queue
import threading
import time

from fiber._agent.batch_results import BatchResults

SPLIT_EAGER_AFTER = 10e-3
"""Seconds that a batch may run before it is split, if its results are wanted one by one."""

SPLIT_AFTER = 40e-3
"""Seconds for other batches.  Both are a few times the work that a message should carry."""


class Watchdog:
    """Watchdog over one batch after the other, whose thread sleeps while there is none."""

    def __init__(self) -> None:
        self._batch: BatchResults | None = None
        self._asleep = False
        self._wake: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._started = False
        self._stopped = False

    def begin(self, batch: BatchResults) -> None:
        """Watch ``batch``, which starts to run."""
        self._batch = batch
        if self._asleep:
            self._asleep = False
            self._wake.put(None)
        elif not self._started:
            self._started = True
            threading.Thread(target=self._run, name="fiber-watchdog", daemon=True).start()

    def end(self) -> None:
        """Stop watching the batch, which has run."""
        self._batch = None

    def stop(self) -> None:
        """End the thread."""
        self._stopped = True
        self._wake.put(None)

    def _run(self) -> None:
        seen = None
        while not self._stopped:
            # Sleep if no batch runs, or its split is done.  The second line sees a batch that began
            # after the first.  A batch that begins later puts a wake-up in the queue.
            self._asleep = True
            if self._batch is None or self._batch.seq == seen:
                self._wake.get()
            batch = self._wait_for_slow_batch()
            if batch is not None:
                seen = batch.seq
                try:
                    batch.return_unstarted()
                except OSError:  # the executor is gone, and this process will end too
                    return
                del batch  # its results must not live until the next batch

    def _wait_for_slow_batch(self) -> BatchResults | None:
        """Wait for a batch that runs for too long; return None once no batch runs.

        On a busy machine a batch may not have begun yet.  A worker keeps at least one task.
        """
        while (batch := self._batch) is not None:
            time.sleep(SPLIT_EAGER_AFTER if batch.eager else SPLIT_AFTER)
            if self._batch is batch and batch.started():
                return batch
        return None
