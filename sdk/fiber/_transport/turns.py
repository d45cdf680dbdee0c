"""Frames that wait to be sent, and what of them goes into the next datagram.

A frame that does not fit into a datagram goes in pieces.  Frames of different lanes take turns, a
piece at a time, so that a large frame never keeps others waiting for more than a piece::

    small frames, and all without a lane   ──► first ─┐
    lane 1: large, small, large            ──► turn ──┼─► datagram
    lane 2: large                          ──► turn ──┘

* The frames of one lane keep their order.
* A frame never arrives before a frame without a lane that was sent earlier.
* A frame that travels in pieces occupies one of SLOTS slots.  So the receiver puts no more frames
  than that together at a time.

An entry of a datagram is a word and so many bytes.  The word, 32 bits: length:24, slot:6, whether
it is the frame's first piece, whether it is the last.  A first piece that is not the last begins
with the frame's size:u64.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from typing import NamedTuple, TypeAlias

from fiber._wire.messages import BytesLike

SLOTS = 64

LENGTH = (1 << 24) - 1
SLOT_SHIFT = 24
FIRST, LAST = 1 << 30, 1 << 31

WORD = 4
SIZE = struct.Struct("<Q")

Lane: TypeAlias = Hashable | None
Pieces: TypeAlias = Sequence[BytesLike]


class Entry(NamedTuple):
    """A frame, or a piece of one, in a datagram."""

    word: int
    pieces: Pieces
    size: int


class _Waiting:
    """Frame, or the part of it that has not left."""

    __slots__ = ("after", "left", "on_left", "pieces", "size", "slot")

    def __init__(self, pieces: Pieces, on_left: Callable[[], None] | None) -> None:
        self.pieces = pieces
        self.size = self.left = sum(map(len, pieces))
        self.on_left = on_left
        self.slot: int | None = None
        self.after = 0
        """Number of frames of the first queue that go before this one."""


class Turns:
    """Frames that wait.  ``budget``: bytes of a datagram's entries, with their words."""

    def __init__(self, budget: int) -> None:
        self._budget = budget
        self._first: deque[_Waiting] = deque()
        self._lanes: dict[Lane, deque[_Waiting]] = {}
        """Each begins with a large frame.  In the order of their turns."""
        self._added = self._gone = 0
        """Frames that have ever entered and left the first queue."""
        self._slots = list(range(SLOTS))
        self.bytes = 0

    def __len__(self) -> int:
        return len(self._first) + sum(map(len, self._lanes.values()))

    def __bool__(self) -> bool:
        return bool(self._first or self._lanes)

    def add(self, frame: Pieces, lane: Lane, on_left: Callable[[], None] | None) -> None:
        """Queue a frame; ``on_left`` is called when the last of it goes into a datagram."""
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

    def take(self) -> list[Entry]:
        """Take out what goes into the next datagram."""
        entries: list[Entry] = []
        # Large frames go on, however many small ones come.
        room = self._fill(entries, self._budget, self._budget // 2 if self._lanes else 0)
        while self._lanes and (not entries or room >= self._budget // 4):
            lane = self._whose_turn()
            if lane is None:
                break
            line = self._lanes[lane]
            room = self._piece(entries, line[0], room)
            if not line[0].left:
                self._next_of(lane)
        return entries

    def _is_small(self, waiting: _Waiting) -> bool:
        return waiting.size + WORD <= self._budget

    def _append(self, waiting: _Waiting) -> None:
        self._first.append(waiting)
        self._added += 1

    def _fill(self, entries: list[Entry], room: int, reserved: int) -> int:
        """Take from the first queue while more than ``reserved`` bytes of room are left."""
        first = self._first
        while first and room > reserved:
            waiting = first[0]
            if waiting.slot is None and waiting.size + WORD <= room:
                entries.append(Entry(FIRST | LAST | waiting.size, waiting.pieces, waiting.size))
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

    def _whose_turn(self) -> Lane:
        for _ in range(len(self._lanes)):
            lane = next(iter(self._lanes))
            line = self._lanes[lane] = self._lanes.pop(lane)
            if line[0].after <= self._gone and self._claim_slot(line[0]):
                return lane
        return None

    def _claim_slot(self, waiting: _Waiting) -> bool:
        if waiting.slot is None and self._slots:
            waiting.slot = self._slots.pop()
        return waiting.slot is not None

    def _piece(self, entries: list[Entry], waiting: _Waiting, room: int) -> int:
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
        entries.append(Entry(word | length, (*head, *taken), length))
        return room - size

    def _next_of(self, lane: Lane) -> None:
        """The large frame at the head of a lane has left."""
        line = self._lanes[lane]
        line.popleft()
        while line and self._is_small(line[0]):
            self._append(line.popleft())
        if line:
            line[0].after = self._added
        else:
            del self._lanes[lane]


def _split(frame: Pieces, room: int) -> tuple[Pieces, Pieces]:
    """Split a frame into as much as there is room for, and the rest."""
    for index, piece in enumerate(frame):
        if len(piece) > room:
            view = memoryview(piece)
            return (*frame[:index], view[:room]), (view[room:], *frame[index + 1 :])
        room -= len(piece)
    return frame, ()
