"""Memory that processes of one host share: *segments*, and the *blocks* that are pieces of them.

A segment is a memfd.  It has no name: whoever uses a block of it holds a descriptor, and the kernel
frees it once nobody does, whoever is killed.  A process maps it once, however many of its blocks it
uses.  A large block has a segment to itself, small ones of a size share segments.

No lock: a finalizer, a signal's handler or any thread may come at any line.  What they share are
operations that the interpreter does whole, and a block is for whoever has taken its place out.
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
from fiber._wire.descriptor import Descriptor, opened

SEGMENT = 1 << 20
"""Bytes of a segment that small blocks share; such as nobody wrote to take no memory."""

LARGE = 1 << 16
"""Bytes from which on a block has a segment to itself."""

ALIGNMENT = 64
"""Alignment of blocks, in bytes: each begins in its own line of the processor's cache."""

SIZES = tuple(ALIGNMENT << doubled for doubled in range(LARGE.bit_length() - 6))
"""Sizes of small blocks, in bytes.  A block of another size gets a place of the next larger one."""

# A mapping needs no descriptor of its own beside ours; before Python 3.13 it has one.
_UNTRACKED: dict[str, Any] = {"trackfd": False} if sys.version_info >= (3, 13) else {}


class Segment:
    """A memfd, mapped."""

    __slots__ = ("__weakref__", "_map", "_owner", "address", "inode", "size")

    def __init__(self, owner: Descriptor) -> None:
        self._owner = owner
        status = os.fstat(owner.fileno())
        self.inode = status.st_ino
        """Number that no other segment of this host has, while this one exists."""
        self.size = status.st_size
        self._map = mmap.mmap(owner.fileno(), self.size, **_UNTRACKED)
        self.address = ctypes.addressof(ctypes.c_char.from_buffer(self._map))

    def fileno(self) -> int:
        """Return the descriptor, which the segment keeps."""
        return self._owner.fileno()

    def view(self, offset: int, size: int) -> memoryview:
        """Part of its memory."""
        return memoryview(self._map)[offset : offset + size]


class Block:
    """A piece of shared memory; zeroed when it was allocated.

    Its memory stays as long as this object, or one that was pickled as it, is somewhere.  A block
    that never left this process is used again once it is forgotten: keep it while you use ``view``.
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
        """Another process may use it from here on."""
        if self._allocation is not None:
            self._allocation.given = True


class _Allocation:
    """Place of a small block.  It is reused after the block, unless other processes have it."""

    __slots__ = ("_forks", "_home", "_offset", "_segment", "given")

    def __init__(self, home: _SizeClass, segment: Segment, offset: int) -> None:
        self.given = False
        self._offset = offset
        self._segment = segment
        self._forks = _forks
        self._home = home

    def __del__(self) -> None:
        # Without ``_home``, ``__init__`` was interrupted.
        if hasattr(self, "_home") and not self.given and self._forks == _forks:
            self._home.free.append((self._segment, self._offset))


class _SizeClass:
    """Small blocks of one size."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.reset()

    def reset(self) -> None:
        """Begin with a new segment."""
        self.free: deque[tuple[Segment, int]] = deque()
        self._fresh: tuple[Segment, itertools.count[int]] | None = None

    def take(self) -> tuple[Segment, int]:
        """A place for a block."""
        try:
            segment, offset = self.free.pop()
        except IndexError:
            return self._take_fresh()
        ctypes.memset(segment.address + offset, 0, self.size)
        return segment, offset

    def _take_fresh(self) -> tuple[Segment, int]:
        while True:
            # Of two threads that make a segment at the same time, one wins; what the other one has
            # taken of its own stays good.
            fresh = self._fresh
            if fresh is None:
                segment = _new_segment("fiber-heap", SEGMENT)
                fresh = self._fresh = segment, itertools.count(0, self.size)
            segment, offset = fresh[0], next(fresh[1])
            if offset + self.size <= SEGMENT:
                return segment, offset
            self._fresh = None


def allocate(size: int) -> Block:
    """A new block of ``size`` bytes, all zero, at a multiple of ``ALIGNMENT``."""
    if size >= LARGE:
        return Block(_new_segment("fiber-block", size), 0, size)
    home = _size_classes[bisect.bisect_left(SIZES, size)]
    segment, offset = home.take()
    return Block(segment, offset, size, _Allocation(home, segment, offset))


def block_of(owner: Descriptor, offset: int, size: int) -> Block:
    """A block of the segment of which ``owner`` holds a descriptor."""
    block = Block(_mapped(owner), offset, size)
    if offset < 0 or size < 0 or offset + size > block.segment.size:
        raise ValueError(f"a segment of {block.segment.size} bytes has no {size} at {offset}")
    return block


def _new_segment(name: str, size: int) -> Segment:
    with naming_the_limit("sharing memory"):
        owner = opened(os.memfd_create, name, os.MFD_CLOEXEC)
        os.ftruncate(owner.fileno(), size)
        return _mapped(owner)


def _mapped(owner: Descriptor) -> Segment:
    inode = os.fstat(owner.fileno()).st_ino
    segment = _segments.get(inode)
    if segment is None:
        # Of two threads that come first at the same time each may map it: as good, but twice.
        with naming_the_limit("sharing memory"):
            segment = _segments[inode] = Segment(owner)
    return segment


_segments: weakref.WeakValueDictionary[int, Segment] = weakref.WeakValueDictionary()
_size_classes = [_SizeClass(size) for size in SIZES]
_forks = 0


def _before_fork() -> None:
    """The blocks that there are belong to two processes from here on."""
    global _forks
    _forks += 1


def _after_fork() -> None:
    """Our parent goes on with its segments; this process begins its own."""
    for blocks in _size_classes:
        blocks.reset()


os.register_at_fork(before=_before_fork, after_in_child=_after_fork)
