"""From a batch to a packet on its way: pickled where that may be done, within its time.

On the loop's thread, but for ``_encode``, which may run the user's code and so has the background
thread.
"""

from __future__ import annotations

from collections.abc import Callable

from fiber._engine.ledger import Batch, Job, Ledger, Worker
from fiber._runtime.background import BackgroundThread
from fiber._runtime.host import Loop
from fiber._runtime.jobs import Jobs
from fiber._runtime.outcome import Failure
from fiber._runtime.time_limits import TimeLimits
from fiber._runtime.work_items import (
    Encoded,
    WorkItem,
    blame_items,
    claim,
    encode,
    is_wanted,
    pack,
    pickles_without_user_code,
)
from fiber._runtime.worker_handle import WorkerHandle


class Sender:
    """Sends batches.  ``advance`` is called when something follows."""

    def __init__(
        self,
        loop: Loop,
        background: BackgroundThread,
        ledger: Ledger,
        jobs: Jobs,
        limits: TimeLimits,
        *,
        advance: Callable[[], None],
    ) -> None:
        self._loop = loop
        self._background = background
        self._ledger = ledger
        self._jobs = jobs
        self._advance = advance
        self._limits = limits
        self._unsent: set[int] = set()
        """Batches that their workers do not have: nobody can have run them."""

    def send(self, batch: Batch) -> None:
        """Send a batch, or have it encoded where the user's code may run."""
        assert batch.job is not None
        item: WorkItem = batch.job.owner
        if item.cancellable and not claim(batch):
            self._drop_cancelled(batch, batch.job)
            return
        if not pickles_without_user_code(item, batch):
            self._unsent.add(batch.seq)
            try:
                self._background.submit(self._encode, item, batch)
            except RuntimeError as error:  # the system has no room for its thread
                self._unsendable(batch, error)
            return
        try:
            encoded = encode(item, batch, plain=True)
        except Exception as error:  # no memory
            self._unsendable(batch, error)
        else:
            self._deliver(item, batch, encoded)

    def _encode(self, item: WorkItem, batch: Batch) -> None:
        encoded: Encoded | None = None
        error: BaseException | None = None
        if batch.job is not None:
            try:
                try:
                    encoded = encode(item, batch, plain=False)
                except Exception as raised:
                    error = blame_items(item, batch, raised)
            except BaseException as raised:  # whatever the user's pickler raises is its own
                error = raised
        self._loop.call_soon(self._encoded, item, batch, encoded, error)

    def _encoded(
        self, item: WorkItem, batch: Batch, encoded: Encoded | None, error: BaseException | None
    ) -> None:
        if self._ledger.batches.get(batch.seq) is not batch:
            return  # its worker is gone
        if batch.job is None:  # cancelled
            self.reassign(batch)
        elif encoded is not None:
            self._deliver(item, batch, encoded)
        elif error is not None:
            self._unsendable(batch, error)
        self._advance()

    def _deliver(self, item: WorkItem, batch: Batch, encoded: Encoded) -> None:
        handle: WorkerHandle = batch.worker.key
        assert handle.child is not None
        seq = batch.seq
        if item.timeout is not None:
            self._limits.begin(seq, item.timeout)
        try:
            taken = handle.child.deliver(seq, *pack(item, batch, encoded, handle.known))
        except Exception as error:  # the system has no memory or descriptor for it
            self._unsendable(batch, error)
            return
        if taken:
            self._unsent.discard(seq)
        else:
            self._unsent.add(seq)  # its worker is gone, as will be heard

    def _unsendable(self, batch: Batch, error: BaseException) -> None:
        """Fail the tasks of a batch that cannot be sent, and no others."""
        self._unsent.discard(batch.seq)
        self.settled(batch.seq)
        self.split(batch.seq, Failure(error))
        self._advance()

    def _drop_cancelled(self, batch: Batch, job: Job) -> None:
        """Give the others to whoever has time for them."""
        self._ledger.put_back(batch.worker, (batch.seq,), self._loop.now())
        self._ledger.drop_waiting(job, is_wanted)
        self._jobs.check_finished(job)
        self._advance()

    def split(self, seq: int, failure: object) -> None:
        """Send the tasks of a batch one by one; of a single one, ``failure`` is the outcome."""
        receipt = self._ledger.split(seq, self._loop.now())
        if receipt is not None:
            self._jobs.put(receipt, [failure])

    def dropped(self, batch: Batch) -> None:
        """Note a batch that its worker gave back unread.  ``reassign`` it soon."""
        self._unsent.add(batch.seq)

    def reassign(self, batch: Batch) -> None:
        """Give it to whoever has time for it, if it is still wanted."""
        self._unsent.discard(batch.seq)
        self._ledger.put_back(batch.worker, (batch.seq,), self._loop.now())

    def lost(self, worker: Worker) -> set[int]:
        """A worker is gone; those of its batches that were not sent."""
        held = {batch.seq for batch in worker.queue}
        for seq in held:
            self.settled(seq)
        unsent = self._unsent & held
        self._unsent -= held
        return unsent

    def settled(self, seq: int) -> None:
        """End the time limit of a batch, if it has one: its outcome is known."""
        self._limits.settled(seq)
