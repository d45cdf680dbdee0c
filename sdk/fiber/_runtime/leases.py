"""Calls that a waiting thread gives to a worker itself, without the loop in between.

An ``apply`` that went through the loop would wake two threads that only pass it on.  So the
scheduler lends an idle worker: whoever calls next takes it, sends it the call, waits for the answer
and leaves it for the next one.  Ray's callers lease workers in the same way.  What goes to another
host still passes the loop, whose link it is, but no scheduler.  ::

    loop's thread                  any thread                         worker
    offer ──► idle leases ──pop──► run ─────────── send, receive ───► │
                  ▲                 ├── answered: append ──┘
    recall ◄──────┘                 ├── takes longer, or its worker is gone: adopt
                                    └── interrupted: abandon

A lease belongs to whoever popped it; nothing else is shared, so an interruption at any line leaves
at most a lease that nobody returns.  Of that a weak reference tells, in one step of the
interpreter's own, and the loop takes the worker back.
"""

from __future__ import annotations

import pickle
import weakref
from collections import deque
from collections.abc import Callable
from typing import Any

from fiber._agent.interface import DirectChannel
from fiber._engine.scheduler import Scheduler
from fiber._engine.tasks import WrongAnswer
from fiber._runtime.answers import OTHER, read, single
from fiber._runtime.work_items import Call
from fiber._runtime.workers import WorkerHandle
from fiber._transport.loop import Loop, Timer
from fiber._wire import work
from fiber._wire.packet import Message

ATTENTION = 5e-3
"""Seconds that a caller waits for a worker itself before it leaves the answer to the loop."""

UNUSED = 0.05
"""Seconds without a call after which a lease ends: its worker may leave, or be given other work."""

NO_OP_MESSAGE = work.pack_calls([(pickle.dumps((bool, (), {})), ())])
"""A call whose answer says that all before it is answered."""


class NoOutcome:
    """Mark in place of an outcome that has not come."""


UNAVAILABLE = NoOutcome()
"""No worker was to be had."""

ADOPTED = NoOutcome()
"""The loop has taken over, and will tell the call's future."""


class Lease:
    """An idle worker for direct use."""

    __slots__ = ("__weakref__", "channel", "handle", "surprise", "used")

    def __init__(self, handle: WorkerHandle, channel: DirectChannel) -> None:
        self.handle = handle
        self.channel = channel
        self.used = True
        """Since somebody looked last."""
        self.surprise: Message | None = None
        """Message of its worker that is not the answer; the loop judges it."""


