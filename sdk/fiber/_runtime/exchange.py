"""Exchange with workers: batches that are encoded and sent, and the answers that come back.

Runs on the loop thread.  Two methods are the exceptions, since they may run the user's code:
``BatchSender._encode`` and ``AnswerReceiver._unpickle_fault`` run on the background thread.
"""

from __future__ import annotations

import contextlib
import pickle
import time
from collections.abc import Callable
from itertools import chain

from fiber import reduction
from fiber._engine.scheduler import Scheduler
from fiber._engine.tasks import Batch, Job, WorkerEntry, WrongAnswer
from fiber._runtime.answers import MessageFields, Pickled, TaskFailure, read
from fiber._runtime.jobs import Jobs
from fiber._runtime.leases import LeasedWorker, Leases
from fiber._runtime.pool_activity import PoolActivity
from fiber._runtime.threads import BackgroundThread, say
from fiber._runtime.work_items import Call, WorkItem, is_wanted
from fiber._runtime.workers import WorkerHandle
from fiber._transport.loop import Loop, LoopTimer
from fiber._wire import work
from fiber._wire.packet import Message

STACK_PATIENCE = 1.0
"""Seconds that the end of a worker may take before its task fails without the stacks."""

Encoded = work.Pickle
"""Pickled items, and the buffers beside them."""


_NOT_READY = "it answered for batch {} before it was ready"


class BatchSender:
    """Sends batches.  Owns the set of unsent batches, and the functions that each worker has.

    ``advance`` is called when the scheduler has to decide again.
    """

    def __init__(
        self,
        loop: Loop,
        background: BackgroundThread,
        scheduler: Scheduler,
        jobs: Jobs,
        activity: PoolActivity,
        *,
        advance: Callable[[], None],
    ) -> None:
        self._loop = loop
        self._background = background
        self._activity = activity
        self._ledger = scheduler.ledger
        self._jobs = jobs
        self._advance = advance
        self._limits = TimeLimits(loop, scheduler, jobs, advance=advance)
        self._unsent: set[int] = set()
        """Batches that were not sent: no worker can have run them."""
        self._functions: dict[WorkerEntry, dict[int, None]] = {}
        """Functions that each worker was sent, and so remembers."""

    def send(self, batch: Batch) -> None:
        """Send a batch.  If encoding may run the user's code, the background thread encodes it."""
        assert batch.job is not None
        item: WorkItem = batch.job.owner
        if item.cancellable and not _claim(batch):
            self._drop_cancelled(batch, batch.job)
            return
        if not _pickles_without_user_code(item, batch):
            self._unsent.add(batch.seq)
            try:
                self._background.submit(self._encode, item, batch)
            except RuntimeError as error:  # the system has no room for its thread
                self._unsendable(batch, error)
            return
        began = time.perf_counter()
        try:
            encoded = _encode(item, batch, plain=True)
        except Exception as error:  # no memory
            self._unsendable(batch, error)
        else:
            self._deliver(item, batch, encoded, time.perf_counter() - began)

    def _encode(self, item: WorkItem, batch: Batch) -> None:
        encoded: Encoded | None = None
        error: BaseException | None = None
        began = time.perf_counter()
        if batch.job is not None:
            try:
                try:
                    encoded = _encode(item, batch, plain=False)
                except Exception as raised:
                    error = _blame_items(item, batch, raised)
            except BaseException as raised:  # the user's pickler may raise anything
                error = raised
        seconds = time.perf_counter() - began
        self._loop.call_soon(self._encoded, item, batch, encoded, error, seconds)

    def _encoded(
        self,
        item: WorkItem,
        batch: Batch,
        encoded: Encoded | None,
        error: BaseException | None,
        seconds: float,
    ) -> None:
        if self._ledger.batches.get(batch.seq) is not batch:
            return  # its worker is gone
        if batch.job is None:  # cancelled
            self.reassign(batch)
        elif encoded is not None:
            self._deliver(item, batch, encoded, seconds)
        elif error is not None:
            self._unsendable(batch, error)
        self._advance()

    def _deliver(self, item: WorkItem, batch: Batch, encoded: Encoded, pickling: float) -> None:
        handle: WorkerHandle = batch.worker.key
        assert handle.child is not None
        seq = batch.seq
        if item.timeout is not None:
            self._limits.begin(seq, item.timeout)
        sent = self._functions.setdefault(batch.worker, {})
        try:
            data, buffers = _pack(item, batch, encoded, sent)
            self._activity.sent(pickling, data, buffers)
            taken = handle.child.deliver(seq, data, buffers)
        except Exception as error:  # the system has no memory or descriptor for it
            self._unsendable(batch, error)
            return
        if taken:
            self._unsent.discard(seq)
        else:
            self._unsent.add(seq)  # its worker is gone, as the agent will report

    def _unsendable(self, batch: Batch, error: BaseException) -> None:
        """Fail the tasks of a batch that cannot be sent, and no others."""
        self._unsent.discard(batch.seq)
        self.settled(batch.seq)
        self.split(batch.seq, TaskFailure(error))
        self._advance()

    def _drop_cancelled(self, batch: Batch, job: Job) -> None:
        """Drop the cancelled calls of a batch; the others wait again."""
        self._ledger.put_back(batch.worker, (batch.seq,), self._loop.now())
        self._ledger.drop_waiting(job, is_wanted)
        self._jobs.check_finished(job)
        self._advance()

    # What becomes of a batch that was sent

    def settled(self, seq: int) -> None:
        """End the time limit of a batch, if it has one: its outcome is known."""
        self._limits.settled(seq)

    def split(self, seq: int, failure: object) -> None:
        """Send the tasks of a batch again, one by one; a single task fails with ``failure``."""
        receipt = self._ledger.split(seq, self._loop.now())
        if receipt is not None:
            self._jobs.put(receipt, [failure])

    def dropped(self, batch: Batch) -> None:
        """Note a batch that its worker gave back unread.  ``reassign`` it soon."""
        self._unsent.add(batch.seq)

    def reassign(self, batch: Batch) -> None:
        """Have the tasks of a batch wait again."""
        self._unsent.discard(batch.seq)
        self._ledger.put_back(batch.worker, (batch.seq,), self._loop.now())

    def unread(self, worker: WorkerEntry, seqs: list[int]) -> None:
        """Queue the tasks of these batches again: the worker will never read the batches."""
        for seq in seqs:
            batch = self._ledger.batches.get(seq)
            if batch is None or batch.worker is not worker:
                continue
            self.settled(seq)
            function = batch.job.owner.function if batch.job is not None else None
            if function is not None:
                self._functions.get(worker, {}).pop(function.id, None)
        self._ledger.put_back(worker, seqs, self._loop.now())

    # Ends

    def exited(self, handle: WorkerHandle, stack: str) -> None:
        """Fail the task whose time limit ended this worker; ``stack`` has the worker's stacks."""
        self._limits.exited(handle, stack)

    def lost(self, worker: WorkerEntry) -> set[int]:
        """Forget the batches of a worker that is gone; return those that were not sent."""
        self._functions.pop(worker, None)
        held = {batch.seq for batch in worker.queue}
        for seq in held:
            self.settled(seq)
        unsent = self._unsent & held
        self._unsent -= held
        return unsent

    def close(self) -> None:
        """Stop all timers."""
        self._limits.close()


