"""Stream of frames, each once and in order, over one connection after the other.

A connection keeps the order and loses nothing until it breaks.  Then the datagrams under way may
have arrived or not.  The stream makes up for that, and notices a silent peer.  It is pure: the
caller passes the time and carries the datagrams::

    send(frame) ─► queue ─► outgoing(now) ─► [datagram] ─────► received(datagram, now) ─► [frame]
                               ▲    │ unacknowledged                          │
                               └────┴──────────── acknowledgement ◄───────────┘

* Datagrams with frames are numbered from 1; every datagram carries the number up to which
  everything arrived.  The next number is taken, an older one is a repetition.  A newer one means
  that the connection lost something, as none should: ``Gap``.
* What is not acknowledged is kept, and sent again on the next connection: both sides then say how
  far they got.  It is at most WINDOW datagrams and WINDOW_BYTES, so a peer that is slow, or a
  connection that stands still, costs no more memory than that; what waits travels together.
* Acknowledgements ride on what is sent anyway, within ACK_DELAY or a quarter of the window.

* Frames larger than a datagram take turns (``turns.py``).

Layout (little endian): kind:u8, pad:u24, count:u32, number:u64, acknowledged:u64, then a word:u32
for each of ``count`` entries, and their bytes.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

from fiber._transport.turns import FIRST, LAST, LENGTH, SIZE, SLOT_SHIFT, SLOTS, WORD, Lane, Turns
from fiber._wire.assembly import Assembly
from fiber._wire.messages import BytesLike, ProtocolError, is_passed_on

Frame: TypeAlias = bytes | bytearray | memoryview

Datagram: TypeAlias = bytes | tuple[BytesLike, ...]
"""Datagram to send: one piece, or several pieces that the connection joins."""

WINDOW = 256
WINDOW_BYTES = 4 << 20
"""Limits of datagrams, and of their bytes, that are sent and not acknowledged."""

LARGE = 1 << 14
"""Bytes from which on a piece of a frame is not copied.  The stream keeps it until it arrived."""

BUDGET = 512 * 1024
"""Bytes of entries in a datagram.  One datagram is sealed while the one before it is sent."""

ACK_DELAY = 0.02
"""Seconds that an acknowledgement may wait for a datagram to go with."""

HEARTBEAT = 3.0
"""Seconds without sending after which a stream sends a sign of life."""

DATA, CONTROL = 1, 2

_HEADER = struct.Struct("<BxxxIQQ")

LARGEST = _HEADER.size + BUDGET
"""Bytes of the longest datagram."""


class Gap(ProtocolError):
    """The connection has lost a datagram, and must be given up."""


class Statistics(NamedTuple):
    """Counts of what a stream holds now, and of what it has done so far."""

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


class ResumableStream:
    """End of a stream.  It begins without a connection."""

    def __init__(
        self,
        now: float,
        *,
        heartbeat: float = HEARTBEAT,
        window: int = WINDOW,
        window_bytes: int = WINDOW_BYTES,
        budget: int = BUDGET,
    ) -> None:
        self._heartbeat = heartbeat
        self._tick = heartbeat / 3
        self._window = window
        self._window_bytes = window_bytes
        self._connected = False
        self._turns = Turns(budget)
        self._sent = 0
        self._acknowledged = 0
        self._unacknowledged: deque[Datagram] = deque()
        """Datagrams from ``_acknowledged + 1`` to ``_sent``."""
        self._unacknowledged_bytes = 0
        self._repeat = False
        self._received = 0
        self._assemblies: list[Assembly | None] = [None] * SLOTS
        """Frames of which some pieces have arrived, by slot."""
        self._ack_due: float | None = None
        self._unanswered = self._unanswered_bytes = 0
        """Datagrams, and their bytes, that arrived since this side last acknowledged."""
        self._last_sent = self._ticked = now
        self._speak_now = False
        self._silent = 0.0
        self._counts = dict.fromkeys(Statistics._fields[5:], 0)

    @property
    def idle(self) -> bool:
        """True if all frames are known to have arrived."""
        return not self._turns and not self._unacknowledged

    @property
    def arrived(self) -> int:
        """Number of the last datagram taken.  The peer needs it to resume."""
        return self._received

    @property
    def heard(self) -> bool:
        """True if the peer has ever sent anything."""
        return bool(self._counts["datagrams_received"])

    def send(
        self, *frame: BytesLike, lane: Lane = None, on_left: Callable[[], None] | None = None
    ) -> None:
        """Queue a frame, in pieces; the next ``outgoing`` takes it along if there is room.

        ``on_left`` is called when the last of it goes out for the first time.  No piece may change
        until it has left, nor one from LARGE bytes on until ``idle``.
        """
        self._turns.add(frame, lane, on_left)
        self._counts["frames_sent"] += 1

    def connected(self, arrived: int) -> None:
        """Go on over a new connection, whose peer has taken the datagrams up to ``arrived``."""
        if not self._acknowledged <= arrived <= self._sent:
            raise ProtocolError(
                f"it cannot resume after datagram {arrived}: it has acknowledged "
                f"{self._acknowledged} of {self._sent}"
            )
        self._connected = True
        self._acknowledge(arrived)
        self._repeat = bool(self._unacknowledged)
        self._speak_now = True  # a connection alone says nothing: what comes over it does

    def disconnected(self) -> None:
        """Note that the connection broke.  Datagrams under way count as not arrived."""
        self._connected = False
        self._ack_due = None
        self._counts["breaks"] += 1

    def end(self) -> None:
        """Forget the frames that have not arrived on either side."""
        self._turns.clear()
        self._unacknowledged.clear()
        self._unacknowledged_bytes = 0
        self._assemblies = [None] * SLOTS

    def outgoing(self, now: float) -> list[Datagram]:
        """Return the datagrams to put on the connection now."""
        if not self._connected:
            return []
        datagrams: list[Datagram] = []
        if self._repeat:
            self._repeat = False
            datagrams += self._unacknowledged
            self._counts["resent"] += len(datagrams)
        fresh = len(datagrams)
        while self._may_send():
            datagrams.append(self._pack())
        if len(datagrams) > fresh:
            self._answered()
        elif self._must_speak(now):  # a repetition carries the acknowledgement of its day
            datagrams.append(_HEADER.pack(CONTROL, 0, self._sent, self._received))
            self._answered()
        if datagrams:
            self._last_sent = now
            self._counts["datagrams_sent"] += len(datagrams)
            self._counts["bytes_sent"] += sum(map(_size, datagrams))
        return datagrams

    def wants_to_speak(self, now: float) -> bool:
        """Tell whether ``outgoing`` would return a datagram."""
        return self._connected and (self._repeat or self._may_send() or self._must_speak(now))

    def received(self, datagram: BytesLike, now: float) -> list[Frame]:
        """Take a datagram from the connection; return copies of the frames that it completes.

        ProtocolError if no stream can have sent it, ``Gap`` if an earlier datagram is missing.
        """
        try:
            kind, count, number, acknowledged = _HEADER.unpack_from(datagram)
        except struct.error:
            raise ProtocolError(f"a datagram of {len(datagram)} bytes has no header") from None
        if kind not in (DATA, CONTROL):
            raise ProtocolError(f"a datagram is of unknown kind {kind}")
        if acknowledged > self._sent:
            raise ProtocolError(
                f"it acknowledges datagram {acknowledged}, but only {self._sent} were sent"
            )
        self._silent = 0.0
        self._ticked = now
        self._counts["datagrams_received"] += 1
        self._counts["bytes_received"] += len(datagram)
        self._acknowledge(acknowledged)
        if number > self._received + (kind == DATA):
            self._counts["missed"] += 1
            raise Gap(f"datagram {number} came where {self._received + 1} was expected")
        if kind == CONTROL:
            return []
        if number <= self._received:
            self._counts["repeated"] += 1
            self._ack_due = now
            return []
        return self._take(datagram, count, now)

    def tick(self, now: float) -> float:
        """Return the seconds of the peer's silence, without the time when this process was stopped.

        Call it at ``next_timer``.  A stopped process must not take its own sleep for a silence of
        its peer.
        """
        self._silent += min(now - self._ticked, 2 * self._tick)
        self._ticked = now
        return self._silent

    def next_timer(self) -> float:
        """Return when to call ``tick`` and ``outgoing`` again, if nothing happens before."""
        due = self._ticked + self._tick
        if self._connected:
            due = min(due, self._last_sent + self._heartbeat)
            if self._ack_due is not None:
                due = min(due, self._ack_due)
        return due

    def statistics(self) -> Statistics:
        """Return what the stream holds now, and what it has done so far."""
        return Statistics(
            queued_frames=len(self._turns),
            queued_bytes=self._turns.bytes,
            unacknowledged_datagrams=len(self._unacknowledged),
            unacknowledged_bytes=self._unacknowledged_bytes,
            partial_bytes=sum(each.arrived for each in self._assemblies if each is not None),
            **self._counts,
        )

    def _may_send(self) -> bool:
        return (
            bool(self._turns)
            and len(self._unacknowledged) < self._window
            and self._unacknowledged_bytes < self._window_bytes
        )

    def _must_speak(self, now: float) -> bool:
        ack_is_due = self._ack_due is not None and self._ack_due <= now
        return ack_is_due or self._speak_now or self._last_sent + self._heartbeat <= now

    def _answered(self) -> None:
        self._ack_due = None
        self._speak_now = False
        self._unanswered = self._unanswered_bytes = 0

    def _pack(self) -> Datagram:
        """Make the next datagram."""
        entries = self._turns.take()
        count = len(entries)
        self._sent += 1
        head = _HEADER.pack(DATA, count, self._sent, self._received)
        words = struct.pack(f"<{count}I", *[entry.word for entry in entries])
        pieces = [piece for entry in entries for piece in entry.pieces]
        whole = (head, words, *pieces)
        datagram = whole if max(map(len, pieces), default=0) >= LARGE else b"".join(whole)
        self._unacknowledged.append(datagram)
        self._unacknowledged_bytes += _size(datagram)
        return datagram

    def _acknowledge(self, arrived: int) -> None:
        while self._acknowledged < arrived:
            self._acknowledged += 1
            self._unacknowledged_bytes -= _size(self._unacknowledged.popleft())

    def _take(self, datagram: BytesLike, count: int, now: float) -> list[Frame]:
        frames = self._unpack(datagram, count)
        self._received += 1
        self._counts["frames_received"] += len(frames)
        self._unanswered += 1
        self._unanswered_bytes += len(datagram)
        many = 4 * self._unanswered >= self._window
        if many or 4 * self._unanswered_bytes >= self._window_bytes:
            self._ack_due = now
        elif self._ack_due is None:
            self._ack_due = now + ACK_DELAY
        return frames

    def _unpack(self, datagram: BytesLike, count: int) -> list[Frame]:
        at = _HEADER.size + WORD * count
        fits = count > 0 and at <= len(datagram)
        words = struct.unpack_from(f"<{count}I", datagram, _HEADER.size) if fits else ()
        if not fits or at + sum([word & LENGTH for word in words]) != len(datagram):
            raise ProtocolError(
                f"a datagram of {len(datagram)} bytes does not hold the {count} entries that it "
                "announces"
            )
        view = memoryview(datagram)
        frames: list[Frame] = []
        for word in words:
            end = at + (word & LENGTH)
            if word >= FIRST | LAST:
                frames.append(bytearray(view[at:end]))
            else:
                frames += self._assemble(word, view[at:end])
            at = end
        return frames

    def _assemble(self, word: int, piece: memoryview) -> list[Frame]:
        """Take a piece of a frame; return the frame if that was its last piece."""
        slot = (word >> SLOT_SHIFT) % SLOTS
        assembly = self._assemblies[slot]
        if bool(word & FIRST) != (assembly is None):
            raise ProtocolError(f"a piece does not go on where slot {slot} ended")
        try:
            if assembly is None:
                (size,) = SIZE.unpack_from(piece)
                piece = piece[SIZE.size :]
                assembly = Assembly(size, passed_on=is_passed_on(piece))
                self._assemblies[slot] = assembly
            assembly.add(piece)
            if not word & LAST:
                return []
            self._assemblies[slot] = None
            return [assembly.frame()]
        except (struct.error, ValueError, OverflowError, OSError) as error:
            raise ProtocolError(f"a frame in pieces cannot be put together: {error}") from error


def _size(datagram: Datagram) -> int:
    return len(datagram) if isinstance(datagram, bytes) else sum(map(len, datagram))
