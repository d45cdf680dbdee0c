"""From a packet of a worker to the outcomes of tasks.

On the loop's thread, but for ``_unpickle_fault``, which may run the user's code.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

from fiber._engine.ledger import Batch
from fiber._engine.scheduler import Scheduler
from fiber._runtime.background import BackgroundThread
from fiber._runtime.host import Loop
from fiber._runtime.jobs import Jobs
from fiber._runtime.leases import Leases
from fiber._runtime.outcome import Pickled, outcomes
from fiber._runtime.sender import Sender
from fiber._runtime.work_items import WorkItem
from fiber._runtime.worker_handle import WorkerHandle
from fiber._wire import work
from fiber._wire.packet import Message


class Receiver:
    """Takes what workers say.  ``advance`` is called when something follows, ``on_ready`` with a
    worker that is ready for work."""

    def __init__(
        self,
        loop: Loop,
        background: BackgroundThread,
        scheduler: Scheduler,
        jobs: Jobs,
        sender: Sender,
        leases: Leases,
        *,
        advance: Callable[[], None],
        on_ready: Callable[[WorkerHandle], None],
    ) -> None:
        self._loop = loop
        self._background = background
        self._scheduler = scheduler
        self._ledger = scheduler.ledger
        self._jobs = jobs
        self._sender = sender
        self._leases = leases
        self._advance = advance
        self._on_ready = on_ready
        self._last_words: dict[WorkerHandle, tuple[Any, list[memoryview], int]] = {}
        """Of workers that callers use, whose agents heard them first since they died."""
        self._taken_back: dict[WorkerHandle, list[int]] = {}
        """From workers that callers use: calls of theirs, which are no batches yet."""

    def take(self, handle: WorkerHandle, message: Message) -> None:
        """A packet from a worker."""
        words = pickle.loads(message.payload)
        buffers = message.buffers
        size = len(message.payload) + sum([buffer.nbytes for buffer in buffers])
        message.release()
        kind = words[0]
        if type(kind) is int and handle.worker is not None and handle.worker.lent:
            self._last_words[handle] = words, buffers, size
        elif type(kind) is int:
            self._answered(handle, words, buffers, size)
        elif kind == work.READY:
            self._on_ready(handle)
        elif kind == work.INIT_FAILED:
            handle.complaint = words[1]
        elif kind == work.UNKNOWN:
            self.recalled(handle, [words[1]])
        else:
            self._unreadable(kind, words[1], Pickled(work.ERROR, words[2], ()))

    def replay(self, handle: WorkerHandle) -> None:
        """A worker is not lent any more: what was heard of it meanwhile counts now."""
        if handle in self._last_words:
            self._answered(handle, *self._last_words.pop(handle))
        if handle in self._taken_back:
            self.recalled(handle, self._taken_back.pop(handle))

    def forget(self, handle: WorkerHandle) -> None:
        """What was heard of it meanwhile is of no use."""
        self._last_words.pop(handle, None)
        self._taken_back.pop(handle, None)

    def _answered(
        self, handle: WorkerHandle, words: tuple[Any, ...], buffers: list[memoryview], size: int
    ) -> None:
        seq, offset, kept, seconds, values, odd = words
        handle.tasks += len(values)
        results = outcomes(values, odd, buffers) if odd else values
        receipt = self._ledger.receive(
            seq, offset, len(results), self._loop.now(), seconds=seconds, kept=kept
        )
        self._scheduler.workers.did_something()
        self._sender.settled(seq)
        if receipt is not None:
            item: WorkItem = receipt.job.owner
            if item.future is None and receipt.size and receipt.item(receipt.start).blocking:
                # First: who waited for it may call again at once.
                self._leases.offer(receipt.batch.worker.key)
            self._jobs.put(receipt, results, mixed=bool(odd), size=size)
        self._advance()

    def _unreadable(self, kind: str, seq: int, error: Pickled) -> None:
        """A worker cannot unpickle a batch, or its function: then no task of its job can run."""
        batch = self._ledger.batches.get(seq)
        self._sender.settled(seq)
        if kind == work.UNREADABLE:
            self._sender.split(seq, error)
        elif batch is not None:
            self._sender.dropped(batch)
            try:
                self._background.submit(self._unpickle_fault, batch, error)
            except RuntimeError as refused:  # the system has no room for its thread
                self._unusable(batch, refused)
        self._advance()

    def _unpickle_fault(self, batch: Batch, error: Pickled) -> None:
        """On the background thread: whatever a worker found with a function is the user's."""
        try:
            fault = error.decode().error
        except BaseException as raised:  # what its unpickling raises may be anything
            fault = raised
        self._loop.call_soon(self._unusable, batch, fault)

    def _unusable(self, batch: Batch, error: BaseException) -> None:
        """A worker cannot unpickle the function of a batch, and has dropped it."""
        if self._ledger.batches.get(batch.seq) is not batch:
            return  # its worker is gone
        if batch.job is not None:
            self._jobs.fail(batch.job, error)
        self._sender.reassign(batch)
        self._advance()

    def recalled(self, handle: WorkerHandle, seqs: list[int]) -> None:
        """A worker will never see these batches."""
        if handle.worker is None:
            return
        if 0 in seqs:  # no batch, but what told it to end: the recall was later by an agent's turn
            handle.dismiss()
        if seqs and handle.worker.lent:  # a recall that was on its way as it was lent took them
            self._taken_back.setdefault(handle, []).extend(seqs)
        for seq in seqs:
            self._sender.settled(seq)
            batch = self._ledger.batches.get(seq)
            if batch is not None and batch.job is not None:
                function = batch.job.owner.function
                if function is not None:
                    handle.known.pop(function.id, None)
        self._ledger.put_back(handle.worker, seqs, self._loop.now())
        self._advance()
