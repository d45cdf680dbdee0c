"""Channels of this host in one direction.

A *one-way channel* holds as many unread messages as a pipe does.  The kernel counts about 800 bytes
of a socket's buffer for every packet, so a socket holds fewer small messages than a pipe.  Messages
that do not fit go into a *backlog* in shared memory, until the backlog is empty again.  Messages in
the socket are older than those in the backlog::

    SendingEnd ──┬─ the backlog is empty ──► socket ────────────┬─► ReceivingEnd
                 └─ the socket is full ────► backlog, wake-up ──┘

* Without a backlog, neither end takes a lock or needs another system call.
* While there is a backlog, the socket holds a *wake-up* packet behind all messages, so that its
  descriptor is readable and a sleeping receiver wakes.  A receiver that finds the packet at the
  head of the socket takes a message from the backlog.  The packet has a descriptor of the sending
  end.  With it the receiver sends the packet again and wakes the next receiver.
* A sender that checked the backlog a moment too early may send behind the wake-up packet.  It notes
  that (``AMBIGUOUS``), and the next receiver moves the packet to the end.
* The backlog is slower than the socket.  So two kinds of senders are *patient*, and wait a moment
  for room in the socket first: the thread that sends the items of a queue, and the hub, which sends
  for other hosts.
* A sender that finds the backlog full waits for a packet in the other direction.
* If a receiver dies while it has the wake-up packet, no message is lost, but other receivers do not
  wake.  They look at the backlog each second; the hub and the dealer of a queue do so for their
  readers.  The next sender finds the socket empty and sends another wake-up packet.
"""

from __future__ import annotations

import contextlib
import fcntl
import select
import socket
import struct
import termios
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

from fiber._hub import heap
from fiber._hub.local import LocalChannel, LocalCounter
from fiber._hub.protocol import ObjectKind
from fiber._sync.liveness import RobustMutex
from fiber._transport.channels import (
    BorrowedSocket,
    Claimant,
    connected,
    wait_readable,
    wait_until,
)
from fiber._unconfirmed import flush_all, unconfirmed
from fiber._wire import packet
from fiber._wire.descriptor import Descriptor
from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import Message
from fiber.errors import ConnectionClosed

HEAD, TAIL = 8, 9
"""Words with the positions of the first record and of the end."""

_NEEDED = 10
"""Word: free bytes that a sender waits for, or 0.  While it waits, no other sender puts."""

AMBIGUOUS = 11
"""Word: 1 if the socket has messages behind a wake-up packet."""

UNANNOUNCED = 12
"""Word: 1 if a wake-up packet is missing."""

ROOM = 13
"""Word: the usual size of the socket's buffer."""

PATIENCE = 0.05
"""Seconds that a patient sender waits for the socket before a message goes into the backlog."""

HURRY = 1.0
"""Seconds after that in which it does not wait again, unless the backlog is empty before."""

_LOOK_AT_BACKLOG = 1e-3
"""Seconds between two looks of a patient sender while receivers empty the backlog."""

_HEADER = 128
_SIZE = heap.LARGE - 8  # small blocks share a segment, and with it a descriptor
_LENGTH = 4

_Result = TypeVar("_Result")


