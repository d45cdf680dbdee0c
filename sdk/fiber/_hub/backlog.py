"""Small messages of a one-way channel that its socket has no room for, in shared memory.

::

    mutex │ head, tail, needed, … │ ring of records: length, payload

``head`` and ``tail`` count bytes and never go back.  A record is there once ``tail`` is behind it,
and taken once ``head`` is: a process that dies in between has put nothing and taken nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from fiber._hub import heap
from fiber._sync.robust_mutex import RobustMutex

HEAD, TAIL = 8, 9
"""Words.  Where they differ, there are records."""

_NEEDED = 10
"""Word: free bytes that a sender waits for, or 0.  While it waits, no other sender puts."""

AMBIGUOUS = 11
"""Word: whether the socket has messages behind a wake-up packet."""

UNANNOUNCED = 12
"""Word: whether a wake-up packet is missing."""

ROOM = 13
"""Word: the usual size of the socket's buffer."""

_HEADER = 128
_SIZE = heap.LARGE - 8  # small blocks share a segment, and with it a descriptor
_LENGTH = 4

_Result = TypeVar("_Result")


class Backlog:
    """The ring, as this process sees it.  Changed only within ``run``."""

    __slots__ = ("_capacity", "_data", "_mutex", "block", "words")

    def __init__(self, block: heap.Block) -> None:
        self.block = block
        self.words = block.view[:_HEADER].cast("q")
        self._data = block.view[_HEADER:]
        self._capacity = len(self._data)
        self._mutex = RobustMutex(block.address)

    @classmethod
    def create(cls) -> Backlog:
        """Make an empty one."""
        new = cls(heap.allocate(_SIZE))
        new._mutex.create()
        return new

    def run(self, action: Callable[[], _Result]) -> _Result:
        """Return what ``action`` returns, called while no other thread or process is in ``run``."""
        return self._mutex.run(action)

    def __bool__(self) -> bool:
        words = self.words
        return words[HEAD] != words[TAIL]

    def holds_one(self) -> bool:
        """Tell whether the next record is the last one."""
        head = self.words[HEAD]
        return head + _LENGTH + self._length(head) == self.words[TAIL]

    def fits(self, size: int) -> bool:
        """Tell whether a payload of ``size`` bytes fits in at all."""
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
            if words[TAIL] == tail:  # else a finalizer or a signal's handler has put meanwhile
                words[TAIL] = end
                return True

    def take(self, say_room: Callable[[], None]) -> bytes:
        """Remove the first record; first ``say_room`` if a sender waits and there will be room."""
        words = self.words
        while True:
            head = words[HEAD]
            start = head + _LENGTH
            end = start + self._length(head)
            payload = self._read(start, end)
            needed = words[_NEEDED]
            if needed and self._capacity - (words[TAIL] - end) >= needed:
                say_room()  # first: after a death here a sender looks once in vain
                words[_NEEDED] = 0
            if words[HEAD] == head:
                words[HEAD] = end
                return payload

    def need(self, size: int) -> None:
        """Note that a sender waits for room: all of it where the payload does not fit in."""
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
