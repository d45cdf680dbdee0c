"""Messages that this process sends to a channel of another host without a wait for each.

The hub replies twice: once the message is queued behind the earlier ones of the channel, and once
the channel has taken it.  The first reply confirms the message.  The second one returns its credit,
which further messages can use::

    PipelinedSender ── message ──► hub ── if there is room ──► channel
                    ◄── it is queued ───┤
                    ◄── it was taken ───┘

A one-way channel gets all messages, also those of a killed process.  A pipe drops those that it has
not taken: while the hub kept the dead process's end open, its peer would see no end of file.  So a
process never has more on the way to a pipe than has room there, if it alone sends by that end: a
reply says whether the pipe is half full, and then ``send`` waits for the second reply.  A process
that ends by itself waits for it, too.

Threads may send at the same time.  Code may also send or flush on top of a ``send`` of its own
thread: a handler of a signal, or a finalizer that the garbage collector runs.  It must not wait for
what only the interrupted ``send`` can do.  So it does not wait for a message that is not sent yet,
and requests again the replies which that ``send`` may have read and not noted.  A message is one
packet, and each entry of a dictionary is put in and taken out in one step, so no lock is needed.
"""

from __future__ import annotations

import itertools
import os
import time
import weakref
from array import array
from collections.abc import Callable, Iterable, Sequence
from threading import get_ident

from fiber._hub.client import HubStream, ObjectUnreachable, Reply, has_local_hub, refuse_on_loop
from fiber._hub.protocol import HALF_FULL, HEAD, NUMBERS, ONE, TAKEN, Op, Status
from fiber._transport.channels import wait_readable
from fiber._transport.loop import runs_here
from fiber._unconfirmed import flush_all, unconfirmed
from fiber._wire import packet
from fiber._wire.memory_files import BytesLike

CREDIT = 1 << 16
"""Bytes on the way to a one-way channel from which on further messages wait."""

PIPE_CREDIT = 1 << 15
"""Largest sum of the bytes on the way to a pipe.  It fits into the free half of a pipe."""

OVERHEAD = 1 << 10
"""Bytes that a message counts for in addition to its own: the hub needs memory for each."""

LARGE = packet.INLINE_LIMIT
"""Bytes above which a message is large: small ones may overtake it on the way."""

_FIRST_SLICE, _LONGEST_SLICE = 0.002, 0.2
"""Seconds until a thread looks again: another one may have read the reply that it waits for."""

_pipe_senders: weakref.WeakValueDictionary[int, PipelinedSender] = weakref.WeakValueDictionary()
"""Senders to pipes, which have to take the messages of this process before it ends."""


def finish_pipes() -> None:
    """Wait until all pipes have taken the messages of this process, or cannot."""
    for reference in _pipe_senders.valuerefs():
        sender = reference()
        if sender is not None:
            sender.finish()


os.register_at_fork(after_in_child=_pipe_senders.clear)


