"""Messages between two processes of one host: each is one ``SOCK_SEQPACKET`` packet.

A packet arrives whole or not at all, also if several processes read or write the same socket.  So
processes share an end without a lock, and a reader that dies loses only the message that it read.
Small parts travel inside the packet.  Large parts lie in a memfd, whose descriptor travels with the
packet.

Layout (little endian)::

    kind:u8 = PLAIN     payload
    kind:u8 = PARTS     count:u32, payload length:u64, buffer lengths:u64 * count,
                        then payload and buffers, here or (IN_MEMFD) in the first descriptor
    kind:u8 = PASSED    the same, then the offset of each in the first descriptor:u64 (0 for the
                        payload: here); they came from another host and lie where they arrived
    kind:u8 = WAKE_UP   no message: a backlog has messages (``fiber._hub.one_way``)

Buffers are pickle protocol 5's out-of-band buffers (PEP 574).
"""

from __future__ import annotations

import errno
import operator
import os
import pickle
import socket
import struct
import threading
from collections.abc import Callable, Sequence
from functools import partial
from operator import is_not
from typing import Any, TypeAlias

from fiber._wire.descriptor import Descriptor, own
from fiber._wire.memory_files import (
    DATA_OFFSET,
    RETAINED_LIMIT,
    Arena,
    BytesLike,
    copy_bytes,
    fill,
    in_place,
    mapping,
    place_of,
    release,
)
from fiber.errors import ConnectionClosed, FileTooLarge, TooManyOpenFiles

INLINE_LIMIT = 1 << 16
"""Bytes of payload and buffers up to which a packet carries them itself."""

BULK = 1 << 18
"""Bytes above which a blocking sender waits until its message is read, as on a pipe."""

_BALLAST = memoryview(bytes(7 << 14))
"""Bytes that make a socket not writable: more than a quarter of its buffer.

That also holds for a buffer that has grown (net.core.wmem_default, doubled).
"""

OUT_OF_BAND_MIN = 1 << 16
"""Smaller buffers cost less inside the pickle than beside it."""

MAX_DESCRIPTORS = 250
"""Limit of descriptors in a packet.  The kernel takes 253; the memfd needs one."""

MAX_BUFFERS = 1024
"""Limit of out-of-band buffers in a message."""

PLAIN = b"\x00"
PARTS = 1
PARTS_IN_MEMFD = 2
PASSED = 3
WAKE_UP = 4

ALIGNMENT = 64
"""Alignment of parts in a descriptor, for vector loads."""

_PARTS = struct.Struct("<BIQ")
_SIZE = struct.Struct("<Q")
_FD = struct.Struct("i")
_RECEIVE = INLINE_LIMIT + len(_BALLAST) + 32768
_ANCILLARY = socket.CMSG_SPACE(_FD.size * (MAX_DESCRIPTORS + 1))
_CLOEXEC = int(socket.MSG_CMSG_CLOEXEC)
_DONTWAIT = int(socket.MSG_DONTWAIT) | _CLOEXEC
_DONTWAIT_TO_SEND = int(socket.MSG_DONTWAIT)
_ANCILLARY_ONE = socket.CMSG_SPACE(_FD.size)


_CALL: Callable[[Callable[[], Any]], Any] = operator.call
_FIRST: Callable[[bytearray], int] = operator.itemgetter(0)
_UNITS = bytes(int(kind != WAKE_UP) for kind in range(256))
"""Number of messages in a packet, by its kind."""
_Ancillary: TypeAlias = list[tuple[int, int, bytes]]
_Arguments: TypeAlias = tuple[tuple[bytearray], int, int]
"""Arguments of ``recvmsg_into``."""
_Received: TypeAlias = tuple[int, _Ancillary, int, Any]
"""Result of ``recvmsg_into``."""


class _ReceiveBuffer:
    """Memory to receive a packet into, and the arguments of ``recvmsg_into`` for it."""

    __slots__ = ("arguments", "data", "view")

    def __init__(self) -> None:
        self.data = bytearray(_RECEIVE)
        self.view = memoryview(self.data)
        self.arguments = ((self.data,), _ANCILLARY_ONE, _CLOEXEC)


class WakeUp(Exception):
    """Signal that a wake-up packet came in place of a message; ``sender`` is its descriptor."""

    def __init__(self, sender: Descriptor) -> None:
        super().__init__()
        self.sender = sender