class Backlog:
    """Ring buffer in shared memory, for messages that do not fit into the socket.

    It is changed only within ``run``.
    """

    __slots__ = ("_capacity", "_data", "_mutex", "block", "words")

    def __init__(self, block: heap.Block) -> None:
        self.block = block
        self.words = block.view[:_HEADER].cast("q")
        self._data = block.view[_HEADER:]
        self._capacity = len(self._data)
        self._mutex = RobustMutex(block.address)

    @classmethod
    def create(cls) -> Backlog:
        """Return a new backlog, which is empty."""
        new = cls(heap.allocate(_SIZE))
        new._mutex.create()
        return new

    def run(self, action: Callable[[], _Result]) -> _Result:
        """Call ``action`` while no other thread or process is in ``run``; return its result."""
        return self._mutex.run(action)

    def __bool__(self) -> bool:
        words = self.words
        return words[HEAD] != words[TAIL]

    def holds_one(self) -> bool:
        """Tell whether the next record is the last one."""
        head = self.words[HEAD]
        return head + _LENGTH + self._length(head) == self.words[TAIL]

    def fits(self, size: int) -> bool:
        """Tell whether a payload of ``size`` bytes fits into an empty backlog."""
        return size + _LENGTH <= self._capacity

    def put(self, payload: memoryview) -> bool:
        """Append a record; False if there is no room, or an earlier sender waits for some."""
        words, size = self.words, payload.nbytes
        while True:
            tail = words[TAIL]
            end = tail + _LENGTH + size
            if words[_NEEDED] or end - words[HEAD] > self._capacity:
                return False
            self._write(tail, memoryview(size.to_bytes(_LENGTH, "little")))
            self._write(tail + _LENGTH, payload)
            if words[TAIL] == tail:  # otherwise a finalizer or handler has put a record
                words[TAIL] = end
                return True

    def take(self, say_room: Callable[[], None], then: Callable[[], None] | None = None) -> bytes:
        """Remove and return the first record.

        Call ``say_room`` before that if it makes the room that a sender waits for.  Call ``then``,
        a C function, right after that: no signal's handler runs in between.
        """
        words = self.words
        while True:
            head = words[HEAD]
            start = head + _LENGTH
            end = start + self._length(head)
            payload = self._read(start, end)
            needed = words[_NEEDED]
            if needed and self._capacity - (words[TAIL] - end) >= needed:
                say_room()  # first: after a death here the sender only looks once too often
                words[_NEEDED] = 0
            if words[HEAD] == head:
                words[HEAD] = end
                if then is not None:
                    then()
                return payload

    def need(self, size: int) -> None:
        """Note that a sender waits for room: for an empty backlog if the payload does not fit."""
        wanted = max(size + _LENGTH, self._capacity // 2)
        self.words[_NEEDED] = max(self.words[_NEEDED], min(wanted, self._capacity))

    def _length(self, at: int) -> int:
        return int.from_bytes(self._read(at, at + _LENGTH), "little")

    def _write(self, at: int, data: memoryview) -> None:
        at %= self._capacity
        first = min(len(data), self._capacity - at)
        self._data[at : at + first] = data[:first]
        self._data[: len(data) - first] = data[first:]

    def _read(self, at: int, end: int) -> bytes:
        size = end - at
        at %= self._capacity
        data = self._data[at : at + size].tobytes()
        return data if len(data) == size else data + self._data[: size - len(data)].tobytes()


LOOK_AGAIN = 1.0
"""Seconds after which a sleeping receiver looks at the backlog."""

_DONTWAIT = int(socket.MSG_DONTWAIT)
_PEEK = int(socket.MSG_PEEK) | _DONTWAIT
_IS_WAKE_UP = bytes([packet.WAKE_UP])
_INT = struct.Struct("i")
_RECEIVE_TIMEOUT = struct.pack("ll", int(LOOK_AGAIN), 0)


class OneWayEnd(LocalChannel):
    """End of a one-way channel: a socket, and the backlog that holders of both ends share."""

    __slots__ = ("_words", "backlog")

    kind: ObjectKind

    def __init__(self, owner: Descriptor, backlog: Backlog) -> None:
        super().__init__(owner)
        self.backlog = backlog
        self._words = backlog.words


class SendingEnd(OneWayEnd):
    """Sending end of a one-way channel."""

    __slots__ = ("_hurries_until", "_room_events")

    kind = ObjectKind.SENDER
    can_try_send = True

    def __init__(self, owner: Descriptor, backlog: Backlog) -> None:
        super().__init__(owner, backlog)
        self._room_events: int = select.POLLOUT
        self._hurries_until = 0.0
        """Time until which messages go into the backlog at once."""

    def send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message.  Wait for room; after a bulky message, wait until it is read."""
        bulky = self._send_now(payload, buffers)
        if bulky is None:
            self._send_in_turn(payload, buffers)
            bulky = packet.is_bulky(payload, buffers)
        if bulky:
            wait_until(self.fileno(), select.POLLOUT)

    send_unconfirmed = send_surely = send

    def post(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message.  Wait for room, but not until it is read.

        The sender is patient: it first waits a moment for room in the socket.
        """
        begin = time.monotonic()
        while not self.try_send_directly(payload, buffers):
            events, patience = self.patience(begin)
            if not patience:
                self._send_in_turn(payload, buffers)
                return
            if events:
                wait_until(self.fileno(), events, patience)
            else:
                time.sleep(patience)

    def try_send_directly(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send one message if there is room for it in the socket, and no backlog."""
        if self._send_now(payload, buffers) is None:
            return False
        self._hurries_until = 0.0
        return True

    def patience(self, begin: float) -> tuple[int, float]:
        """Return when to try again to send a message directly: at an event, or after seconds.

        ``begin`` is the time of the first attempt.  Zero seconds mean not to wait any longer.  The
        event is zero if there is none.
        """
        now = time.monotonic()
        if now < self._hurries_until:
            return 0, 0.0
        left = begin + PATIENCE - now
        if left <= 0:
            self._hurries_until = now + HURRY
            return 0, 0.0
        return (0, min(left, _LOOK_AT_BACKLOG)) if self.backlog else (select.POLLOUT, left)

    def try_send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send one message if there is room for it now."""
        if self._send_now(payload, buffers) is not None:
            return True
        events = self.backlog.run(partial(self._place, payload, buffers))
        if events:
            self._room_events = events
        return not events

    @property
    def room_events(self) -> int:
        """Event of ``fileno()`` after which ``try_send`` may succeed."""
        return self._room_events

    def _send_now(self, payload: BytesLike, buffers: Sequence[memoryview]) -> bool | None:
        """Send through the socket unless there is a backlog; None if it was not sent.

        True means that the message is bulky.
        """
        if unconfirmed:
            flush_all()
        words = self._words
        if words[HEAD] != words[TAIL]:
            return None
        try:
            bulky = packet.send(self._sock, payload, buffers, ballast=True, wait=False)
        except BlockingIOError:
            return None
        if words[HEAD] != words[TAIL]:
            words[AMBIGUOUS] = True
        return bulky

    def _send_in_turn(self, payload: BytesLike, buffers: Sequence[memoryview]) -> None:
        while events := self.backlog.run(partial(self._place, payload, buffers)):
            wait_until(self.fileno(), events)

    # Within ``backlog.run``

    def _place(self, payload: BytesLike, buffers: Sequence[memoryview]) -> int:
        """Send the message or put it into the backlog; return 0, or an event to wait for."""
        is_first = not self.backlog
        if is_first:
            with contextlib.suppress(BlockingIOError):
                packet.send(self._sock, payload, buffers, ballast=True, wait=False)
                return 0
        view = memoryview(payload).cast("B")
        fits = not buffers and self.backlog.fits(view.nbytes)
        if is_first and not fits:
            return select.POLLOUT
        if not (fits and self.backlog.put(view)):
            # In this order: if this process dies in between, receivers send a notice to the others.
            self.backlog.need(packet.size_of(payload, buffers))
            self._forget_room()
            return select.POLLIN
        if is_first or self._words[UNANNOUNCED] or self._nothing_unread():
            self._words[UNANNOUNCED] = True
            _wake_up(self._sock, self._words)
        return 0

    def _forget_room(self) -> None:
        """Remove old notices of room from the socket; BrokenPipeError if no receiver is left."""
        try:
            while self._sock.recv(1, _DONTWAIT):
                pass
        except BlockingIOError:
            return
        except ConnectionResetError:  # receivers closed and left messages unread
            pass
        raise BrokenPipeError("the other end is closed")

    def _nothing_unread(self) -> bool:
        """Tell whether the socket is empty, so that its wake-up packet is lost."""
        return fcntl.ioctl(self._sock, termios.TIOCOUTQ, bytes(_INT.size)) == bytes(_INT.size)


class ReceivingEnd(OneWayEnd):
    """Receiving end of a one-way channel."""

    __slots__ = ()

    kind = ObjectKind.RECEIVER

    def recv(self, *, passing: bool = False) -> Message:
        """Return the next message; ConnectionClosed at the end."""
        while True:
            message = self._next(wait=True, passing=passing)
            if message is not None:
                return message

    def recv_object(self) -> Any:
        """Return the object in the next message; ConnectionClosed at the end."""
        words = self._words
        if words[HEAD] == words[TAIL]:
            try:
                return packet.receive_object(self._sock)
            except packet.NothingYet:
                pass
            except packet.WakeUp as wake_up:
                message = self._take(wake_up.sender)
                if message is not None:
                    return packet.loads(message)
        return packet.loads(self.recv())

    recv_answer = recv

    def try_recv(self) -> Message | None:
        """Return the next message if there is one; ConnectionClosed at the end."""
        return self._next(wait=False)

    def poll(self, timeout: float | None) -> bool:
        """Wait until ``recv`` would return or raise at once; False after ``timeout`` seconds."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self.backlog:
            left = LOOK_AGAIN if deadline is None else deadline - time.monotonic()
            if wait_readable(self.fileno(), max(0.0, min(left, LOOK_AGAIN))):
                return True
            if left <= 0:
                return False
        return True

    def recv_counting(
        self, counter: LocalCounter, claims: Claimant, *, wait: bool
    ) -> Message | None:
        """Receive a message and raise ``counter`` in one step; None if there is no message.

        A blocking receive would not do.  The kernel gives the message to a receiver that waits,
        even if it is killed before it runs again.
        """
        if unconfirmed:  # a sender may wait for the counter
            flush_all()
        while True:
            claims.add()  # first: after a death there is a record too many, not too few
            try:
                message = self._next(wait=False, counter=counter)
            finally:
                claims.drop()
            if message is not None or not wait:
                return message
            self._wait()

    def _wait(self) -> None:
        """Wait until there may be a message or the end, at most ``LOOK_AGAIN`` seconds.

        Each packet wakes one of the receivers that wait, where ``poll`` would wake them all.  If
        that receiver is killed before it takes the packet, the others look a second later.
        """
        if not self.backlog:
            with contextlib.suppress(BlockingIOError, ConnectionResetError):
                self._sock.recv(1, socket.MSG_PEEK)

    def recv_uncounting(self, counter: LocalCounter, *, wait: bool) -> Message | None:
        """Receive a message and lower ``counter``; None if there is no message."""
        message = self.recv() if wait else self.try_recv()
        if message is not None:
            counter.take(0)
        return message

    def _next(
        self, *, wait: bool, passing: bool = False, counter: LocalCounter | None = None
    ) -> Message | None:
        """Return the next message, or None if there is none; with ``wait``, None after a while.

        Raise ``counter`` in one step with that.
        """
        while True:
            if self.backlog:
                message = self._take(counter=counter)
                if message is not None:
                    return message
            try:
                return self._receive(counter, wait=wait, passing=passing)
            except BlockingIOError:
                if not self.backlog:
                    return None
            except ConnectionClosed:
                if not self.backlog:
                    raise
            except packet.WakeUp as wake_up:
                message = self._take(wake_up.sender, counter)
                if message is not None:
                    return message

    def _receive(
        self, counter: LocalCounter | None, *, wait: bool, passing: bool = False
    ) -> Message:
        """Receive a packet from the socket; WakeUp if it is a wake-up packet."""
        raised = None if counter is None else counter.fileno()
        return packet.receive(self._sock, wait=wait, passing=passing, counter=raised)

    def _take(
        self, sender: Descriptor | None = None, counter: LocalCounter | None = None
    ) -> Message | None:
        """Return the oldest message of socket and backlog; None if there is no backlog.

        ``sender`` is the descriptor in a wake-up packet that the caller has removed.
        """
        return self.backlog.run(partial(self._take_in_order, sender, counter))

    # Within ``backlog.run``

    def _take_in_order(
        self, sender: Descriptor | None, counter: LocalCounter | None
    ) -> Message | None:
        words = self._words
        while self.backlog:
            head = self._peek()
            last = self.backlog.holds_one()
            if not head or (head == _IS_WAKE_UP and not (last or words[AMBIGUOUS])):
                if sender is not None and not head and not last:
                    self._pass_on(sender)
                raising = None if counter is None else counter.raising
                record = self.backlog.take(self._say_room, raising)
                return Message(memoryview(record), [], [])
            try:
                message = self._receive(counter, wait=False)
            except packet.WakeUp as wake_up:
                # Another receiver may have been faster.  The last record needs no wake-up packet.
                sender = wake_up.sender
                if words[AMBIGUOUS]:
                    words[AMBIGUOUS] = False
                    self._pass_on(sender)
                    sender = None
            except (BlockingIOError, ConnectionClosed):
                pass  # another receiver has taken the message
            else:
                if sender is not None:
                    self._pass_on(sender)
                return message
        return None

    def _pass_on(self, sender: Descriptor) -> None:
        # If this fails, other receivers wake later.
        with contextlib.suppress(OSError):
            _wake_up(BorrowedSocket(sender), self._words)

    def _peek(self) -> bytes:
        """Return the first byte of the next packet; b"" if there is none."""
        for _ in range(2):
            try:
                return self._sock.recv(1, _PEEK)
            except BlockingIOError:
                break
            except ConnectionResetError:  # senders closed and left packets unread; reported once
                pass
        return b""

    def _say_room(self) -> None:
        with contextlib.suppress(OSError):  # there is a notice already, or no sender is left
            self._sock.send(b"\0", _DONTWAIT)


ENDS: dict[ObjectKind, type[SendingEnd | ReceivingEnd]] = {
    ObjectKind.SENDER: SendingEnd,
    ObjectKind.RECEIVER: ReceivingEnd,
}


def pair() -> tuple[ReceivingEnd, SendingEnd]:
    """Return the two ends of a new one-way channel."""
    backlog = Backlog.create()  # first: if it raises, no socket is left open
    one, other = connected()
    receiver, sender = ReceivingEnd(one, backlog), SendingEnd(other, backlog)
    backlog.words[ROOM] = sender.sock.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)
    receiver.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _RECEIVE_TIMEOUT)
    return receiver, sender


def _wake_up(sock: socket.socket, words: memoryview) -> None:
    """Send a wake-up packet.  The socket's buffer grows for a moment to have room for it."""
    usual = words[ROOM]
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, usual)  # the kernel doubles it
    try:
        packet.send_wake_up(sock, sock.fileno())
        words[UNANNOUNCED] = False
    except ConnectionResetError as error:
        raise BrokenPipeError("the other end is closed") from error
    except BrokenPipeError:
        raise
    except OSError:
        pass  # the buffer may not grow, or a limit is reached; the next sender tries again
    finally:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, usual // 2)