class Leases:
    """The workers of one pool that are lent.

    ``on_adopted`` is called, on the loop's thread, with a call that its caller leaves to the loop,
    ``on_back`` with each worker that is back.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        loop: Loop,
        *,
        on_adopted: Callable[[WorkerHandle, int, Call], None],
        on_back: Callable[[WorkerHandle], None],
    ) -> None:
        self._scheduler = scheduler
        self._batches = scheduler.ledger.batches
        self._loop = loop
        self._on_adopted = on_adopted
        self._on_back = on_back
        self._check: Timer | None = None
        self._idle: deque[Lease] = deque()
        self._lent: dict[weakref.ref[Lease], WorkerHandle] = {}
        self._dropped: deque[weakref.ref[Lease]] = deque()
        self._recalled = False

    # Any thread

    def run(self, call: Call) -> Any:
        """The outcome of a call; UNAVAILABLE if it was not sent, ADOPTED if that takes longer."""
        try:
            lease = self._idle.pop()
        except IndexError:
            return UNAVAILABLE
        lease.used = True
        try:
            seq = self._scheduler.ledger.next_seq()
            answer = self._exchange(lease, seq, call)
            if answer is ADOPTED:
                self._loop.call_soon(self._adopt, lease, seq, call)
                return ADOPTED
        except BaseException:
            self._loop.call_soon(self._abandon, lease)
            raise
        self._put_back(lease)
        return answer

    def _exchange(self, lease: Lease, seq: int, call: Call) -> Any:
        handle, channel = lease.handle, lease.channel
        handle.asked = seq
        try:
            channel.send(seq, call.message(), call.buffers)
        except OSError:  # whoever sends it in our place will see why
            return UNAVAILABLE
        while True:
            try:
                message = channel.receive(ATTENTION)
            except BrokenPipeError:  # it was gone before that was sent
                return UNAVAILABLE
            except (EOFError, OSError, MemoryError):  # it is gone, as the loop is about to hear
                return ADOPTED
            if message is None:
                return ADOPTED
            result = single(message, seq)
            if result is OTHER and not self._is_late(message, seq):
                lease.surprise = message
                return ADOPTED
            message.release()
            if result is not OTHER:
                handle.tasks += 1
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
        # The loop notes that it wants them back and takes what is there then.
        if self._recalled:
            self._loop.call_soon(self.recall)

    # The loop's thread

    def offer(self, handle: WorkerHandle) -> None:
        """Lend a worker that has become idle, if nobody else needs it."""
        if handle.worker is None or handle.child is None:
            return
        if not self._scheduler.lease(handle.worker):
            return
        channel = handle.child.lend()
        if channel is None:
            self._scheduler.return_idle(handle.worker, self._loop.now())
            return
        lease = Lease(handle, channel)
        self._lent[weakref.ref(lease, self._dropped.append)] = handle
        self._recalled = False
        self._idle.append(lease)
        if self._check is None:
            self._check = self._loop.call_later(UNUSED, self._recall_unused)

    def recall(self) -> None:
        """Take back those that nobody uses, and the others as soon as they are left."""
        self._recalled = True
        while self._idle:
            try:
                lease = self._idle.pop()
            except IndexError:  # somebody was faster, and will bring it back
                break
            self._return_idle(lease)
        self._find_dropped()

    def recall_one(self, handle: WorkerHandle) -> bool:
        """Take this one back; False if somebody uses it, and will bring it back."""
        for lease in list(self._idle):
            if lease.handle is handle:
                try:
                    self._idle.remove(lease)
                except ValueError:  # somebody was faster
                    return False
                self._return_idle(lease)
                return True
        return False

    def close(self) -> None:
        """Cancel the timer: the last worker has ended."""
        if self._check is not None:
            self._check.cancel()

    def _recall_unused(self) -> None:
        """Take back those that nobody used since this was called last."""
        self._check = None
        for lease in list(self._idle):
            if not lease.used:
                self.recall_one(lease.handle)
            lease.used = False
        self._find_dropped()
        if self._lent:
            self._check = self._loop.call_later(UNUSED, self._recall_unused)

    def _return_idle(self, lease: Lease) -> None:
        handle = self._end(lease)
        if handle.worker is not None:
            self._scheduler.return_idle(handle.worker, self._loop.now())
        self._on_back(handle)

    def _adopt(self, lease: Lease, seq: int, call: Call) -> None:
        # First what the answer is to: it may be there already.
        self._on_adopted(lease.handle, seq, call)
        handle = self._end(lease)
        if lease.surprise is not None:
            handle.received(lease.surprise)
        self._on_back(handle)

    def _abandon(self, lease: Lease) -> None:
        if weakref.ref(lease) in self._lent:  # else it was adopted
            self._return_abandoned(self._end(lease))

    def _find_dropped(self) -> None:
        while self._dropped:
            handle = self._lent.pop(self._dropped.popleft(), None)
            if handle is not None:
                self._take_over(handle)
                self._return_abandoned(handle)

    def _return_abandoned(self, handle: WorkerHandle) -> None:
        """Return a worker that may still run a call whose caller has gone."""
        assert handle.worker is not None
        assert handle.child is not None
        self._scheduler.ledger.expect_late(handle.worker, handle.asked)
        seq = self._scheduler.ledger.next_seq()
        self._scheduler.return_busy(handle.worker, seq, None, None, self._loop.now())
        handle.child.deliver(seq, NO_OP_MESSAGE)
        self._on_back(handle)

    def _end(self, lease: Lease) -> WorkerHandle:
        self._lent.pop(weakref.ref(lease), None)
        lease.channel.close()
        self._take_over(lease.handle)
        return lease.handle

    def _take_over(self, handle: WorkerHandle) -> None:
        if handle.child is not None:
            handle.child.reclaim()
