"""The progress table: shared memory in which each pool worker says which task it is running.

When a worker dies, its agent reads here which task to blame.  Saying so is one store into memory.
"""

from __future__ import annotations

import itertools
import mmap
import os

_SLOT = 2  # words: sequence number of the batch, index of the task in it
_SLOTS = 1 << 16  # sparse: only pages that are used exist


class ProgressTable:
    """Slots of one agent.  The memory is shared with its children by descriptor."""

    def __init__(self, fd: int | None = None) -> None:
        self.fd = os.memfd_create("fiber-progress", os.MFD_CLOEXEC) if fd is None else fd
        size = _SLOTS * _SLOT * 8
        try:
            if fd is None:
                os.ftruncate(self.fd, size)
            self._memory = mmap.mmap(self.fd, size)
        except BaseException:
            os.close(self.fd)
            raise
        self._words = memoryview(self._memory).cast("Q")
        self._free: list[int] = []
        self._next = itertools.count()

    def claim(self) -> int:
        """A slot for a new child, cleared."""
        try:
            slot = self._free.pop()  # in one step: several threads may be here
        except IndexError:
            slot = next(self._next)
            if slot >= _SLOTS:
                raise RuntimeError(
                    f"one agent runs at most {_SLOTS} pool workers at a time"
                ) from None
        view = self.slot(slot)
        view[0] = view[1] = 0
        return slot

    def release(self, slot: int) -> None:
        """The child is gone; its slot may be used again."""
        self._free.append(slot)

    def slot(self, slot: int) -> memoryview:
        """Two words: sequence number (0: none) and index."""
        return self._words[slot * _SLOT : (slot + 1) * _SLOT]

    def running(self, slot: int) -> tuple[int, int] | None:
        """What the child of this slot was last running."""
        view = self.slot(slot)
        return (view[0], view[1]) if view[0] else None

    def close(self) -> None:
        """Unmap it."""
        self._words.release()
        self._memory.close()
        os.close(self.fd)
