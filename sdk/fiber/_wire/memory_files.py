"""Memory files: large messages, frames that arrive in pieces, and bytes that many children need.

A memory file (memfd) travels between processes of one host by its descriptor.

* An ``Arena`` keeps blocks for large packets.  A fresh memfd costs a page fault for every 4 KiB
  written, several times the copy itself.  So a sender reuses a few memfds.  Their first byte says
  whether a reader still needs the content.  The reader copies the content out, or uses it in place,
  and then clears the byte.  If a reader dies, the byte stays set, and the sender closes the block
  when its turn comes.
* An ``Assembly`` writes the pieces of a large frame to a memfd as they arrive.  A packet that
  passes parts of the frame on to a process of this host carries the memfd's descriptor and the
  position of each part.
* A ``Blob`` goes to each agent once, and to each child as a descriptor.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import mmap
import os
import sys
import threading
from collections import deque
from collections.abc import Iterable
from ctypes import pythonapi
from typing import TypeAlias

from fiber._wire.descriptor import Descriptor, opened, own
from fiber.errors import TooManyOpenFiles

BytesLike: TypeAlias = bytes | bytearray | memoryview

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


class MessageBlock:
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
        self._blocks: deque[MessageBlock] = deque()
        os.register_at_fork(after_in_child=self._forget)

    def _forget(self) -> None:
        # Parent and child would both believe that a free block is theirs alone.
        blocks, self._blocks = self._blocks, deque()
        for block in blocks:
            block.close()

    def claim(self, size: int) -> MessageBlock:
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
        return MessageBlock(capacity)

    def settle(self, block: MessageBlock, *, sent: bool) -> None:
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


def fill(block: MessageBlock, parts: Iterable[memoryview], offsets: Iterable[int]) -> None:
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


class _BorrowedBlock(Mapping):
    """A sender's block as its reader has it: its sender's again once no view of it is left."""

    def __del__(self) -> None:
        if self.process == os.getpid():
            self[0] = _FREE
            _free_borrows.append(None)
        super().__del__()


BORROWED_BLOCKS = 64
"""Blocks of others that a process reads in place at a time; each holds two descriptors."""

_free_borrows = deque([None] * BORROWED_BLOCKS)


def in_place(memory: Descriptor, size: int) -> memoryview | None:
    """A sender's block, not copied; None if that has to be copied.

    That is so where the sender could make it shorter, since to read beyond the end of a file is the
    end of this process, and where BORROWED_BLOCKS are being read.
    """
    try:
        if not fcntl.fcntl(memory.fileno(), fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK:
            return None
        _free_borrows.pop()
    except (OSError, IndexError):  # no memfd at all, or enough of them
        return None
    try:
        borrowed = _BorrowedBlock(memory.fileno(), size)
    except OSError:  # no descriptor or mapping is left: to copy it takes none
        _free_borrows.append(None)
        return None
    except BaseException:
        _free_borrows.append(None)
        raise
    borrowed.owner, borrowed.process = memory, os.getpid()
    return memoryview(borrowed)


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
        self._memory = _frame_memory(size, passed_on) if size >= IN_FILE else None

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
            _write_at(self._memory.owner.fileno(), piece, DATA_OFFSET + begin)

    def frame(self) -> bytearray | memoryview:
        """Return the frame; ValueError if some of it is missing."""
        if self.arrived < self.size:
            raise ValueError(f"it ends after {self.arrived} of {self.size} bytes")
        return self._small if self._memory is None else memoryview(self._memory)[DATA_OFFSET:]


class FrameMemory(Mapping):
    """FrameMemory of one frame, laid out as an arena's block, which is not used again.

    It has no ``owner`` where it is not passed on, or where the system had no descriptor for it or
    lets this process write no files.
    """

    passes_on = False


def pass_on(view: memoryview) -> None:
    """Let packets refer to the memory of ``view``, which must not change from now on."""
    memory = view.obj
    if isinstance(memory, FrameMemory):
        memory.passes_on = True


def place_of(view: memoryview) -> tuple[Descriptor, int] | None:
    """Return the descriptor that a packet may refer to instead of copying ``view``, and where in it
    that lies.
    """
    memory = view.obj
    if (
        not isinstance(memory, FrameMemory)
        or not memory.passes_on
        or memory.owner is None
        or not view
    ):
        return None
    return memory.owner, address_of(view) - address_of(memoryview(memory))


def _frame_memory(size: int, passed_on: bool) -> FrameMemory:
    """OSError, ValueError or OverflowError if there is no room for so much."""
    total = DATA_OFFSET + size
    if not passed_on:
        return _private_memory(total)
    try:
        flags = os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING
        owner = opened(os.memfd_create, "fiber-frame", flags)
        os.ftruncate(owner.fileno(), total)
        fcntl.fcntl(owner.fileno(), fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)  # as of every block
        memory = FrameMemory(owner.fileno(), total)
    except OSError:
        return _private_memory(total)
    memory.owner, memory.process = owner, os.getpid()
    return memory


def _private_memory(total: int) -> FrameMemory:
    memory = FrameMemory(-1, total, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    memory.process = os.getpid()
    if total <= HUGE_PAGES_UP_TO:
        with contextlib.suppress(OSError):  # a kernel may have none
            memory.madvise(mmap.MADV_HUGEPAGE)
    return memory


def _write_at(fd: int, piece: memoryview, offset: int) -> None:
    done = 0
    while done < len(piece):
        done += os.pwrite(fd, piece[done:], offset + done)


class Blob:
    """Bytes, named by their content.

    An agent has them for as long as the master has the object (``fiber._backends.remote``).
    """

    __slots__ = ("__weakref__", "_file", "data", "digest")

    def __init__(self, data: BytesLike) -> None:
        import hashlib  # most programs need none of it, nor what follows

        self.digest = hashlib.sha256(data).digest()
        self.data = data
        self._file: Descriptor | None = None

    @classmethod
    def in_file(cls, digest: bytes, data: BytesLike, directory: str | None) -> Blob:
        """Return a blob that lies on disk, as the memory of an agent's pod is limited; OSError.

        The file has no name, so that none is left when the agent is killed.
        """
        import tempfile

        blob = cls.__new__(cls)
        blob.digest, blob.data = digest, b""
        with tempfile.TemporaryFile(dir=directory) as file:
            blob._file = own(os.dup(file.fileno()))
        _write_all(blob._file.fileno(), data)
        return blob

    def fileno(self) -> int:
        """The descriptor of a file that holds the bytes; it stays this object's."""
        if self._file is None:
            file = opened(os.memfd_create, "fiber-blob")
            _write_all(file.fileno(), self.data)
            self._file = file
        return self._file.fileno()


