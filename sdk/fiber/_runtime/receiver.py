"""From a packet of a worker to the outcomes of tasks.

Runs on the loop thread.  ``_unpickle_fault`` is the exception: it may run the user's code, and so
runs on the background thread.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from fiber._engine.scheduler import Scheduler
from fiber._engine.tasks import Batch, WrongAnswer
from fiber._runtime.answers import Pickled, Words, read
from fiber._runtime.background import BackgroundThread, say
from fiber._runtime.jobs import Jobs
from fiber._runtime.leases import LeasedWorker, Leases
from fiber._runtime.sender import BatchSender
from fiber._runtime.work_items import WorkItem
from fiber._runtime.workers import WorkerHandle
from fiber._transport.loop import Loop
from fiber._wire import work
from fiber._wire.packet import Message

_NOT_READY = "it answered for batch {} before it was ready"


class AnswerReceiver:
    """Takes the packets of workers.

    ``advance`` is called when the scheduler has to decide again, ``on_ready`` with each worker that
    is ready for tasks.
    """

    def __init__(
        self,
        loop: Loop,
        background: BackgroundThread,
        scheduler: Scheduler,
        jobs: Jobs,
        sender: BatchSender,
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

    def take(self, handle: WorkerHandle, message: Message) -> None:
        """Take a packet from a worker."""
        try:
            if not handle.fault:  # else it was killed for an earlier one
                self._take(handle, read(message))
        except WrongAnswer as error:
            self._convict(handle, str(error))
        finally:
            message.release()

    def _take(self, handle: WorkerHandle, words: Words) -> None:
        if type(words[0]) is int:
            if not self._leases.keep_answer(handle, words):
                self._answered(handle, words)
        elif words[0] == work.READY:
            self._on_ready(handle)
        elif words[0] == work.INIT_FAILED:
            handle.complain(words[1])
        elif words[0] == work.UNKNOWN:
            batch = self._held(handle, words[1])
            if batch is not None and batch.has_function:
                raise WrongAnswer(f"it did not know the function that came with batch {batch.seq}")
            self.recalled(handle, [words[1]])
        else:
            kind, seq, error = words
            batch = self._held(handle, seq)
            if batch is not None:
                self._unreadable(kind, batch, Pickled(work.ERROR, error, ()))

    def _held(self, handle: WorkerHandle, seq: int) -> Batch | None:
        """Return the batch that a worker answers for, or None if the batch is over."""
        if handle.worker is None:
            raise WrongAnswer(_NOT_READY.format(seq))
        return self._ledger.held(handle.worker, seq)

    def _convict(self, handle: WorkerHandle, reason: str) -> None:
        """Kill a worker that sent a wrong answer; its tasks run elsewhere once it is gone."""
        if handle.worker is not None:
            self._ledger.retire(handle.worker)
        handle.convict(reason)
        with contextlib.suppress(RuntimeError):  # the system has no room for its thread
            self._background.submit(say, f"pool worker {handle.name!r} is killed: {reason}")
        self._advance()

    def replay(self, worker: LeasedWorker) -> None:
        """Take what a leased worker sent: the call of its caller is a task of the ledger now."""
        if worker.answer is not None:
            try:
                self._answered(worker.handle, worker.answer)
            except WrongAnswer as error:
                self._convict(worker.handle, str(error))
        if worker.unread:
            self.recalled(worker.handle, worker.unread)

    def _answered(self, handle: WorkerHandle, results: Words) -> None:
        seq, offset, kept, seconds, values, mixed, size = results
        if handle.worker is None:
            raise WrongAnswer(_NOT_READY.format(seq))
        receipt = self._ledger.receive(
            handle.worker, seq, offset, len(values), self._loop.now(), seconds=seconds, kept=kept
        )
        handle.did(len(values))
        self._scheduler.workers.did_something()
        self._sender.settled(seq)
        if receipt is not None:
            item: WorkItem = receipt.job.owner
            if item.future is None and receipt.size and receipt.item(receipt.start).blocking:
                # Before the outcome is set: the caller that waits for it may call again at once.
                self._leases.offer(receipt.batch.worker.key)
            self._jobs.put(receipt, values, mixed=mixed, size=size)
        self._advance()

    def _unreadable(self, kind: str, batch: Batch, error: Pickled) -> None:
        """Handle a batch that its worker cannot unpickle.

        If the function does not unpickle, no task of the job can run.
        """
        self._sender.settled(batch.seq)
        if kind == work.UNREADABLE:
            self._sender.split(batch.seq, error)
        else:
            self._sender.dropped(batch)
            try:
                self._background.submit(self._unpickle_fault, batch, error)
            except RuntimeError as refused:  # the system has no room for its thread
                self._unusable(batch, refused)
        self._advance()

    def _unpickle_fault(self, batch: Batch, error: Pickled) -> None:
        """Unpickle the error of a function on the background thread, as it runs the user's code."""
        try:
            fault = error.decode().error
        except BaseException as raised:  # the user's unpickler may raise anything
            fault = raised
        self._loop.call_soon(self._unusable, batch, fault)

    def _unusable(self, batch: Batch, error: BaseException) -> None:
        """Fail the job of a batch whose function its worker cannot unpickle."""
        if self._ledger.batches.get(batch.seq) is not batch:
            return  # its worker is gone
        if batch.job is not None:
            self._jobs.fail(batch.job, error)
        self._sender.reassign(batch)
        self._advance()

    def recalled(self, handle: WorkerHandle, seqs: list[int]) -> None:
        """Have the tasks of batches wait again that the worker will never read."""
        if handle.worker is None:
            return
        if 0 in seqs:  # the recall has taken back the request to end: it is sent again
            handle.dismiss()
        self._leases.keep_unread(handle, seqs)
        self._sender.unread(handle.worker, seqs)
        self._advance()