class PipelinedSender:
    """Sender of this process to one channel, over a stream of its own."""

    def __init__(self, stream: HubStream, *, hub_keeps: bool) -> None:
        """``hub_keeps``: the hub keeps messages that have no room when this process is killed."""
        self._stream = stream
        self._hub_keeps = hub_keeps
        self._has_room = True
        """False if the pipe was half full at the last reply."""
        self._numbers = itertools.count(1)
        self._untaken: dict[int, int] = {}
        """Sizes of the messages that the channel has not taken."""
        self._unsent: dict[int, int] = {}
        """Messages that are not sent yet, and the threads that send them."""
        self._in_send: dict[int, None] = {}
        """Messages whose ``send`` has not returned, or was interrupted.  None waits for them."""
        self._syncs: dict[int, set[int]] = {}
        """Requests of ``_request_sync``, and the messages that were sent before."""
        self._reading: dict[int, None] = {}
        """Threads that may have read a reply and not noted it."""
        self._has_lost_replies = False
        """True after an interrupt, which may have come between reading and noting a reply."""
        self._has_delivered = False
        """True once a message has arrived."""
        self._error: str | None = None
        if not hub_keeps:
            _pipe_senders[id(self)] = self

    def send(
        self,
        payload: BytesLike,
        buffers: Sequence[memoryview] = (),
        *,
        tracked: bool = True,
        waits: bool = False,
    ) -> None:
        """Send a message once there is credit for it.

        Wait until the channel has taken it, if it is the first one, if the pipe is half full, or
        if ``waits`` is true.  BrokenPipeError if it did not arrive, or an earlier one.  A message
        that is not ``tracked`` may be overtaken by what this process does later.
        """
        refuse_on_loop()
        size = packet.size_of(payload, buffers) + OVERHEAD
        if unconfirmed:
            flush_all(but=self)
        self._wait_until(lambda: self._has_credit(size))
        self._check()
        number = self._next_number()
        self._in_send[number] = None
        self._transmit(number, size, payload, buffers, tracked)
        # Other threads of a program with a hub act without a look at ``unconfirmed``.
        may_go_on = self._has_delivered and self._has_room and not has_local_hub()
        if waits or (tracked and not may_go_on):
            self._wait_until(lambda: number not in self._untaken)
            self._check()
            self._has_delivered = True
        self._in_send.pop(number, None)

    def _has_credit(self, size: int) -> bool:
        untaken, me = self._untaken.copy(), get_ident()
        for number, thread in self._unsent.copy().items():
            if thread == me:  # by a call that this one has interrupted
                untaken.pop(number, None)
        if self._hub_keeps:
            return sum(untaken.values()) < CREDIT
        return not untaken or (self._has_room and sum(untaken.values()) + size <= PIPE_CREDIT)

    def _transmit(
        self,
        number: int,
        size: int,
        payload: BytesLike,
        buffers: Sequence[memoryview],
        tracked: bool,
    ) -> None:
        try:
            self._unsent[number] = get_ident()
            self._untaken[number] = size
            if tracked:
                unconfirmed[self, number] = None
            self._stream.send_request(HEAD.pack(Op.SEND, number), [memoryview(payload), *buffers])
        except ObjectUnreachable as error:
            self._end(str(error))
            raise BrokenPipeError(str(error)) from error
        except BaseException:
            self._note_taken([number])
            raise
        finally:
            self._unsent.pop(number, None)

    def flush(self) -> None:
        """Wait until each message is confirmed, or the hub cannot be reached.

        Do nothing on the thread of a loop, which may have to carry the replies.
        """
        if not runs_here():
            numbers = [number for number in self._unconfirmed() if number not in self._unsent]
            self._wait_until(lambda: not any((self, number) in unconfirmed for number in numbers))

    def finish(self) -> None:
        """Wait until the channel has taken all messages whose ``send`` has returned, or cannot."""
        if not runs_here():
            numbers = self._untaken.keys() - self._in_send.keys()
            self._wait_until(lambda: numbers.isdisjoint(self._untaken))

    def taken_within(self, seconds: float) -> bool:
        """Return whether the channel takes all messages within ``seconds``.

        BrokenPipeError if one did not arrive.
        """
        numbers = set(self._untaken)
        is_taken = self._wait_until(lambda: numbers.isdisjoint(self._untaken), seconds)
        self._check()
        return is_taken

    def close(self) -> None:
        """End the stream.  No message is lost whose ``send`` has returned."""
        try:
            self.flush()
            if not self._hub_keeps:
                self.finish()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """End the stream without a wait.  The hub reads what was sent."""
        self._end("handle is closed")
        self._stream.close()

    def _check(self) -> None:
        if self._error is not None:
            raise BrokenPipeError(self._error)

    def _next_number(self) -> int:
        return next(self._numbers) & 0xFFFFFFFF

    def _unconfirmed(self) -> list[int]:
        return [number for sender, number in unconfirmed.copy() if sender is self]

    def _wait_until(self, is_so: Callable[[], bool], seconds: float | None = None) -> bool:
        """Wait until ``is_so``; return False if it is not after ``seconds``."""
        if get_ident() in self._reading:  # by a call that this one has interrupted
            self._has_lost_replies = True
        deadline = None if seconds is None else time.monotonic() + seconds
        pause = _FIRST_SLICE
        self._read_replies()
        while not is_so():
            if deadline is not None:
                pause = min(pause, deadline - time.monotonic())
                if pause <= 0:
                    return False
            self._wait(pause)
            pause = min(2 * pause, _LONGEST_SLICE)
        return True

    def _wait(self, seconds: float) -> None:
        try:
            if self._has_lost_replies:
                self._request_sync()
            is_readable = wait_readable(self._stream.fileno(), seconds)
        except (OSError, EOFError) as error:
            if not self._ended_with(error):
                raise
        else:
            if is_readable:
                self._read_replies()

    def _read_replies(self) -> None:
        """Note the replies that are there."""
        me = get_ident()
        has_interrupted = me in self._reading
        try:
            self._reading[me] = None
            while (self._untaken or self._syncs) and (reply := self._stream.try_receive()):
                self._on_reply(reply)
        except BaseException as error:
            self._has_lost_replies = True
            if not self._ended_with(error):
                raise
        finally:
            if not has_interrupted:
                self._reading.pop(me, None)

    def _ended_with(self, error: BaseException) -> bool:
        """End after an error of the stream; return False for one that a signal's handler raised."""
        if isinstance(error, ObjectUnreachable):
            self._end(str(error))
        elif isinstance(error, OSError) and self._stream.fileno() < 0:
            self._end("handle is closed")  # by another thread
        else:
            return False
        return True

    def _request_sync(self) -> None:
        """Request a reply that stands for all earlier ones."""
        number = self._next_number()
        unanswered = {*self._untaken, *self._unconfirmed()}
        self._syncs[number] = unanswered.difference(self._unsent)
        self._stream.send_request(ONE.pack(Op.SYNC, number, 0))
        self._has_lost_replies = False

    def _on_reply(self, reply: Reply) -> None:
        self._stream.has_acknowledged = True
        sent_before = self._syncs.pop(reply.number, None)
        if sent_before is not None:
            self._on_sync(sent_before, reply)
            return
        (flags,) = reply.values
        self._has_room = self._hub_keeps or not flags & HALF_FULL
        if flags & TAKEN:
            self._note_taken([reply.number])
        unconfirmed.pop((self, reply.number), None)
        if reply.status is Status.BROKEN:
            self._error = "the other end is closed"

    def _on_sync(self, sent_before: set[int], reply: Reply) -> None:
        """Note which messages the channel has taken.  All are queued."""
        waiting = array(NUMBERS, reply.parts[0].tobytes() if reply.parts else b"")
        self._has_room = self._hub_keeps  # else the next message finds out
        self._note_taken(sent_before.difference(waiting))
        for number in sent_before:
            unconfirmed.pop((self, number), None)

    def _note_taken(self, numbers: Iterable[int]) -> None:
        for number in numbers:
            self._untaken.pop(number, None)
            self._in_send.pop(number, None)
            unconfirmed.pop((self, number), None)

    def _end(self, reason: str) -> None:
        self._error = self._error or reason
        self._syncs.clear()
        self._untaken.clear()
        self._in_send.clear()
        for number in self._unconfirmed():
            unconfirmed.pop((self, number), None)