class TimeLimits:
    """Time limits of batches: kill the worker of a task that takes too long.

    ``advance`` is called when the scheduler has to decide again.
    """

    def __init__(
        self, loop: Loop, scheduler: Scheduler, jobs: Jobs, *, advance: Callable[[], None]
    ) -> None:
        self._loop = loop
        self._scheduler = scheduler
        self._ledger = scheduler.ledger
        self._jobs = jobs
        self._advance = advance
        self._timers: dict[int, LoopTimer] = {}
        self._ending: dict[WorkerHandle, tuple[int, LoopTimer]] = {}
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

    def exited(self, handle: WorkerHandle, stack: str) -> None:
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
        self._ending[handle] = (
            seq,
            self._loop.call_later(STACK_PATIENCE, self._stacks_overdue, handle),
        )
        handle.kill_with_stack()
        self._advance()

    def _stacks_overdue(self, handle: WorkerHandle) -> None:
        """Fail the task without stacks: the worker's host is slow, or does not answer."""
        self.exited(handle, "")
        handle.kill()
        self._advance()


# Encoding


def _claim(batch: Batch) -> bool:
    """Claim all calls of a batch; return False if one was cancelled."""
    return all(call.future.claim() for call in batch.items)


def _blame_items(item: WorkItem, batch: Batch, error: Exception) -> Exception:
    """Return the error of tasks that cannot be sent."""
    if len(batch.items) != 1 or item.function is None:
        return error
    name = item.task_name(batch.start, batch.items[0])
    return reduction.blame({f"the item of {name}": batch.items[0]}, error)


def _pickles_without_user_code(item: WorkItem, batch: Batch) -> bool:
    """Tell whether ``_encode`` runs none of the user's code for this batch."""
    items = batch.items
    return item.kind == work.CALLS or type(items) in (range, str, bytes) or work.is_plain(items)


