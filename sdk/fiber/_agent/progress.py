"""The progress table: shared memory in which each pool worker notes its running task.

When a worker dies, its agent reads here which task to blame.  A note costs a store into memory.
"""

from __future__ import annotations

import itertools
import mmap
import os

_SLOT = 2  # words: sequence number of the batch, index of the task in it
_SLOTS = 1 << 16  # sparse: only pages that are used exist


class ProgressTable:
    """Slots of one agent's children, which share the memory by its descriptor."""

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
        """Return a cleared slot for a new child."""
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
        """Free the slot of a child that is gone."""
        self._free.append(slot)

    def slot(self, slot: int) -> memoryview:
        """Return the two words of a slot: sequence number (0: none) and index."""
        return self._words[slot * _SLOT : (slot + 1) * _SLOT]

    def running(self, slot: int) -> tuple[int, int] | None:
        """Return the sequence number and index that the child noted last, or None."""
        view = self.slot(slot)
        return (view[0], view[1]) if view[0] else None

    def close(self) -> None:
        """Unmap the memory and close its descriptor."""
        self._words.release()
        self._memory.close()
        os.close(self.fd)
