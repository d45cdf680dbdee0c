"""Calls that a waiting thread sends to a worker itself, past the loop.

An ``apply`` through the loop would wake two threads that only pass it on.  So an idle worker is
leased: the next caller takes the lease, sends the worker its call, waits for the answer and puts
the lease back.  Ray's callers lease workers in the same way.  A call for another host still passes
the loop, which has its link, but no scheduler.  ::

    loop thread                    any thread                         worker
    offer ──► idle leases ──pop──► run ─────────── send, receive ───► │
                  ▲                 ├── answered: append ──┘
    recall ◄──────┘                 ├── takes longer, or its worker is gone: adopt
                                    └── interrupted: abandon

A lease belongs to the thread that popped it, and threads share nothing else.  So an interruption at
any line leaves at most a lease that no thread returns.  Its weak reference reports that in one
atomic step, and the loop takes the worker back.
"""

from __future__ import annotations

import pickle
import weakref
from collections import deque
from collections.abc import Callable
from typing import Any

from fiber._agent.interface import DirectChannel, ExitReport
from fiber._engine.activity import FUNCTIONS, OTHER_FUNCTIONS, WorkReport
from fiber._engine.scheduler import Scheduler
from fiber._engine.tasks import WrongAnswer
from fiber._runtime.answers import OTHER, MessageFields, is_failure, read, single
from fiber._runtime.pool_activity import PoolActivity
from fiber._runtime.work_items import Call
from fiber._runtime.workers import WorkerHandle
from fiber._transport.loop import Loop, LoopTimer
from fiber._wire import work
from fiber._wire.packet import Message

ATTENTION = 5e-3
"""Seconds that a caller waits for a worker itself before it leaves the answer to the loop."""

UNUSED = 0.05
"""Seconds without a call after which a lease ends: its worker may leave, or get other tasks."""

NO_OP_MESSAGE = work.pack_calls([(pickle.dumps((bool, (), {})), ())])
"""Call that does nothing.  Its answer says that all calls before it are answered."""


class NoOutcome:
    """Mark in place of an outcome that has not come."""


UNAVAILABLE = NoOutcome()
"""No worker was available."""

ADOPTED = NoOutcome()
"""The loop has taken over, and sets the outcome of the call's future."""


class CallCounts:
    """Calls of one function that a leased worker answered.

    Only the caller writes to ``calls``, ``failed`` and ``seconds``, and the loop reads them.
    """

    __slots__ = ("calls", "failed", "noted", "seconds")

    def __init__(self) -> None:
        self.calls = self.failed = 0
        self.seconds = 0.0
        """Seconds of work for these calls."""
        self.noted = (0, 0, 0.0)
        """``calls``, ``failed`` and ``seconds`` at the last note."""

    def since_note(self) -> tuple[int, int, float]:
        """Return the calls, failed calls and seconds since the last note, and note them."""
        if self.calls == self.noted[0]:  # the caller counts a call at this moment, at most
            return 0, 0, 0.0
        before, self.noted = self.noted, (self.calls, self.failed, self.seconds)
        calls, failed, seconds = self.noted
        return calls - before[0], failed - before[1], seconds - before[2]


class LeasedWorker:
    """Record of a leased worker while a caller uses it.  Only ``Leases`` changes it."""

    __slots__ = (
        "_functions",
        "_noted",
        "answer",
        "draining",
        "handle",
        "report",
        "seq",
        "unread",
    )

    def __init__(self, handle: WorkerHandle, now: float) -> None:
        self.handle = handle
        self._functions: dict[str, CallCounts] = {}
        """Calls that it answered, by their function.  The caller adds functions."""
        self._noted = now
        """Time of the last note of its work."""
        self.seq = 0
        """Number of the last call that a caller sent it."""
        self.answer: MessageFields | None = None
        """Last packet of a worker that died, received by the agent and not by the caller."""
        self.unread: list[int] = []
        """Calls that the worker gave back, before they are batches of the ledger."""
        self.report: ExitReport | None = None
        """End of the worker."""
        self.draining = False
        """True if the worker's host is about to end."""

    def did(self, function: str, seconds: float, failed: bool) -> None:
        """Count a call that it has answered.  Runs on the caller's thread."""
        self.handle.did(1)
        counts = self._functions.get(function)
        if counts is None:
            name = function if len(self._functions) < FUNCTIONS else OTHER_FUNCTIONS
            counts = self._functions.setdefault(name, CallCounts())
        counts.seconds += seconds
        counts.failed += failed
        counts.calls += 1

    def take_work(self, now: float) -> list[WorkReport]:
        """Return the work since the last note, a report for each function, and note it.

        The calls of several functions may have been in any order.  Their reports follow each
        other, and each has a share of the time as it has of the work.
        """
        taken = [(name, *counts.since_note()) for name, counts in list(self._functions.items())]
        taken = [each for each in taken if each[1]]
        if not taken:
            return []
        work = sum(seconds for *_, seconds in taken)
        begin = max(self._noted, min(now - work, now - UNUSED))
        length, self._noted = now - begin, now
        reports = []
        for name, calls, failed, seconds in taken:
            end = begin + length * (seconds / work if work else 1 / len(taken))
            reports.append(WorkReport(name, begin, end, seconds, calls, failed, calls))
            begin = end
        return reports


