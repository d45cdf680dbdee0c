"""A frame put together from pieces, in memory that can be handed on without a copy.

The pieces of a large frame are written to a memfd as they arrive.  A packet that passes parts of
the frame on to a process of this host carries the memfd's descriptor and says where the parts lie.
"""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os

from fiber._wire.arena import DATA_OFFSET, HUGE_PAGES_UP_TO, Mapping
from fiber._wire.descriptor import Descriptor, opened

IN_FILE = 1 << 22
"""Bytes from which a frame gets a memfd.

A smaller one is copied once more on its way, into memory that is used again and again.
"""


class Assembly:
    """A frame of ``size`` bytes of which the pieces arrive in order.

    One that this process does not pass on has memory that is private to it, and costs half.
    """

    __slots__ = ("_memory", "_small", "arrived", "size")

    def __init__(self, size: int, *, passed_on: bool = True) -> None:
        self.size = size
        self.arrived = 0
        self._small = bytearray()
        self._memory = _memory(size, passed_on) if size >= IN_FILE else None

    def add(self, piece: memoryview) -> None:
        """Copy the next piece; ValueError if it is more than was announced."""
        begin = self.arrived
        self.arrived += len(piece)
        if self.arrived > self.size:
            raise ValueError(f"it has more than the {self.size} bytes that it announced")
        if self._memory is None:
            self._small += piece
        elif self._memory.owner is None:
            self._memory[DATA_OFFSET + begin : DATA_OFFSET + self.arrived] = piece
        else:
            # Half as expensive as a write to the mapping, which faults at every page.
            _write(self._memory.owner.fileno(), piece, DATA_OFFSET + begin)

    def frame(self) -> bytearray | memoryview:
        """Return the frame; ValueError if some of it is missing."""
        if self.arrived < self.size:
            raise ValueError(f"it ends after {self.arrived} of {self.size} bytes")
        return self._small if self._memory is None else memoryview(self._memory)[DATA_OFFSET:]


class Memory(Mapping):
    """Memory of one frame, laid out as an arena's block, which is not used again.

    It has no ``owner`` where it is not passed on, or where the system had no descriptor for it or
    lets this process write no files.
    """

    passes_on = False


def pass_on(view: memoryview) -> None:
    """Let packets refer to the memory of ``view``, which must not change from now on."""
    memory = view.obj
    if isinstance(memory, Memory):
        memory.passes_on = True


def place_of(view: memoryview) -> tuple[Descriptor, int] | None:
    """Return the descriptor that a packet may refer to instead of copying ``view``, and where in it
    that lies.
    """
    memory = view.obj
    if not isinstance(memory, Memory) or not memory.passes_on or memory.owner is None or not view:
        return None
    from fiber._wire.raw_memory import address  # few processes need it

    return memory.owner, address(view) - address(memoryview(memory))


def _memory(size: int, passed_on: bool) -> Memory:
    """OSError, ValueError or OverflowError if there is no room for so much."""
    total = DATA_OFFSET + size
    if not passed_on:
        return _private(total)
    try:
        flags = os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING
        owner = opened(os.memfd_create, "fiber-frame", flags)
        os.ftruncate(owner.fileno(), total)
        fcntl.fcntl(owner.fileno(), fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)  # as of every block
        memory = Memory(owner.fileno(), total)
    except OSError:
        return _private(total)
    memory.owner, memory.process = owner, os.getpid()
    return memory


def _private(total: int) -> Memory:
    memory = Memory(-1, total, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    memory.process = os.getpid()
    if total <= HUGE_PAGES_UP_TO:
        with contextlib.suppress(OSError):  # a kernel may have none
            memory.madvise(mmap.MADV_HUGEPAGE)
    return memory


def _write(fd: int, piece: memoryview, offset: int) -> None:
    done = 0
    while done < len(piece):
        done += os.pwrite(fd, piece[done:], offset + done)