class NothingYet(BlockingIOError):
    """Error: no message came within the receiver's time limit."""


class _FreeBuffers(threading.local):
    """Receive buffers of this thread that no message is using."""

    def __init__(self) -> None:
        self.free: list[_ReceiveBuffer] = []


_buffers = _FreeBuffers()
_arena = Arena()


class Message:
    """Received packet.

    A small ``payload`` is in memory of this thread: call ``release`` (or ``loads``) soon.
    """

    __slots__ = ("_buffer", "buffers", "fds", "payload")

    def __init__(
        self,
        payload: memoryview,
        buffers: list[memoryview],
        fds: list[int],
        buffer: _ReceiveBuffer | None = None,
    ) -> None:
        self.payload = payload
        self.buffers = buffers
        self.fds = fds
        self._buffer = buffer

    def release(self) -> None:
        """Give the memory back to this thread.  The payload must not be used afterwards."""
        buffer, self._buffer = self._buffer, None  # first: a signal must not give it back twice
        if buffer is not None:
            _buffers.free.append(buffer)

    def tobytes(self) -> bytes:
        """Copy the payload out and release the message."""
        large = self.payload.nbytes > INLINE_LIMIT
        data = large_bytes(self.payload) if large else self.payload.tobytes()
        self.release()
        return data

    def close_descriptors(self) -> None:
        """Close the descriptors of the packet that the caller did not take."""
        for fd in self.fds:
            os.close(fd)
        self.fds = []


def dumps(obj: Any, dump: Callable[..., bytes] = pickle.dumps) -> tuple[bytes, list[memoryview]]:
    """Pickle ``obj``; return the pickle and its large contiguous buffers (NumPy arrays).

    If ``obj`` is large bytes, or a tuple that contains large bytes, these are buffers too.
    """
    buffers: list[memoryview] = []

    def keep_in_band(buffer: pickle.PickleBuffer) -> bool:
        raw = buffer.raw()
        if raw.nbytes < OUT_OF_BAND_MIN:
            return True
        buffers.append(raw)
        return False

    if _has_large_bytes(obj):
        obj = _light(obj, {})
    return dump(obj, protocol=5, buffer_callback=keep_in_band), buffers


def kept(buffers: Sequence[memoryview]) -> list[memoryview]:
    """Return the buffers, with a copy of each that its owner may change."""
    return [view if type(view.obj) is bytes else memoryview(bytes(view)) for view in buffers]


class _Large:
    """Placeholder for large bytes, which the pickle does not copy."""

    __slots__ = ("_data",)

    def __init__(self, data: bytes) -> None:
        self._data = data

    def __reduce__(self) -> tuple[Callable[..., bytes], tuple[pickle.PickleBuffer]]:
        return large_bytes, (pickle.PickleBuffer(self._data),)


def large_bytes(buffer: BytesLike) -> bytes:
    """Return the bytes of a ``_Large``.  Unpickling calls it."""
    if isinstance(buffer, bytes):  # they are part of the pickle
        return buffer
    return copy_bytes(memoryview(buffer))


def _has_large_bytes(obj: Any, depth: int = 2) -> bool:
    """Return False if ``_light`` would replace nothing, which is so for nearly all messages."""
    kind = type(obj)
    if kind is tuple and len(obj) <= MAX_BUFFERS:
        for each in obj:
            kind = type(each)
            if kind is bytes and len(each) >= OUT_OF_BAND_MIN:
                return True
            if kind is tuple and depth > 1 and _has_large_bytes(each, depth - 1):
                return True
        return False
    return kind is bytes and len(obj) >= OUT_OF_BAND_MIN


def _light(obj: Any, known: dict[int, _Large], depth: int = 2) -> Any:
    """Replace large bytes by ``_Large``: ``obj`` itself, and bytes in tuples."""
    kind = type(obj)
    if kind is bytes and len(obj) >= OUT_OF_BAND_MIN:
        return known.setdefault(id(obj), _Large(obj))
    if kind is tuple and depth and len(obj) <= MAX_BUFFERS:
        light = [_light(each, known, depth - 1) for each in obj]
        return tuple(light) if any(map(is_not, light, obj)) else obj
    return obj


def loads(message: Message) -> Any:
    """Unpickle a message and release it."""
    try:
        return pickle.loads(message.payload, buffers=message.buffers)
    finally:
        message.release()


