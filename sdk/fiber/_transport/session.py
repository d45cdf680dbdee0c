"""A reliable, ordered stream of frames over a link that may lose, repeat or break off.

nng drops a message without a word when the queue of its pipe is full, and forgets what was under
way when a pipe breaks.  A session makes up for both.  It is pure: the caller tells it the time and
carries its datagrams::

    send(frame) ─► queue ─► outgoing(now) ─► [datagram] ─ ─ ─ ─► received(datagram, now) ─► [frame]
                               ▲    │ unacknowledged                          │
                               └────┴──────────── acknowledgement ◄─ ─ ─ ─ ─ ─┘

* Datagrams with frames are numbered from 1; every datagram carries the number up to which
  everything arrived.  The receiver takes only the next number: what is older is a repetition, what
  is newer means that one is missing, which it says at once.
* At most WINDOW datagrams are unacknowledged, so small frames that wait for room travel together.
* Acknowledgements ride on what is sent anyway.  The sender asks for one at once when it cannot go
  on without it; otherwise the receiver waits ACK_DELAY for something to ride on.
* After a break both sides say how far they got and the rest is sent again.

Layout (little endian): kind:u8, flags:u8, pad:u16, count:u32, number:u64, acknowledged:u64, then
length:u32 * count and the frames.  A frame larger than a datagram goes on in the next one.
"""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from fiber._wire.messages import ProtocolError

Frame: TypeAlias = bytes | bytearray

WINDOW = 2
"""Datagrams under way.  nng holds three messages of a pipe; one place is for acknowledgements."""

BUDGET = 256 * 1024
"""Bytes of frames in a datagram.  Over TLS larger ones are hardly faster, and delay the next."""

ACK_DELAY = 0.02
"""Seconds that an acknowledgement nobody waits for may wait for something to ride on."""

RESEND_MIN, RESEND_MAX = 1.0, 10.0
"""Bounds of the wait for an acknowledgement.  What follows tells of a loss much sooner, mostly."""

HEARTBEAT = 3.0
"""Seconds without sending after which a session says that it is alive."""

DATA, CONTROL = 1, 2

_ACK_NOW = 1
_CONTINUES = 2
_UNFINISHED = 4
_MISSING = 8

_HEADER = struct.Struct("<BBxxIQQ")
_LENGTH = 4


class Statistics(NamedTuple):
    """What a session holds now and has done so far."""

    queued_frames: int
    queued_bytes: int
    unacknowledged_datagrams: int
    unacknowledged_bytes: int
    partial_bytes: int
    frames_sent: int
    frames_received: int
    datagrams_sent: int
    datagrams_received: int
    bytes_sent: int
    bytes_received: int
    resent: int
    repeated: int
    missed: int
    breaks: int


@dataclass(slots=True)
class _Sent:
    number: int
    datagram: bytes
    at: float
    resent: bool = False