class Lease:
    """Right of one thread at a time to send a worker calls."""

    __slots__ = ("__weakref__", "channel", "unexpected", "used", "worker")

    def __init__(self, worker: LeasedWorker, channel: DirectChannel) -> None:
        self.worker = worker
        self.channel = channel
        self.used = True
        """True if a caller used it since the last look."""
        self.unexpected: Message | None = None
        """Message of its worker that is not the answer; the loop judges it."""


class Leases:
    """Leases of one pool's workers, and what happens to leased workers.

    ``on_adopted`` is called with a call that its caller leaves to the loop, ``on_back`` with each
    worker that is back.  Both run on the loop thread.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        loop: Loop,
        activity: PoolActivity,
        *,
        on_adopted: Callable[[LeasedWorker, Call], None],
        on_back: Callable[[LeasedWorker], None],
    ) -> None:
        self._scheduler = scheduler
        self._activity = activity
        self._batches = scheduler.ledger.batches
        self._loop = loop
        self._on_adopted = on_adopted
        self._on_back = on_back
        self._check: LoopTimer | None = None
        self._idle: deque[Lease] = deque()
        self._leases: dict[weakref.ref[Lease], LeasedWorker] = {}
        self._workers: dict[WorkerHandle, LeasedWorker] = {}
        self._dropped: deque[weakref.ref[Lease]] = deque()
        self._recalled = False

    # Any thread

    def run(self, call: Call) -> Any:
        """Return the outcome of a call; UNAVAILABLE if unsent, ADOPTED if the loop takes over."""
        try:
            lease = self._idle.pop()
        except IndexError:
            return UNAVAILABLE
        lease.used = True
        try:
            answer = self._exchange(lease, call)
            if answer is ADOPTED:
                self._loop.call_soon(self._adopt, lease, call)
                return ADOPTED
        except BaseException:
            self._loop.call_soon(self._abandon, lease)
            raise
        self._put_back(lease)
        return answer

    def _exchange(self, lease: Lease, call: Call) -> Any:
        channel = lease.channel
        lease.worker.seq = seq = self._scheduler.ledger.next_seq()
        try:
            channel.send(seq, call.message(), call.buffers)
        except OSError:  # the loop sends it instead, and reports what is wrong
            return UNAVAILABLE
        while True:
            try:
                message = channel.receive(ATTENTION)
            except BrokenPipeError:  # the worker was gone before the call was sent
                return UNAVAILABLE
            except (EOFError, OSError, MemoryError):  # it is gone, as its agent will report
                return ADOPTED
            if message is None:
                return ADOPTED
            result, seconds = single(message, seq)
            if result is OTHER and not self._is_late(message, seq):
                lease.unexpected = message
                return ADOPTED
            message.release()
            if result is not OTHER:
                lease.worker.did(call.name, seconds, is_failure(result))
                return result

    def _is_late(self, message: Message, seq: int) -> bool:
        """Return whether ``message`` answers a call before ``seq``, which was given up."""
        try:
            number = read(message)[0]
        except WrongAnswer:
            return False
        return type(number) is int and number < seq and number not in self._batches

    def _put_back(self, lease: Lease) -> None:
        self._idle.append(lease)
        # The loop sets the mark first and takes the idle leases then.
        if self._recalled:
            self._loop.call_soon(self.recall)

    # The loop thread

    def offer(self, handle: WorkerHandle) -> None:
        """Lease a worker that has become idle, unless waiting tasks need it."""
        if handle.worker is None or handle.child is None:
            return
        if not self._scheduler.lease(handle.worker):
            return
        channel = handle.child.lease_channel()
        if channel is None:
            self._scheduler.return_idle(handle.worker, self._loop.now())
            return
        self._workers[handle] = worker = LeasedWorker(handle, self._loop.now())
        lease = Lease(worker, channel)
        self._leases[weakref.ref(lease, self._dropped.append)] = worker
        self._recalled = False
        self._idle.append(lease)
        if self._check is None:
            self._activity.notes_of(self)
            self._check = self._loop.call_later(UNUSED, self._recall_unused)

    def recall(self) -> None:
        """End the idle leases, and the others as soon as their callers put them back."""
        self._recalled = True
        while self._idle:
            try:
                lease = self._idle.pop()
            except IndexError:  # a caller was faster, and will put it back
                break
            self._return_idle(lease)
        self._find_dropped()

    def _recall_one(self, handle: WorkerHandle) -> bool:
        """End the lease of this worker; False if a caller uses it, and will put it back."""
        for lease in list(self._idle):
            if lease.worker.handle is handle:
                try:
                    self._idle.remove(lease)
                except ValueError:  # a caller was faster
                    return False
                self._return_idle(lease)
                return True
        return False

    def close(self) -> None:
        """Cancel the timer: the last worker has ended."""
        if self._check is not None:
            self._check.cancel()

    # What happens to a worker while a caller uses it counts once the worker is back

    def keep_answer(self, handle: WorkerHandle, fields: MessageFields) -> None:
        """Keep an answer of a leased worker until the worker is back."""
        self._workers[handle].answer = fields

    def keep_unread(self, handle: WorkerHandle, seqs: list[int]) -> None:
        """Keep calls that a leased worker gave back: a recall from before the lease took them."""
        self._workers[handle].unread.extend(seqs)

    def keep_exit(self, handle: WorkerHandle, report: ExitReport) -> bool:
        """Keep the end of a worker until its caller notices; False if no caller uses it."""
        worker = self._leased(handle)
        if worker is None or self._recall_one(handle):
            return False
        worker.report = report
        return True

    def keep_draining(self, handle: WorkerHandle) -> bool:
        """Note that the worker's host is about to end; False if no caller uses the worker."""
        worker = self._leased(handle)
        if worker is None or self._recall_one(handle):
            return False
        worker.draining = True
        return True

    def _leased(self, handle: WorkerHandle) -> LeasedWorker | None:
        leased = handle.worker is not None and handle.worker.leased
        return self._workers.get(handle) if leased else None

    # Ends of leases

    def _recall_unused(self) -> None:
        """End the leases that no caller used since this was called last."""
        self._check = None
        self.note_work()
        for lease in list(self._idle):
            if not lease.used:
                self._recall_one(lease.worker.handle)
            lease.used = False
        self._find_dropped()
        if self._leases:
            self._check = self._loop.call_later(UNUSED, self._recall_unused)

    def _return_idle(self, lease: Lease) -> None:
        self._end(lease)
        handle = lease.worker.handle
        if handle.worker is not None:
            self._scheduler.return_idle(handle.worker, self._loop.now())
        self._back(lease.worker)

    def _adopt(self, lease: Lease, call: Call) -> None:
        worker = lease.worker
        # First the task that the answer belongs to: the answer may be there already.
        self._on_adopted(worker, call)
        self._end(lease)
        if lease.unexpected is not None:
            worker.handle.received(lease.unexpected)
        self._back(worker)

    def _abandon(self, lease: Lease) -> None:
        if weakref.ref(lease) in self._leases:  # else it was adopted
            self._end(lease)
            self._return_abandoned(lease.worker)

    def _find_dropped(self) -> None:
        while self._dropped:
            worker = self._leases.pop(self._dropped.popleft(), None)
            if worker is not None:
                self._take_over(worker.handle)
                self._return_abandoned(worker)

    def _return_abandoned(self, worker: LeasedWorker) -> None:
        """Return a worker that may still run a call whose caller has gone."""
        handle = worker.handle
        assert handle.worker is not None
        assert handle.child is not None
        self._scheduler.ledger.expect_late(handle.worker, worker.seq)
        seq = self._scheduler.ledger.next_seq()
        self._scheduler.return_busy(handle.worker, seq, None, None, self._loop.now())
        handle.child.deliver(seq, NO_OP_MESSAGE)
        self._back(worker)

    def _end(self, lease: Lease) -> None:
        self._leases.pop(weakref.ref(lease), None)
        lease.channel.close()
        self._take_over(lease.worker.handle)

    def _take_over(self, handle: WorkerHandle) -> None:
        if handle.child is not None:
            handle.child.reclaim()

    def _note(self, worker: LeasedWorker) -> None:
        """Note the calls of a leased worker in the pool's activity."""
        for report in worker.take_work(self._loop.now()):
            self._activity.leased(worker.handle, report)

    def note_work(self) -> None:
        """Note the calls of all leased workers until now."""
        for worker in self._leases.values():
            self._note(worker)

    def _back(self, worker: LeasedWorker) -> None:
        self._note(worker)
        if self._workers.get(worker.handle) is worker:
            del self._workers[worker.handle]
        self._on_back(worker)