def _encode(item: WorkItem, batch: Batch, *, plain: bool) -> Encoded:
    """Encode the items of a batch; ``plain`` says that this runs none of the user's code."""
    if item.kind == work.CALLS:
        calls: list[Call] = list(batch.items)
        if len(calls) == 1:
            return calls[0].message(), calls[0].buffers
        buffers = list(chain.from_iterable(call.buffers for call in calls))
        return work.pack_calls([(call.data, call.buffers) for call in calls]), buffers
    if plain:
        return work.move_beside((pickle.dumps(batch.items, 5), []))
    items = tuple(batch.items) if type(batch.items) is list else batch.items
    data, buffers, grants = reduction.encode_reusable(items)
    if grants is not None:
        item.grants.append(grants)
    if len(buffers) > work.BUFFERS:
        data, buffers = reduction.dumps(batch.items, 5), []
    return work.move_beside((data, buffers))


def _pack(item: WorkItem, batch: Batch, encoded: Encoded, sent: dict[int, None]) -> Encoded:
    """Return the whole message for a batch; ``sent`` are the functions that its worker has."""
    data, buffers = encoded
    function = item.function
    if function is None:
        return encoded
    carry = function.id not in sent
    head = work.Head(
        item.kind,
        0 if item.eager else batch.stride,
        item.unit,
        function.id,
        (len(function.data) or work.BESIDE) if carry else 0,
        len(function.buffers) if carry else 0,
    )
    batch.has_function = carry
    if not carry:
        return work.pack_batch(head, b"", data), buffers
    sent[function.id] = None
    return work.pack_batch(head, function.data, data), [*function.buffers, *buffers]


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
        activity: PoolActivity,
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
        self._activity = activity
        self._advance = advance
        self._on_ready = on_ready

    def take(self, handle: WorkerHandle, message: Message) -> None:
        """Take a packet from a worker."""
        try:
            if not handle.fault:  # else it is being killed for an earlier message
                self._take(handle, read(message))
        except WrongAnswer as error:
            self._kill(handle, str(error))
        finally:
            message.release()

    def _take(self, handle: WorkerHandle, fields: MessageFields) -> None:
        if type(fields[0]) is int:
            if handle.worker is not None and handle.worker.leased:
                self._leases.keep_answer(handle, fields)
            else:
                self._answered(handle, fields)
        elif fields[0] == work.READY:
            self._on_ready(handle)
        elif fields[0] == work.INIT_FAILED:
            handle.note_init_error(*fields[1:])
        elif fields[0] == work.UNKNOWN:
            batch = self._held(handle, fields[1])
            if batch is not None and batch.has_function:
                raise WrongAnswer(f"it did not know the function that came with batch {batch.seq}")
            self.recalled(handle, [fields[1]])
        else:
            kind, seq, error = fields
            batch = self._held(handle, seq)
            if batch is not None:
                self._unreadable(kind, batch, Pickled(work.ERROR, error, ()))

    def _held(self, handle: WorkerHandle, seq: int) -> Batch | None:
        """Return the batch that a worker answers for, or None if the batch is over."""
        if handle.worker is None:
            raise WrongAnswer(_NOT_READY.format(seq))
        return self._ledger.held(handle.worker, seq)

    def _kill(self, handle: WorkerHandle, reason: str) -> None:
        """Kill a worker that sent a wrong answer; its tasks run elsewhere once it is gone."""
        if handle.worker is not None:
            self._ledger.retire(handle.worker)
        handle.kill_for(reason)
        with contextlib.suppress(RuntimeError):  # the system has no room for its thread
            self._background.submit(say, f"pool worker {handle.name!r} is killed: {reason}")
        self._advance()

    def replay(self, worker: LeasedWorker) -> None:
        """Take what a leased worker sent: the call of its caller is a task of the ledger now."""
        if worker.answer is not None:
            try:
                self._answered(worker.handle, worker.answer)
            except WrongAnswer as error:
                self._kill(worker.handle, str(error))
        if worker.unread:
            self.recalled(worker.handle, worker.unread)

    def _answered(self, handle: WorkerHandle, results: MessageFields) -> None:
        seq, offset, kept, seconds, values, mixed, size = results
        if handle.worker is None:
            raise WrongAnswer(_NOT_READY.format(seq))
        since = handle.worker.since
        receipt = self._ledger.receive(
            handle.worker, seq, offset, len(values), self._loop.now(), seconds=seconds, kept=kept
        )
        handle.did(len(values))
        self._activity.answered(handle, since, receipt, (seconds, values, mixed, size))
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
        """Queue the tasks of these batches again: the worker will never read the batches."""
        if handle.worker is None:
            return
        if 0 in seqs:  # 0 numbers the request to end: the recall took it back, so send it again
            handle.dismiss()
        if handle.worker.leased:
            self._leases.keep_unread(handle, seqs)
        self._sender.unread(handle.worker, seqs)
        self._advance()
