"""Memory for large packets, used again once its reader is done.

A fresh memfd costs a page fault for every 4 KiB written, several times the copy itself.  So a
sender keeps a few memfds; their first byte says whether a reader still needs what is in them.  The
reader copies the content out, or uses it where it is, and then clears the byte; a reader that dies
leaves it set, and the block is forgotten when its turn comes.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
import sys
import threading
from collections import deque
from collections.abc import Iterable

from fiber._wire.descriptor import Descriptor, opened
from fiber.errors import TooManyOpenFiles

RETAINED_LIMIT = 1 << 25
"""Bytes of memory kept for later messages, per process.

 Larger messages get memory of their own.
"""

RETAINED_BLOCKS = 32
"""Number of blocks that this memory is kept in.  Each holds two descriptors."""

HUGE_PAGES_UP_TO = 1 << 30
"""Bytes of a message for which huge pages are asked for.

They save a page fault for each 4 KiB, which costs several times the copy.  For more, a virtual
machine has to get memory back from its host first: that was slower than small pages.
"""

DATA_OFFSET = 64
"""Bytes before the content in a block.  The flag lies there."""

_BUSY, _FREE = 1, 0
_CLEARED = bytes([_FREE])
_GRAIN = 1 << 16


class Block:
    """Memfd, and its mapped page that holds the flag."""

    __slots__ = ("_owner", "capacity", "fd", "flag")

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        flags = os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING
        self._owner = opened(os.memfd_create, "fiber-message", flags)
        self.fd = self._owner.fileno()
        # Readers that map the content rely on its size.
        fcntl.fcntl(self.fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        os.ftruncate(self.fd, mmap.PAGESIZE)
        self.flag = mmap.mmap(self.fd, mmap.PAGESIZE)
        self.flag[0] = _BUSY

    def close(self) -> None:
        """Close the block.  A reader that has the descriptor keeps the content."""
        self.flag.close()
        self._owner.close()


class Arena:
    """Blocks of this process.  Any thread may use them; a forked child starts with none.

    There is no lock, as a finalizer that sends a large message could wait for it on its own thread.
    A thread takes a block out, and owns it until it puts it back.
    """

    def __init__(self) -> None:
        self._blocks: deque[Block] = deque()
        os.register_at_fork(after_in_child=self._forget)

    def _forget(self) -> None:
        # Parent and child would both believe that a free block is theirs alone.
        blocks, self._blocks = self._blocks, deque()
        for block in blocks:
            block.close()

    def claim(self, size: int) -> Block:
        """A block with room for ``size`` bytes, marked busy.  Give it back with ``settle``."""
        capacity = -(-size // _GRAIN) * _GRAIN
        for _ in range(len(self._blocks)):
            try:
                block = self._blocks.popleft()
            except IndexError:
                break
            if block.flag[0] == _FREE and size <= block.capacity <= 4 * capacity:
                block.flag[0] = _BUSY
                return block
            self._blocks.append(block)
        return Block(capacity)

    def settle(self, block: Block, *, sent: bool) -> None:
        """The message went out (``sent``) or did not; keep the block or let it go."""
        if not sent:
            block.flag[0] = _FREE
        if block.capacity > RETAINED_LIMIT:
            block.close()
            return
        self._blocks.append(block)
        while self._too_much():
            with contextlib.suppress(IndexError):  # others have taken them all
                self._blocks.popleft().close()

    def _too_much(self) -> bool:
        blocks = tuple(self._blocks)  # in one piece, whoever changes it meanwhile
        if len(blocks) > RETAINED_BLOCKS:
            return True
        return sum(block.capacity for block in blocks) > RETAINED_LIMIT


def fill(block: Block, parts: Iterable[memoryview], offsets: Iterable[int]) -> None:
    """Write each part at its offset."""
    for view, offset in zip(parts, offsets, strict=True):
        done = 0
        while done < view.nbytes:  # one write moves at most 2 GiB
            done += os.pwrite(block.fd, view[done:], offset + done)


def release(fd: int) -> None:
    """Tell the sender that the content of its block was copied out."""
    with contextlib.suppress(OSError):  # this process may write no file: RLIMIT_FSIZE is zero
        os.pwrite(fd, _CLEARED, 0)


SLOWLY = 1 << 27
"""Bytes of memory from which on a thread gives it back: for a gigabyte that takes 0.2 s."""

_STEP = 1 << 24


class Mapping(mmap.mmap):
    """Memory of one message, and the owner of its descriptor."""

    owner: Descriptor | None = None
    process = 0
    """Id of the process that made it.  A fork of that process does not give it back."""

    def __del__(self) -> None:
        # While the interpreter ends no thread begins any more, and its start would wait for that.
        if self.process == os.getpid() and len(self) >= SLOWLY and not sys.is_finalizing():
            with contextlib.suppress(RuntimeError):  # then it takes what it takes
                threading.Thread(target=self._give_back, name="fiber-free", daemon=True).start()

    def _give_back(self) -> None:
        """Give the memory back while other threads of the interpreter run."""
        for start in range(0, len(self), _STEP):
            self.madvise(mmap.MADV_DONTNEED, start, min(_STEP, len(self) - start))
        self.close()
        if self.owner is not None:
            self.owner.close()  # the last of it: the system frees the content, and we do not wait


def mapping(memory: Descriptor, size: int) -> Mapping:
    """Map a message; MemoryError or TooManyOpenFiles says that this process has no room for it."""
    try:
        mapped = Mapping(memory.fileno(), size)
    except OSError as error:
        if error.errno in (errno.EMFILE, errno.ENFILE):  # a mapping has a descriptor of its own
            raise TooManyOpenFiles("receiving a large message") from error
        if error.errno == errno.ENOMEM:
            raise MemoryError(f"no memory is left to receive a message of {size} bytes") from error
        raise
    mapped.owner, mapped.process = memory, os.getpid()
    return mapped


class _Lent(Mapping):
    """A sender's block as its reader has it: its sender's again once no view of it is left."""

    def __del__(self) -> None:
        if self.process == os.getpid():
            self[0] = _FREE
            _leave_to_lend.append(None)
        super().__del__()


LENT_BLOCKS = 64
"""Blocks of others that a process reads in place at a time; each holds two descriptors."""

_leave_to_lend = deque([None] * LENT_BLOCKS)


def in_place(memory: Descriptor, size: int) -> memoryview | None:
    """A sender's block, not copied; None if that has to be copied.

    That is so where the sender could make it shorter, since to read beyond the end of a file is the
    end of this process, and where LENT_BLOCKS are being read.
    """
    try:
        if not fcntl.fcntl(memory.fileno(), fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK:
            return None
        _leave_to_lend.pop()
    except (OSError, IndexError):  # no memfd at all, or enough of them
        return None
    try:
        lent = _Lent(memory.fileno(), size)
    except OSError:  # no descriptor or mapping is left: to copy it takes none
        _leave_to_lend.append(None)
        return None
    except BaseException:
        _leave_to_lend.append(None)
        raise
    lent.owner, lent.process = memory, os.getpid()
    return memoryview(lent)
