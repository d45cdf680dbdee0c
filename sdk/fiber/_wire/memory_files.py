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
import weakref
from collections import deque
from collections.abc import Iterable
from ctypes import pythonapi
from typing import TypeAlias

from fiber._wire.descriptor import Descriptor, own
from fiber.errors import TooManyOpenFiles

BytesLike: TypeAlias = bytes | bytearray | memoryview

RETAINED_LIMIT = 1 << 25
"""Bytes of memory kept for later messages, per process.

A larger message gets new memory.
"""

RETAINED_BLOCKS = 32
"""Number of blocks that are kept.  Each holds two descriptors."""

HUGE_PAGES_UP_TO = 1 << 30
"""Bytes of a message up to which huge pages are requested.

Huge pages save a page fault for each 4 KiB, which costs several times the copy.  For a larger
message a virtual machine first has to get memory from its host, which is slower than small pages.
"""

DATA_OFFSET = 64
"""Bytes before the content of a block.  The first is the flag."""

_BUSY, _FREE = 1, 0
_CLEARED = bytes([_FREE])
_GRAIN = 1 << 16


class MessageBlock:
    """Memfd for one message, with its first page mapped for the flag."""

    __slots__ = ("_owner", "capacity", "fd", "flag")

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        flags = os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING
        self._owner = own(os.memfd_create("fiber-message", flags))
        self.fd = self._owner.fileno()
        # A reader that maps the content relies on the file's size.
        fcntl.fcntl(self.fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        os.ftruncate(self.fd, mmap.PAGESIZE)
        self.flag = mmap.mmap(self.fd, mmap.PAGESIZE)
        self.flag[0] = _BUSY

    def close(self) -> None:
        """Close the block.  A reader that has a descriptor keeps the content."""
        self.flag.close()
        self._owner.close()


class Arena:
    """Blocks of this process.  Any thread may use them; a forked child starts with none.

    There is no lock: a finalizer that sends a large message could wait for it on the same thread.
    A thread takes a block out, and owns it until it puts it back.
    """

    def __init__(self) -> None:
        self._blocks: deque[MessageBlock] = deque()
        os.register_at_fork(after_in_child=self._forget)

    def _forget(self) -> None:
        # Parent and child would otherwise both reuse the same free block.
        blocks, self._blocks = self._blocks, deque()
        for block in blocks:
            block.close()

    def claim(self, size: int) -> MessageBlock:
        """Return a busy block with room for ``size`` bytes.  Give it back with ``settle``."""
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
        """Put a block back after its message was ``sent`` or not; close it if it is not kept."""
        if not sent:
            block.flag[0] = _FREE
        if block.capacity > RETAINED_LIMIT:
            block.close()
            return
        self._blocks.append(block)
        while self._too_much():
            with contextlib.suppress(IndexError):  # other threads have taken them all
                self._blocks.popleft().close()

    def _too_much(self) -> bool:
        blocks = tuple(self._blocks)  # one step, as other threads change the deque
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
"""Bytes from which a thread gives memory back to the system: a gigabyte takes 0.2 s."""

_STEP = 1 << 24


class Mapping(mmap.mmap):
    """Memory of one message, and the owner of its descriptor."""

    owner: Descriptor | None = None
    process = 0
    """Id of the process that made it.  A fork of that process does not give it back."""

    def __del__(self) -> None:
        # At the interpreter's end a new thread does not run, and its start would wait for ever.
        if self.process == os.getpid() and len(self) >= SLOWLY and not sys.is_finalizing():
            with contextlib.suppress(RuntimeError):  # no thread: it is given back here
                threading.Thread(target=self._give_back, name="fiber-free", daemon=True).start()

    def _give_back(self) -> None:
        """Give the memory back while other threads of the interpreter run."""
        for start in range(0, len(self), _STEP):
            self.madvise(mmap.MADV_DONTNEED, start, min(_STEP, len(self) - start))
        self.close()
        if self.owner is not None:
            self.owner.close()  # now the system frees the content, on this thread


def mapping(memory: Descriptor, size: int) -> Mapping:
    """Map a message; MemoryError or TooManyOpenFiles if this process has no room for it."""
    try:
        mapped = Mapping(memory.fileno(), size)
    except OSError as error:
        if error.errno in (errno.EMFILE, errno.ENFILE):  # a mapping duplicates the descriptor
            raise TooManyOpenFiles("receiving a large message") from error
        if error.errno == errno.ENOMEM:
            raise MemoryError(f"no memory is left to receive a message of {size} bytes") from error
        raise
    mapped.owner, mapped.process = memory, os.getpid()
    return mapped


class _BorrowedBlock(Mapping):
    """Sender's block that a reader uses in place.  It is free again when its last view is gone."""

    def __del__(self) -> None:
        if self.process == os.getpid():
            self[0] = _FREE
            _free_borrows.append(None)
        super().__del__()


BORROWED_BLOCKS = 64
"""Limit of other processes' blocks that a process reads in place.  Each holds two descriptors."""

_free_borrows = deque([None] * BORROWED_BLOCKS)


def in_place(memory: Descriptor, size: int) -> memoryview | None:
    """Return a view of a sender's block, or None if the content has to be copied.

    It has to be copied if the sender could make the file shorter, because a process that reads
    beyond the end of a mapped file is killed, and if BORROWED_BLOCKS are in use.
    """
    try:
        if not fcntl.fcntl(memory.fileno(), fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK:
            return None
        _free_borrows.pop()
    except (OSError, IndexError):  # no memfd, or too many borrowed blocks
        return None
    try:
        borrowed = _BorrowedBlock(memory.fileno(), size)
    except OSError:  # no descriptor or mapping is left; a copy needs none
        _free_borrows.append(None)
        return None
    except BaseException:
        _free_borrows.append(None)
        raise
    borrowed.owner, borrowed.process = memory, os.getpid()
    return memoryview(borrowed)


IN_FILE = 1 << 22
"""Bytes from which a frame gets a memfd.

A smaller frame is copied once more on its way, into memory that is reused.
"""


class Assembly:
    """Frame of ``size`` bytes whose pieces arrive in order.

    A frame that is not ``passed_on`` to another process gets private memory, at half the cost.
    """

    __slots__ = ("_memory", "_small", "arrived", "size")

    def __init__(self, size: int, *, passed_on: bool = True) -> None:
        self.size = size
        self.arrived = 0
        self._small = bytearray()
        self._memory = _frame_memory(size, passed_on) if size >= IN_FILE else None

    def add(self, piece: memoryview) -> None:
        """Copy the next piece; ValueError if the frame gets longer than announced."""
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
        """Return the frame; ValueError if a piece is missing."""
        if self.arrived < self.size:
            raise ValueError(f"it ends after {self.arrived} of {self.size} bytes")
        return self._small if self._memory is None else memoryview(self._memory)[DATA_OFFSET:]


class FrameMemory(Mapping):
    """Memory of one frame, with the layout of an arena's block.  It is not reused.

    It has no ``owner`` if the frame is not passed on, if the system had no descriptor left, or if
    this process may write no files.
    """

    passes_on = False


def pass_on(view: memoryview) -> None:
    """Let packets refer to the memory of ``view``.  The memory must not change from now on."""
    memory = view.obj
    if isinstance(memory, FrameMemory):
        memory.passes_on = True


def place_of(view: memoryview) -> tuple[Descriptor, int] | None:
    """Return a descriptor and an offset that a packet may carry instead of a copy of ``view``.

    None if ``view`` has to be copied.
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
    """Return memory for a frame; OSError, ValueError or OverflowError if there is no room."""
    total = DATA_OFFSET + size
    if not passed_on:
        return _private_memory(total)
    try:
        flags = os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING
        owner = own(os.memfd_create("fiber-frame", flags))
        os.ftruncate(owner.fileno(), total)
        fcntl.fcntl(owner.fileno(), fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)  # as in a block
        memory = FrameMemory(owner.fileno(), total)
    except OSError:
        return _private_memory(total)
    memory.owner, memory.process = owner, os.getpid()
    return memory


def _private_memory(total: int) -> FrameMemory:
    memory = FrameMemory(-1, total, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    memory.process = os.getpid()
    if total <= HUGE_PAGES_UP_TO:
        with contextlib.suppress(OSError):  # not every kernel has them
            memory.madvise(mmap.MADV_HUGEPAGE)
    return memory


def _write_at(fd: int, piece: memoryview, offset: int) -> None:
    done = 0
    while done < len(piece):
        done += os.pwrite(fd, piece[done:], offset + done)


class Blob:
    """Bytes that many children need, named by the hash of their content.

    An agent keeps them for as long as the master has the object (``fiber._backends.remote``).
    """

    __slots__ = ("__weakref__", "_file", "data", "digest")

    def __init__(self, data: BytesLike) -> None:
        import hashlib  # few programs need it

        self.digest = hashlib.sha256(data).digest()
        self.data = data
        self._file: Descriptor | None = None

    @classmethod
    def in_file(cls, digest: bytes, data: BytesLike, directory: str | None) -> Blob:
        """Return a blob in a file on disk, because the memory of an agent's pod is limited.

        The file has no name, so no file is left when the agent is killed.  OSError if it cannot be
        written.
        """
        import tempfile

        blob = cls.__new__(cls)
        blob.digest, blob.data = digest, b""
        try:
            with tempfile.TemporaryFile(dir=directory) as file:
                blob._file = own(os.dup(file.fileno()))
        except FileNotFoundError:  # a user has removed the directory
            blob._file = own(os.memfd_create("fiber-blob"))
        _write_all(blob._file.fileno(), data)
        return blob

    def fileno(self) -> int:
        """Return the descriptor of a file that holds the bytes.  This object keeps it."""
        if self._file is None:
            file = own(os.memfd_create("fiber-blob"))
            _write_all(file.fileno(), self.data)
            self._file = file
        return self._file.fileno()


_shared: dict[int, tuple[weakref.ref[memoryview], Blob]] = {}
"""Blobs of buffers that many packets have, by the ids of the buffers."""


def share(buffer: memoryview) -> None:
    """Make a blob of a buffer, for as long as the buffer exists.  Any thread.

    Packets to other hosts then name the blob.  The bytes must not change.
    """
    key = id(buffer)
    gone = weakref.ref(buffer, lambda _: _shared.pop(key, None))
    _shared[key] = gone, Blob(buffer.cast("B"))  # a new view: the blob must not keep this one


def shared_blob(buffer: memoryview) -> Blob | None:
    """Return the blob of a buffer that is shared."""
    found = _shared.get(id(buffer))
    return found[1] if found is not None and found[0]() is buffer else None


def _write_all(fd: int, data: BytesLike) -> None:
    view, done = memoryview(data), 0
    while done < len(view):  # one write moves at most 2 GiB
        done += os.write(fd, view[done:])


_SIMPLE = 0

_MAPPED = 1 << 25
"""Bytes from which the C library gives an object separate pages."""

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
    """Return ``bytes(view)`` while other threads run: the copy of a gigabyte takes a second."""
    size = view.nbytes
    made: bytes = _new_bytes(None, size)
    if not made:
        return made
    # No other code has a reference to the new object yet, so it may be written to.
    target = _content(made)
    if _MAPPED <= size <= HUGE_PAGES_UP_TO:
        _use_huge_pages(target, size)
    memory = view.obj
    if isinstance(memory, Mapping) and memory.owner is not None:
        # Read the file: page faults in the mapping would cost as much as the copy.
        offset = address_of(view) - address_of(memoryview(memory))
        _read_into(memory.owner.fileno(), offset, target, size)
    else:
        ctypes.memmove(target, address_of(view), size)
    return made


def _use_huge_pages(start: int, size: int) -> None:
    begin = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE
    _advise(begin, start + size - begin, mmap.MADV_HUGEPAGE)  # fails if the kernel has none


def _read_into(fd: int, offset: int, target: int, size: int) -> None:
    """Read from a file to ``target``; ValueError if it ends too early."""
    view = memoryview((ctypes.c_char * size).from_address(target)).cast("B")
    done = 0
    while done < size:
        read = os.preadv(fd, [view[done : done + _COPY_STEP]], offset + done)
        if not read:
            raise ValueError(f"a large message ends after {done} of {size} bytes")
        done += read