def _write_all(fd: int, data: BytesLike) -> None:
    view, done = memoryview(data), 0
    while done < len(view):  # one write moves at most 2 GiB
        done += os.write(fd, view[done:])


_SIMPLE = 0

_MAPPED = 1 << 25
"""Bytes from which the C library gives an object memory that belongs to no other."""

_COPY_STEP = 1 << 26
"""Bytes that one system call copies."""


class _PyBuffer(ctypes.Structure):
    """``Py_buffer`` of the stable C API."""

    _fields_ = (
        ("buf", ctypes.c_void_p),
        ("obj", ctypes.c_void_p),
        ("len", ctypes.c_ssize_t),
        ("itemsize", ctypes.c_ssize_t),
        ("readonly", ctypes.c_int),
        ("ndim", ctypes.c_int),
        ("format", ctypes.c_char_p),
        ("shape", ctypes.c_void_p),
        ("strides", ctypes.c_void_p),
        ("suboffsets", ctypes.c_void_p),
        ("internal", ctypes.c_void_p),
    )


_new_bytes = pythonapi.PyBytes_FromStringAndSize
_new_bytes.argtypes = ctypes.c_char_p, ctypes.c_ssize_t
_new_bytes.restype = ctypes.py_object

_content = pythonapi.PyBytes_AsString
_content.argtypes = (ctypes.py_object,)
_content.restype = ctypes.c_void_p


def address_of(view: memoryview) -> int:
    """Return the address of ``view``'s memory, valid for as long as ``view`` exists."""
    buffer = _PyBuffer()
    pythonapi.PyObject_GetBuffer(ctypes.py_object(view), ctypes.byref(buffer), _SIMPLE)
    try:
        return buffer.buf or 0
    finally:
        pythonapi.PyBuffer_Release(ctypes.byref(buffer))


_advise = ctypes.CDLL(None).madvise
_advise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int


def copy_bytes(view: memoryview) -> bytes:
    """``bytes(view)``, during which other threads run: to copy a gigabyte takes a second."""
    size = view.nbytes
    made: bytes = _new_bytes(None, size)
    if not made:
        return made
    # A new object that no other code has seen may be written to.
    target = _content(made)
    if _MAPPED <= size <= HUGE_PAGES_UP_TO:
        _use_huge_pages(target, size)
    memory = view.obj
    if isinstance(memory, Mapping) and memory.owner is not None:
        # A read faults no page of the mapping, which would cost as much as the copy.
        offset = address_of(view) - address_of(memoryview(memory))
        _read_into(memory.owner.fileno(), offset, target, size)
    else:
        ctypes.memmove(target, address_of(view), size)
    return made


def _use_huge_pages(start: int, size: int) -> None:
    begin = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE
    _advise(begin, start + size - begin, mmap.MADV_HUGEPAGE)  # fails where a kernel has none


def _read_into(fd: int, offset: int, target: int, size: int) -> None:
    """Read from a file to ``target``; ValueError if it ends too early."""
    view = memoryview((ctypes.c_char * size).from_address(target)).cast("B")
    done = 0
    while done < size:
        read = os.preadv(fd, [view[done : done + _COPY_STEP]], offset + done)
        if not read:
            raise ValueError(f"a large message ends after {done} of {size} bytes")
        done += read
