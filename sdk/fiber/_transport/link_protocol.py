"""Protocol of a link: frames, each once and in order, over one connection after the other.

A connection keeps the order of datagrams and loses none until it breaks.  Then datagrams on the way
may have arrived or not.  The protocol repeats them, and notices a silent peer.  It is pure: the
caller passes the time and carries the datagrams::

    send(frame) ─► queue ─► outgoing(now) ─► [datagram] ─────► received(datagram, now) ─► [frame]
                               ▲    │ unacknowledged                          │
                               └────┴──────────── acknowledgement ◄───────────┘

* Datagrams with frames have numbers from 1.  Every datagram also carries the number up to which all
  datagrams of the peer have arrived.  A receiver takes the next number.  A lower number is a
  repetition.  A higher one means that the connection lost a datagram: ``Gap``.
* The sender keeps datagrams until they are acknowledged, and repeats them on the next connection,
  where both sides first say how far they got.  It keeps at most WINDOW datagrams and WINDOW_BYTES.
  So a slow peer costs no more memory than that, and waiting frames travel together.
* Acknowledgements travel with other datagrams, within ACK_DELAY or a quarter of the window.

A frame that does not fit into a datagram travels in pieces.  Frames of different lanes take turns,
piece by piece, so a large frame keeps others waiting for one piece at most::

    small frames, and all without a lane   ──► first ─┐
    lane 1: large, small, large            ──► turn ──┼─► datagram
    lane 2: large                          ──► turn ──┘

* Frames of one lane keep their order.
* A frame never arrives before an earlier frame that has no lane.
* A frame that travels in pieces occupies one of SLOTS slots.  So the receiver assembles at most
  SLOTS frames at a time.

An entry of a datagram is a word and some bytes.  The word has 32 bits: length:24, slot:6, one for
the first piece of a frame, one for the last.  A first piece that is not the last begins with the
frame's size:u64.

Layout (little endian): kind:u8, pad:u24, count:u32, number:u64, acknowledged:u64, then a word:u32
for each of ``count`` entries, and their bytes.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from typing import NamedTuple, TypeAlias

from fiber._wire.memory_files import Assembly, BytesLike
from fiber._wire.messages import ProtocolError, is_passed_on

SLOTS = 64

LENGTH = (1 << 24) - 1
SLOT_SHIFT = 24
FIRST, LAST = 1 << 30, 1 << 31

WORD = 4
SIZE = struct.Struct("<Q")

Lane: TypeAlias = Hashable | None
Pieces: TypeAlias = Sequence[BytesLike]


class FramePiece(NamedTuple):
    """Frame, or a piece of one, in a datagram."""

    word: int
    pieces: Pieces
    size: int


class _Waiting:
    """Frame that waits, or the part of it that has not left."""

    __slots__ = ("after", "left", "on_left", "pieces", "size", "slot")

    def __init__(self, pieces: Pieces, on_left: Callable[[], None] | None) -> None:
        self.pieces = pieces
        self.size = self.left = sum(map(len, pieces))
        self.on_left = on_left
        self.slot: int | None = None
        self.after = 0
        """Number of frames of the first queue that leave before this one."""


class SendQueue:
    """Frames that wait to be sent.  ``budget``: limit of the bytes of a datagram's entries."""

    def __init__(self, budget: int) -> None:
        self._budget = budget
        self._first: deque[_Waiting] = deque()
        self._lanes: dict[Lane, deque[_Waiting]] = {}
        """Lanes in the order of their turns.  Each begins with a large frame."""
        self._added = self._gone = 0
        """Numbers of frames that have entered and left the first queue."""
        self._slots = list(range(SLOTS))
        self.bytes = 0

    def __len__(self) -> int:
        return len(self._first) + sum(map(len, self._lanes.values()))

    def __bool__(self) -> bool:
        return bool(self._first or self._lanes)

    def add(self, frame: Pieces, lane: Lane, on_left: Callable[[], None] | None) -> None:
        """Queue a frame; call ``on_left`` when its last piece goes into a datagram."""
        waiting = _Waiting(frame, on_left)
        self.bytes += waiting.size
        if self._lanes and lane in self._lanes:
            self._lanes[lane].append(waiting)
        elif lane is None or self._is_small(waiting):
            self._append(waiting)
        else:
            waiting.after = self._added
            self._lanes[lane] = deque([waiting])

    def clear(self) -> None:
        """Forget all frames."""
        self._first.clear()
        self._lanes.clear()
        self.bytes = 0

    def take(self) -> list[FramePiece]:
        """Remove and return the entries of the next datagram."""
        entries: list[FramePiece] = []
        # Half of the datagram is for large frames, so that many small ones do not stop them.
        room = self._fill(entries, self._budget, self._budget // 2 if self._lanes else 0)
        while self._lanes and (not entries or room >= self._budget // 4):
            lane = self._next_lane()
            if lane is None:
                break
            waiting_in_lane = self._lanes[lane]
            room = self._piece(entries, waiting_in_lane[0], room)
            if not waiting_in_lane[0].left:
                self._next_of(lane)
        return entries

    def _is_small(self, waiting: _Waiting) -> bool:
        return waiting.size + WORD <= self._budget

    def _append(self, waiting: _Waiting) -> None:
        self._first.append(waiting)
        self._added += 1

    def _fill(self, entries: list[FramePiece], room: int, reserved: int) -> int:
        """Take frames of the first queue while more than ``reserved`` bytes of room are left."""
        first = self._first
        while first and room > reserved:
            waiting = first[0]
            if waiting.slot is None and waiting.size + WORD <= room:
                entries.append(
                    FramePiece(FIRST | LAST | waiting.size, waiting.pieces, waiting.size)
                )
                room -= waiting.size + WORD
                self.bytes -= waiting.size
                waiting.left = 0
                if waiting.on_left is not None:
                    waiting.on_left()
            elif entries and (self._is_small(waiting) or room <= WORD + SIZE.size):
                break  # it goes into the next datagram
            elif self._claim_slot(waiting):
                room = self._piece(entries, waiting, room)
            if waiting.left:
                break
            first.popleft()
            self._gone += 1
        return room

    def _next_lane(self) -> Lane:
        for _ in range(len(self._lanes)):
            lane = next(iter(self._lanes))
            waiting_in_lane = self._lanes[lane] = self._lanes.pop(lane)
            if waiting_in_lane[0].after <= self._gone and self._claim_slot(waiting_in_lane[0]):
                return lane
        return None

    def _claim_slot(self, waiting: _Waiting) -> bool:
        if waiting.slot is None and self._slots:
            waiting.slot = self._slots.pop()
        return waiting.slot is not None

    def _piece(self, entries: list[FramePiece], waiting: _Waiting, room: int) -> int:
        """Take the next piece of a frame that has a slot."""
        assert waiting.slot is not None
        word = waiting.slot << SLOT_SHIFT
        head: Pieces = ()
        room -= WORD
        if waiting.left == waiting.size:
            word |= FIRST
            head = (SIZE.pack(waiting.size),)
            room -= SIZE.size
        taken, waiting.pieces = _split(waiting.pieces, room)
        size = sum(map(len, taken))
        waiting.left -= size
        self.bytes -= size
        if not waiting.left:
            word |= LAST
            self._slots.append(waiting.slot)
            if waiting.on_left is not None:
                waiting.on_left()
        length = size + (SIZE.size if head else 0)
        entries.append(FramePiece(word | length, (*head, *taken), length))
        return room - size

    def _next_of(self, lane: Lane) -> None:
        """Go on in a lane whose large frame at the head has left."""
        waiting_in_lane = self._lanes[lane]
        waiting_in_lane.popleft()
        while waiting_in_lane and self._is_small(waiting_in_lane[0]):
            self._append(waiting_in_lane.popleft())
        if waiting_in_lane:
            waiting_in_lane[0].after = self._added
        else:
            del self._lanes[lane]


def _split(frame: Pieces, room: int) -> tuple[Pieces, Pieces]:
    """Split a frame into the part that fits into ``room``, and the rest."""
    for index, piece in enumerate(frame):
        if len(piece) > room:
            view = memoryview(piece)
            return (*frame[:index], view[:room]), (view[room:], *frame[index + 1 :])
        room -= len(piece)
    return frame, ()


Frame: TypeAlias = bytes | bytearray | memoryview

Datagram: TypeAlias = bytes | tuple[BytesLike, ...]
"""Datagram to send: one piece, or several pieces that the connection joins."""

WINDOW = 256
WINDOW_BYTES = 4 << 20
"""Limits of datagrams, and of their bytes, that are sent and not acknowledged yet."""

LARGE = 1 << 14
"""Bytes from which a piece of a frame is not copied, but kept until it has arrived."""

BUDGET = 512 * 1024
"""Limit of the bytes of a datagram's entries.  A datagram is sealed while the last one is sent."""

ACK_DELAY = 0.02
"""Seconds that an acknowledgement may wait for a datagram to go with."""

HEARTBEAT = 3.0
"""Seconds without sending after which a side sends a heartbeat."""

DATA, CONTROL = 1, 2

_HEADER = struct.Struct("<BxxxIQQ")

LARGEST = _HEADER.size + BUDGET
"""Bytes of the longest datagram."""


class Gap(ProtocolError):
    """Error: the connection has lost a datagram and must be closed."""


class LinkStatistics(NamedTuple):
    """Counts of the frames and bytes that a link holds, and of its work so far."""

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


class LinkProtocol:
    """Protocol at one end of a link.  It begins without a connection."""

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
        self._queue = SendQueue(budget)
        self._sent = 0
        self._acknowledged = 0
        self._unacknowledged: deque[Datagram] = deque()
        """Datagrams from ``_acknowledged + 1`` to ``_sent``."""
        self._unacknowledged_bytes = 0
        self._repeat = False
        self._received = 0
        self._assemblies: list[Assembly | None] = [None] * SLOTS
        """Frames of which some pieces have arrived, by slot."""
        self.largest: int | None = None
        """Limit of the bytes of all frames that arrive in pieces at the same time."""
        self._ack_due: float | None = None
        self._unanswered = self._unanswered_bytes = 0
        """Datagrams, and their bytes, that arrived since this side last acknowledged."""
        self._last_sent = self._ticked = now
        self._speak_now = False
        self._silent = 0.0
        self._counts = dict.fromkeys(LinkStatistics._fields[5:], 0)

    @property
    def idle(self) -> bool:
        """True if all frames are known to have arrived."""
        return not self._queue and not self._unacknowledged

    @property
    def arrived(self) -> int:
        """Number of the last datagram that was taken.  The peer needs it to resume."""
        return self._received

    @property
    def has_received(self) -> bool:
        """True if the peer has ever sent a datagram."""
        return bool(self._counts["datagrams_received"])

    def send(
        self, *frame: BytesLike, lane: Lane = None, on_left: Callable[[], None] | None = None
    ) -> None:
        """Queue a frame, in pieces; the next ``outgoing`` contains it if there is room.

        ``on_left`` is called when its last piece leaves for the first time.  A piece must not
        change until it has left; a piece of LARGE bytes or more must not change until ``idle``.
        """
        self._queue.add(frame, lane, on_left)
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
        self._speak_now = True  # the peer trusts a connection only after a datagram

    def disconnected(self) -> None:
        """Note that the connection broke.  Datagrams on the way count as not arrived."""
        self._connected = False
        self._ack_due = None
        self._counts["breaks"] += 1

    def end(self) -> None:
        """Forget the frames of both sides that have not arrived."""
        self._queue.clear()
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
        elif self._must_speak(now):  # a repetition carries an old acknowledgement
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

        ProtocolError if it is malformed, ``Gap`` if an earlier datagram is missing.
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
        """Return the seconds of the peer's silence.

        Call it at ``next_timer``.  The time during which this process was stopped does not count:
        it says nothing about the peer.
        """
        self._silent += min(now - self._ticked, 2 * self._tick)
        self._ticked = now
        return self._silent

    def next_timer(self) -> float:
        """Return when to call ``tick`` and ``outgoing`` if no event comes before."""
        due = self._ticked + self._tick
        if self._connected:
            due = min(due, self._last_sent + self._heartbeat)
            if self._ack_due is not None:
                due = min(due, self._ack_due)
        return due

    def statistics(self) -> LinkStatistics:
        """Return the counts of this end."""
        return LinkStatistics(
            queued_frames=len(self._queue),
            queued_bytes=self._queue.bytes,
            unacknowledged_datagrams=len(self._unacknowledged),
            unacknowledged_bytes=self._unacknowledged_bytes,
            partial_bytes=sum(each.arrived for each in self._assemblies if each is not None),
            **self._counts,
        )

    def _may_send(self) -> bool:
        return (
            bool(self._queue)
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
        entries = self._queue.take()
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
                self._check_room_for(size)
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

    def _check_room_for(self, size: int) -> None:
        total = size + sum(each.size for each in self._assemblies if each is not None)
        if self.largest is not None and total > self.largest:
            raise ValueError(f"{total} bytes are announced, and {self.largest} may come")


def _size(datagram: Datagram) -> int:
    return len(datagram) if isinstance(datagram, bytes) else sum(map(len, datagram))