def send(
    sock: socket.socket,
    payload: BytesLike,
    buffers: Sequence[memoryview] = (),
    fds: Sequence[int] = (),
    *,
    ballast: bool = False,
    wait: bool = True,
) -> bool:
    """Send one packet.

    Without ``wait``, or on a non-blocking socket, BlockingIOError means that nothing was sent.
    BrokenPipeError means that no process can ever read the packet.  ``fds`` (at most
    MAX_DESCRIPTORS) are duplicated into the process that receives the packet.

    With ``ballast``, a message above BULK fills so much of the socket's buffer that the socket is
    not writable until the message is read.  Return True for such a message.
    """
    size = _size(payload)
    flags = 0 if wait else _DONTWAIT_TO_SEND
    try:
        if not buffers and not fds and size <= INLINE_LIMIT:
            if size < 2048 and isinstance(payload, bytes):
                sock.send(PLAIN + payload, flags)
            else:
                sock.sendmsg((PLAIN, payload), (), flags)
        else:
            total = size + sum(view.nbytes for view in buffers)
            weight: BytesLike = b""
            if ballast and total > BULK:
                room = sock.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)
                weight = _BALLAST[: room // 4 + 1]
            _send_parts(sock, payload, size, buffers, fds, weight, flags)
            return bool(weight)
    except ConnectionResetError as error:
        raise BrokenPipeError(errno.EPIPE, "the other end is closed") from error
    except OSError as error:
        if error.errno in (errno.EMFILE, errno.ENFILE, errno.ETOOMANYREFS):
            raise TooManyOpenFiles("sending a message") from error
        if error.errno == errno.EFBIG:
            raise FileTooLarge("sending a message") from error
        raise
    return False


def is_bulky(payload: BytesLike, buffers: Sequence[memoryview]) -> bool:
    """Tell whether a message is larger than BULK."""
    return size_of(payload, buffers) > BULK


def size_of(payload: BytesLike, buffers: Sequence[memoryview]) -> int:
    """Return the bytes of a message's payload and buffers together."""
    return _size(payload) + sum(view.nbytes for view in buffers)


def _size(payload: BytesLike) -> int:
    return len(payload) if isinstance(payload, bytes) else memoryview(payload).nbytes


def check_buffers(buffers: Sequence[memoryview]) -> None:
    """Raise ValueError if a message has too many buffers."""
    if len(buffers) > MAX_BUFFERS:
        raise ValueError(
            f"a message has {len(buffers)} out-of-band buffers; at most {MAX_BUFFERS} are sent"
        )


def _send_parts(
    sock: socket.socket,
    payload: BytesLike,
    size: int,
    buffers: Sequence[memoryview],
    fds: Sequence[int],
    ballast: BytesLike,
    flags: int,
) -> None:
    check_buffers(buffers)
    sizes = [view.nbytes for view in buffers]
    table = b"".join(map(_SIZE.pack, sizes))
    if size + sum(sizes) <= INLINE_LIMIT:
        head = _PARTS.pack(PARTS, len(sizes), size) + table
        _sendmsg(sock, [head, payload, *buffers], fds, flags)
        return
    if _pass_on(sock, payload, buffers, fds, [size, *sizes], ballast, flags):
        return
    offsets, total = _offsets([size, *sizes])
    head = _PARTS.pack(PARTS_IN_MEMFD, len(sizes), size) + table
    block = _arena.claim(total)
    try:
        fill(block, [memoryview(payload).cast("B"), *buffers], offsets)
        _sendmsg(sock, [head, ballast], [block.fd, *fds], flags)
    except BlockingIOError:
        _arena.settle(block, sent=False)
        raise
    # Any other error may come from a signal's handler after the packet was sent: forget the block.
    _arena.settle(block, sent=True)


def _pass_on(
    sock: socket.socket,
    payload: BytesLike,
    buffers: Sequence[memoryview],
    fds: Sequence[int],
    sizes: list[int],
    ballast: BytesLike,
    flags: int,
) -> bool:
    """Send the descriptor of the memory in which the parts arrived from another host.

    Return False if they lie elsewhere.
    """
    inline = sizes[0] <= INLINE_LIMIT
    offsets = [0] * inline
    owner = None
    for view in buffers if inline else [memoryview(payload), *buffers]:
        place = place_of(view)
        if place is None or owner not in (None, place[0]):
            return False
        owner = place[0]
        offsets.append(place[1])
    if owner is None:
        return False
    table = b"".join(map(_SIZE.pack, [*sizes[1:], *offsets]))
    head = _PARTS.pack(PASSED, len(buffers), sizes[0]) + table
    parts = [head, payload if inline else b"", ballast]
    _sendmsg(sock, parts, [owner.fileno(), *fds], flags)
    return True


def send_wake_up(sock: socket.socket, sender: int) -> None:
    """Send a wake-up packet with the descriptor ``sender`` in it, if there is room."""
    _sendmsg(sock, [bytes([WAKE_UP])], [sender], _DONTWAIT_TO_SEND)


def _sendmsg(
    sock: socket.socket, parts: Sequence[BytesLike], fds: Sequence[int], flags: int
) -> None:
    if not fds:
        sock.sendmsg(parts, (), flags)
        return
    rights = struct.pack(f"{len(fds)}i", *fds)
    sock.sendmsg(parts, [(socket.SOL_SOCKET, socket.SCM_RIGHTS, rights)], flags)


def _offsets(sizes: Sequence[int]) -> tuple[list[int], int]:
    """Return the aligned offset of each part in a block, and the end of the last part."""
    offsets, end = [], DATA_OFFSET
    for size in sizes:
        start = -(-end // ALIGNMENT) * ALIGNMENT
        offsets.append(start)
        end = start + size
    return offsets, end


def receive_object(sock: socket.socket) -> Any:
    """Return ``loads(receive(sock))``; for a small packet without a Message between them.

    NothingYet on a socket with a time limit for receivers.
    """
    free = _buffers.free
    buffer = free.pop() if free else _ReceiveBuffer()
    try:
        received = _recvmsg(sock, buffer.arguments)
    except OSError as error:
        free.append(buffer)
        if isinstance(error, BlockingIOError):
            raise NothingYet(*error.args) from None
        raise
    size = received[0]
    if size and not buffer.data[0]:
        try:
            return pickle.loads(buffer.view[1:size])
        finally:
            free.append(buffer)
    return loads(_receive_parts(buffer, received))


def receive(
    sock: socket.socket,
    *,
    descriptors: bool = False,
    wait: bool = True,
    passing: bool = False,
    counter: int | None = None,
) -> Message:
    """Receive one packet; ConnectionClosed if no process can ever send again.

    Without ``wait``, or on a non-blocking socket, BlockingIOError means that there is no packet.
    ``descriptors`` makes room for descriptors that the sender attached; without it only the memfd
    of a large message is taken.  ``passing`` says that the caller passes the message on or copies
    it soon: a large one then stays in the sender's memory, which the sender does not reuse until
    then.  ``counter`` is an eventfd that is raised by one as soon as there is a message: no
    signal's handler runs in between.
    """
    space = _ANCILLARY if descriptors else _ANCILLARY_ONE
    free = _buffers.free
    buffer = free.pop() if free else _ReceiveBuffer()
    try:
        flags = _CLOEXEC if wait else _DONTWAIT
        received = _recvmsg(sock, ((buffer.data,), space, flags), counter)
    except OSError:
        free.append(buffer)
        raise
    size = received[0]
    if size and not buffer.data[0]:
        if size > INLINE_LIMIT + 1:  # ``tobytes`` would take it for separate memory
            free.append(buffer)
            raise ValueError(f"a small message of {size} bytes")
        return Message(buffer.view[1:size], [], [], buffer)
    return _receive_parts(buffer, received, passing=passing)


def _recvmsg(sock: socket.socket, arguments: _Arguments, counter: int | None = None) -> _Received:
    try:
        return _recvmsg_once(sock, arguments, counter)
    except ConnectionResetError:
        # The peer closed before it had read all packets of this side.  The kernel reports that
        # once, before it delivers the peer's packets.  The next call returns these, or the end.
        return _recvmsg_once(sock, arguments, counter)


def _recvmsg_once(sock: socket.socket, arguments: _Arguments, counter: int | None) -> _Received:
    if counter is None:
        return sock.recvmsg_into(*arguments)
    # All calls are one step of the interpreter: no signal's handler runs in between.
    buffers = arguments[0]
    buffers[0][0] = WAKE_UP  # the end is no message either
    kinds = map(_FIRST, buffers)
    counting = map(os.eventfd_write, (counter,), map(_UNITS.__getitem__, kinds))
    steps: list[Callable[[], Any]] = [
        partial(sock.recvmsg_into, *arguments),
        partial(next, counting),
    ]
    received: _Received
    received, _ = map(_CALL, steps)
    return received


def _rights(ancillary: _Ancillary) -> list[int]:
    """Return the descriptors that came with the packet."""
    return [
        fd
        for level, kind, data in ancillary
        if kind == socket.SCM_RIGHTS and level == socket.SOL_SOCKET
        for (fd,) in _FD.iter_unpack(data[: len(data) // _FD.size * _FD.size])
    ]


def _receive_parts(
    buffer: _ReceiveBuffer, received: _Received, *, passing: bool = False
) -> Message:
    size, ancillary, flags, _ = received
    view = buffer.view
    message = Message(view[:0], [], _rights(ancillary), buffer)
    try:
        if not size:
            raise ConnectionClosed()
        if flags & socket.MSG_CTRUNC:
            # The sender attached descriptors, and this process may open no more files.
            raise TooManyOpenFiles("receiving a descriptor")
        kind, count, length = _PARTS.unpack_from(view)
        has_memory = kind in (PARTS_IN_MEMFD, PASSED, WAKE_UP) and message.fds
        memory = own(message.fds.pop(0)) if has_memory else None
        if kind == WAKE_UP and memory is not None:
            raise WakeUp(memory)
        offset = _PARTS.size + _SIZE.size * count
        sizes = [length, *(n for (n,) in _SIZE.iter_unpack(view[_PARTS.size : offset]))]
        if kind == PARTS:
            return _inline_parts(view[offset:size], sizes, message)
        if memory is None:
            raise ValueError("a large message without its memory")
        if kind == PASSED:
            return _passed_parts(view[offset:size], sizes, message, memory)
        return _memory_parts(sizes, message, memory, passing=passing)
    except BaseException:
        message.close_descriptors()
        message.release()
        raise


def _inline_parts(body: memoryview, sizes: list[int], message: Message) -> Message:
    payload, offset = body[: sizes[0]], sizes[0]
    for length in sizes[1:]:
        message.buffers.append(memoryview(bytearray(body[offset : offset + length])))
        offset += length
    message.payload = payload
    return message


def _memory_parts(
    sizes: list[int], message: Message, memory: Descriptor, *, passing: bool
) -> Message:
    """Return the parts in the sender's block.

    They are copied, which frees the block.  A large block is mapped instead, and not reused.  A
    caller that is ``passing`` them on may use them in place.
    """
    offsets, total = _offsets(sizes)
    mapped = in_place(memory, total) if passing else None
    if total > RETAINED_LIMIT and mapped is None:
        mapped = memoryview(mapping(memory, total))
    if mapped is not None:
        views = [mapped[at : at + size] for at, size in zip(offsets, sizes, strict=True)]
    else:
        fd = memory.fileno()
        views = [_copy_out(fd, at, size) for at, size in zip(offsets, sizes, strict=True)]
        release(fd)
    message.release()
    return Message(views[0], views[1:], message.fds)


def _passed_parts(
    rest: memoryview, sizes: list[int], message: Message, memory: Descriptor
) -> Message:
    """Return parts that came from another host: mapped if they are large, else copied."""
    table = _SIZE.size * len(sizes)
    offsets = [offset for (offset,) in _SIZE.iter_unpack(rest[:table])]
    places = list(zip(offsets, sizes, strict=True))
    end = max(map(sum, places))
    if end > RETAINED_LIMIT:
        mapped = memoryview(mapping(memory, end))
        views = [mapped[at : at + size] for at, size in places]
    else:
        fd = memory.fileno()
        views = [_copy_out(fd, at, size) if at else message.payload for at, size in places]
    if not offsets[0]:
        views[0] = memoryview(bytes(rest[table : table + sizes[0]]))
    message.release()
    return Message(views[0], views[1:], message.fds)


def _copy_out(memory: int, offset: int, size: int) -> memoryview:
    content = memoryview(bytearray(size))
    done = 0
    while done < size:
        read = os.preadv(memory, [content[done:]], offset + done)
        if not read:
            raise ValueError(f"a large message ends after {done} of {size} bytes")
        done += read
    return content