class Session:
    """One end of a session; begins disconnected."""

    def __init__(
        self,
        now: float,
        *,
        heartbeat: float = HEARTBEAT,
        window: int = WINDOW,
        budget: int = BUDGET,
    ) -> None:
        self._heartbeat = heartbeat
        self._tick = heartbeat / 3
        self._window = window
        self._budget = budget
        self._connected = False
        self._queue: deque[Frame] = deque()
        self._queued_bytes = 0
        self._offset = 0
        self._next = 1
        self._unacknowledged: deque[_Sent] = deque()
        self._acknowledged = 0
        self._received = 0
        self._partial: list[bytes] = []
        self._ack_due: float | None = None
        self._missing = False
        self._resend = False
        self._resend_due: float | None = None
        self._resend_after = RESEND_MIN
        self._backoff = 1.0
        self._round_trip = 0.0
        self._last_sent = self._ticked = now
        self._silent = 0.0
        self._counts = dict.fromkeys(Statistics._fields[5:], 0)

    @property
    def idle(self) -> bool:
        """Whether everything that was given to ``send`` is known to have arrived."""
        return not self._queue and not self._unacknowledged

    @property
    def arrived(self) -> int:
        """The number of the last datagram taken: what the peer must know to resume."""
        return self._received

    def send(self, frame: Frame) -> None:
        """Queue a frame; the next ``outgoing`` takes it along if there is room."""
        self._queue.append(frame)
        self._queued_bytes += len(frame)
        self._counts["frames_sent"] += 1

    def connected(self, arrived: int, now: float) -> None:
        """There is a link, and the peer has taken our datagrams up to ``arrived``."""
        if not self._acknowledged <= arrived < self._next:
            raise ProtocolError(
                f"it cannot resume after datagram {arrived}: it has acknowledged "
                f"{self._acknowledged} of {self._next - 1}"
            )
        self._connected = True
        self._acknowledge(arrived, now)
        self._resend = bool(self._unacknowledged)
        self._backoff = 1.0
        self._ack_due = None
        self._last_sent = now
        self._heard(now)

    def disconnected(self) -> None:
        """The link broke; what was under way counts as not arrived."""
        self._connected = False
        self._resend_due = self._ack_due = None
        self._counts["breaks"] += 1

    def outgoing(self, now: float) -> list[bytes]:
        """What to put on the link now."""
        if not self._connected:
            return []
        must_resend = self._resend or (self._resend_due is not None and self._resend_due <= now)
        again = self._again(now) if must_resend else []
        fresh = []
        while self._queue and len(self._unacknowledged) < self._window:
            fresh.append(self._pack(now))
        if self._missing or (not fresh and self._must_speak(now)):
            fresh.append(self._control())
        if fresh:  # a repetition carries the acknowledgement of its day
            self._ack_due = None
        datagrams = again + fresh
        if datagrams:
            self._last_sent = now
            self._counts["datagrams_sent"] += len(datagrams)
            self._counts["bytes_sent"] += sum(map(len, datagrams))
        return datagrams

    def received(self, datagram: bytes, now: float) -> list[Frame]:
        """Take a datagram from the link; the frames that it completes, in order.

        ProtocolError if no session can have sent it.
        """
        try:
            kind, flags, count, number, acknowledged = _HEADER.unpack_from(datagram)
        except struct.error:
            raise ProtocolError(f"a datagram of {len(datagram)} bytes has no header") from None
        if kind not in (DATA, CONTROL):
            raise ProtocolError(f"a datagram is of unknown kind {kind}")
        self._heard(now)
        self._counts["datagrams_received"] += 1
        self._counts["bytes_received"] += len(datagram)
        self._acknowledge(acknowledged, now)
        if kind == CONTROL:
            self._resend |= bool(flags & _MISSING and self._unacknowledged)
            return []
        return self._take(datagram, flags, count, number, now)

    def tick(self, now: float) -> float:
        """Seconds without a word from the peer, leaving out the time when this process did not run.

        To be called at ``next_timer``.  A stopped process must not take its own sleep for its
        peer's.
        """
        self._silent += min(now - self._ticked, 2 * self._tick)
        self._ticked = now
        return self._silent

    def next_timer(self) -> float:
        """When ``tick`` and ``outgoing`` want to be called again, if nothing happens before."""
        due = self._ticked + self._tick
        if self._connected:
            due = min(due, self._last_sent + self._heartbeat)
            if self._ack_due is not None:
                due = min(due, self._ack_due)
            if self._resend_due is not None:
                due = min(due, self._resend_due)
        return due

    def statistics(self) -> Statistics:
        """What it holds and has done."""
        return Statistics(
            queued_frames=len(self._queue),
            queued_bytes=self._queued_bytes,
            unacknowledged_datagrams=len(self._unacknowledged),
            unacknowledged_bytes=sum(len(sent.datagram) for sent in self._unacknowledged),
            partial_bytes=sum(map(len, self._partial)),
            **self._counts,
        )

    def _must_speak(self, now: float) -> bool:
        ack_is_due = self._ack_due is not None and self._ack_due <= now
        return ack_is_due or self._last_sent + self._heartbeat <= now

    def _again(self, now: float) -> list[bytes]:
        if not self._resend:  # it was the timer
            self._backoff *= 2
        self._resend = False
        for sent in self._unacknowledged:
            sent.resent = True
        self._counts["resent"] += len(self._unacknowledged)
        self._last_sent = now
        self._arm(now)
        return [sent.datagram for sent in self._unacknowledged]

    def _arm(self, now: float) -> None:
        wait = min(self._resend_after * self._backoff, RESEND_MAX)
        self._resend_due = now + wait if self._unacknowledged else None

    def _pack(self, now: float) -> bytes:
        """Number and wrap as many queued frames as fit."""
        flags = _CONTINUES if self._offset else 0
        chunks: list[Frame | memoryview] = []
        room = self._budget
        while self._queue and room > 0:
            frame = self._queue[0]
            left = len(frame) - self._offset
            whole = left <= room and not self._offset
            chunk = frame if whole else memoryview(frame)[self._offset : self._offset + room]
            chunks.append(chunk)
            room -= len(chunk) + _LENGTH
            self._queued_bytes -= len(chunk)
            if len(chunk) < left:
                self._offset += len(chunk)
                flags |= _UNFINISHED
                break
            self._queue.popleft()
            self._offset = 0
        if self._queue or len(self._unacknowledged) + 1 == self._window:
            flags |= _ACK_NOW
        return self._number(flags, chunks, now)

    def _number(self, flags: int, chunks: list[Frame | memoryview], now: float) -> bytes:
        count = len(chunks)
        head = _HEADER.pack(DATA, flags, count, self._next, self._received)
        lengths = struct.pack(f"<{count}I", *map(len, chunks))
        datagram = b"".join((head, lengths, *chunks))
        self._unacknowledged.append(_Sent(self._next, datagram, now))
        self._next += 1
        if self._resend_due is None:
            self._arm(now)
        return datagram

    def _control(self) -> bytes:
        flags = _MISSING if self._missing else 0
        self._missing = False
        return _HEADER.pack(CONTROL, flags, 0, 0, self._received)

    def _heard(self, now: float) -> None:
        self._silent = 0.0
        self._ticked = now

    def _acknowledge(self, arrived: int, now: float) -> None:
        if arrived >= self._next:
            raise ProtocolError(
                f"it acknowledges datagram {arrived}, but only {self._next - 1} were sent"
            )
        if arrived <= self._acknowledged:
            return
        self._acknowledged = arrived
        while self._unacknowledged and self._unacknowledged[0].number <= arrived:
            sent = self._unacknowledged.popleft()
            if not sent.resent:  # a repetition cannot tell which copy was acknowledged
                self._measured(now - sent.at)
        self._backoff = 1.0
        self._arm(now)

    def _measured(self, round_trip: float) -> None:
        self._round_trip += (round_trip - self._round_trip) / 8
        self._resend_after = max(RESEND_MIN, 3 * self._round_trip)

    def _take(
        self, datagram: bytes, flags: int, count: int, number: int, now: float
    ) -> list[Frame]:
        if number != self._received + 1:
            repeated = number <= self._received
            self._counts["repeated" if repeated else "missed"] += 1
            self._missing |= not repeated
            self._ack_due = now
            return []
        frames = self._unpack(datagram, flags, count)
        self._received = number
        self._counts["frames_received"] += len(frames)
        due = now if flags & _ACK_NOW else now + ACK_DELAY
        self._ack_due = due if self._ack_due is None else min(due, self._ack_due)
        return frames

    def _unpack(self, datagram: bytes, flags: int, count: int) -> list[Frame]:
        at = _HEADER.size + _LENGTH * count
        fits = count > 0 and at <= len(datagram)
        lengths = struct.unpack_from(f"<{count}I", datagram, _HEADER.size) if fits else ()
        if not fits or at + sum(lengths) != len(datagram):
            raise ProtocolError(
                f"a datagram of {len(datagram)} bytes does not hold the {count} frames it announces"
            )
        if bool(flags & _CONTINUES) != bool(self._partial):
            raise ProtocolError("a datagram does not go on where the one before it ended")
        chunks = []
        for length in lengths:
            chunks.append(datagram[at : at + length])
            at += length
        return self._join(chunks, flags)

    def _join(self, chunks: list[bytes], flags: int) -> list[Frame]:
        frames: list[Frame] = list(chunks)
        if flags & _CONTINUES:
            self._partial.append(chunks[0])
            if flags & _UNFINISHED and len(chunks) == 1:
                return []
            frames[0] = bytearray().join(self._partial)
            self._partial = []
        if flags & _UNFINISHED:
            self._partial = [chunks[-1]]
            frames.pop()
        return frames
