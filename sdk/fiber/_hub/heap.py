"""Heap: memory that processes of one host share, in *segments*, and *blocks* as pieces of them.

A segment is a memfd without a name.  Each process that uses a block of it holds a descriptor, and
the kernel frees the segment after the last descriptor, also when processes are killed.  A process
maps a segment once, for all its blocks.  A large block has a segment to itself; small blocks of one
size share segments.

There is no lock: a finalizer, a signal's handler or any thread may interrupt at any step.  Shared
state changes by single steps of the interpreter, and a thread owns the piece that it has taken out.
"""

from __future__ import annotations

import bisect
import ctypes
import itertools
import mmap
import os
import sys
import weakref
from collections import deque
from typing import Any

from fiber._transport.channels import naming_the_limit
from fiber._wire.descriptor import Descriptor, own

SEGMENT = 1 << 20
"""Bytes of a segment that small blocks share.  Pages that are never written take no memory."""

LARGE = 1 << 16
"""Bytes from which a block has a segment to itself."""

ALIGNMENT = 64
"""Alignment of blocks, in bytes: blocks share no cache line."""

SIZES = tuple(ALIGNMENT << doubled for doubled in range(LARGE.bit_length() - 6))
"""Sizes of small blocks, in bytes.  Another size is rounded up to the next of them."""

# From Python 3.13 a mapping does not need to duplicate the descriptor.
_UNTRACKED: dict[str, Any] = {"trackfd": False} if sys.version_info >= (3, 13) else {}


class Segment:
    """Memfd that this process has mapped."""

    __slots__ = ("__weakref__", "_map", "_owner", "address", "inode", "size")

    def __init__(self, owner: Descriptor) -> None:
        self._owner = owner
        status = os.fstat(owner.fileno())
        self.inode = status.st_ino
        """Number of the segment, unique on this host while the segment exists."""
        self.size = status.st_size
        self._map = mmap.mmap(owner.fileno(), self.size, **_UNTRACKED)
        self.address = ctypes.addressof(ctypes.c_char.from_buffer(self._map))

    def fileno(self) -> int:
        """Return the descriptor, which the segment keeps."""
        return self._owner.fileno()

    def view(self, offset: int, size: int) -> memoryview:
        """Return a view of a part of the memory."""
        return memoryview(self._map)[offset : offset + size]


class Block:
    """Piece of shared memory, zero when it is allocated.

    Its memory stays as long as this object, or an unpickled copy in any process, exists.  A block
    that never left this process is reused after this object: keep it while you use ``view``.
    """

    __slots__ = ("__weakref__", "_allocation", "offset", "segment", "size")

    def __init__(
        self, segment: Segment, offset: int, size: int, allocation: _Allocation | None = None
    ) -> None:
        self.segment = segment
        self.offset = offset
        self.size = size
        self._allocation = allocation

    @property
    def view(self) -> memoryview:
        """Memory of the block, as bytes to read and write."""
        return self.segment.view(self.offset, self.size)

    @property
    def address(self) -> int:
        """Address of the block in this process."""
        return self.segment.address + self.offset

    @property
    def identity(self) -> tuple[int, int]:
        """Identity that no other block of this host has, the same in every process."""
        return self.segment.inode, self.offset

    def give(self) -> None:
        """Note that another process may use the block from here on, so it is not reused."""
        if self._allocation is not None:
            self._allocation.given = True


class _Allocation:
    """Piece of a segment for a small block.  It is reused, unless other processes have it."""

    __slots__ = ("_forks", "_home", "_offset", "_segment", "given")

    def __init__(self, home: _SizeClass, segment: Segment, offset: int) -> None:
        self.given = False
        self._offset = offset
        self._segment = segment
        self._forks = _forks
        self._home = home

    def __del__(self) -> None:
        # ``_home`` is missing if ``__init__`` was interrupted.
        if hasattr(self, "_home") and not self.given and self._forks == _forks:
            self._home.free.append((self._segment, self._offset))


class _SizeClass:
    """Segments and free pieces for small blocks of one size."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.reset()

    def reset(self) -> None:
        """Begin with a new segment."""
        self.free: deque[tuple[Segment, int]] = deque()
        self._fresh: tuple[Segment, itertools.count[int]] | None = None

    def take(self) -> tuple[Segment, int]:
        """Return a zeroed piece for a block."""
        try:
            segment, offset = self.free.pop()
        except IndexError:
            return self._take_fresh()
        ctypes.memset(segment.address + offset, 0, self.size)
        return segment, offset

    def _take_fresh(self) -> tuple[Segment, int]:
        while True:
            # Two threads may each make a segment.  One becomes the current one; the piece that was
            # taken from the other stays valid.
            fresh = self._fresh
            if fresh is None:
                segment = _new_segment("fiber-heap", SEGMENT)
                fresh = self._fresh = segment, itertools.count(0, self.size)
            segment, offset = fresh[0], next(fresh[1])
            if offset + self.size <= SEGMENT:
                return segment, offset
            self._fresh = None


def allocate(size: int) -> Block:
    """Return a new block of ``size`` bytes, all zero, at a multiple of ``ALIGNMENT``."""
    if size >= LARGE:
        return Block(_new_segment("fiber-block", size), 0, size)
    home = _size_classes[bisect.bisect_left(SIZES, size)]
    segment, offset = home.take()
    return Block(segment, offset, size, _Allocation(home, segment, offset))


def block_of(owner: Descriptor, offset: int, size: int) -> Block:
    """Return a block of the segment of a descriptor; ValueError if it lies outside."""
    block = Block(_mapped(owner), offset, size)
    if offset < 0 or size < 0 or offset + size > block.segment.size:
        raise ValueError(f"a segment of {block.segment.size} bytes has no {size} at {offset}")
    return block


def _new_segment(name: str, size: int) -> Segment:
    with naming_the_limit("sharing memory"):
        owner = own(os.memfd_create(name, os.MFD_CLOEXEC))
        os.ftruncate(owner.fileno(), size)
        return _mapped(owner)


def _mapped(owner: Descriptor) -> Segment:
    inode = os.fstat(owner.fileno()).st_ino
    segment = _segments.get(inode)
    if segment is None:
        # Two threads may each map it at the same time: that works, and costs a second mapping.
        with naming_the_limit("sharing memory"):
            segment = _segments[inode] = Segment(owner)
    return segment


_segments: weakref.WeakValueDictionary[int, Segment] = weakref.WeakValueDictionary()
_size_classes = [_SizeClass(size) for size in SIZES]
_forks = 0


def _before_fork() -> None:
    """Count the fork: existing blocks belong to two processes from here on."""
    global _forks
    _forks += 1


def _after_fork() -> None:
    """Begin new segments in a forked process, as the parent uses the present ones."""
    for blocks in _size_classes:
        blocks.reset()


os.register_at_fork(before=_before_fork, after_in_child=_after_fork)
