"""Frames between the master and an agent.

A frame is a few numbers and then opaque bytes.  No code here unpickles them: only the process that
gets them does.  The repr of a message, and so the log, does not show the user's data.

Layout (little endian): version:u8, kind:u8, the numbers of that kind, and the rest.  See
``packet_layout.py`` for the layout of a packet.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple, TypeAlias

from fiber._wire import blob_messages
from fiber._wire.blob_messages import BlobMessage, KeepBlob
from fiber._wire.memory_files import BytesLike
from fiber._wire.packet_layout import PROTOCOL, pieces_of, read_packet, redacted
from fiber.errors import FiberError


class ProtocolError(FiberError):
    """Error: the other side of a link sent a frame that Fiber never sends."""


class Start(NamedTuple):
    """Master to agent: start a child as ``spec`` says; ``process`` is the pickled Process."""

    child: int
    spec: BytesLike
    process: BytesLike

    def encode(self) -> bytes:
        """Return the frame."""
        return b"".join(self.pieces())

    def pieces(self) -> Sequence[BytesLike]:
        """Return the frame in pieces.  The Process is not copied."""
        head = _NUMBER.pack(PROTOCOL, _START, self.child)
        return pieces_of(head, self.spec, [self.process])

    def __repr__(self) -> str:
        return redacted(self)


class Started(NamedTuple):
    """Agent to master: the child exists."""

    child: int
    pid: int

    def encode(self) -> bytes:
        """Return the frame."""
        return _NUMBERS.pack(PROTOCOL, _STARTED, self.child, self.pid)


class Signal(NamedTuple):
    """Master to agent: send the child a signal."""

    child: int
    signum: int

    def encode(self) -> bytes:
        """Return the frame."""
        return _NUMBERS.pack(PROTOCOL, _SIGNAL, self.child, self.signum)


class Deliver(NamedTuple):
    """Master to agent: a packet for the child's task channel."""

    child: int
    seq: int
    payload: BytesLike
    buffers: Sequence[BytesLike] = ()

    def encode(self) -> bytes:
        """Return the frame."""
        return b"".join(self.pieces())

    def pieces(self) -> Sequence[BytesLike]:
        """Return the frame in pieces.  The buffers and a large payload are not copied."""
        head = _DELIVERY.pack(PROTOCOL, _DELIVER, self.child, self.seq)
        return pieces_of(head, self.payload, self.buffers)

    def __repr__(self) -> str:
        return redacted(self)


class DeliverShared(NamedTuple):
    """Master to agent: a packet some of whose buffers are blobs that the agent has."""

    child: int
    seq: int
    shared: Sequence[tuple[int, bytes]]
    """Positions and digests of these buffers, in the order of the positions."""
    payload: BytesLike
    buffers: Sequence[BytesLike] = ()
    """The other buffers."""

    def encode(self) -> bytes:
        """Return the frame."""
        return b"".join(self.pieces())

    def pieces(self) -> Sequence[BytesLike]:
        """Return the frame in pieces.  The buffers and a large payload are not copied."""
        head = _DELIVERY.pack(PROTOCOL, _DELIVER_SHARED, self.child, self.seq)
        head += _COUNT.pack(len(self.shared))
        head += b"".join([_SHARED_BUFFER.pack(*one) for one in self.shared])
        return pieces_of(head, self.payload, self.buffers)

    def __repr__(self) -> str:
        return redacted(self)


class FromChild(NamedTuple):
    """Agent to master: a packet from the child's task channel."""

    child: int
    payload: BytesLike
    buffers: Sequence[BytesLike] = ()

    def encode(self) -> bytes:
        """Return the frame."""
        return b"".join(self.pieces())

    def pieces(self) -> Sequence[BytesLike]:
        """Return the frame in pieces.  The buffers and a large payload are not copied."""
        return pieces_of(
            _NUMBER.pack(PROTOCOL, _FROM_CHILD, self.child), self.payload, self.buffers
        )

    def __repr__(self) -> str:
        return redacted(self)


class Recall(NamedTuple):
    """Master to agent: recall the packets that the child has not read."""

    child: int

    def encode(self) -> bytes:
        """Return the frame."""
        return _NUMBER.pack(PROTOCOL, _RECALL, self.child)


class Recalled(NamedTuple):
    """Agent to master: the child will never receive these packets."""

    child: int
    seqs: tuple[int, ...]

    def encode(self) -> bytes:
        """Return the frame."""
        head = _NUMBER.pack(PROTOCOL, _RECALLED, self.child)
        return head + struct.pack(f"<{len(self.seqs)}Q", *self.seqs)


class Exited(NamedTuple):
    """Agent to master: the child has ended.

    The fields after ``delivered`` are those fields of an ExitReport that an agent knows.
    """

    child: int
    delivered: int
    """Number of Deliver frames that reached the child.  Later ones did not."""
    exitcode: int
    reason: str
    unread: tuple[int, ...] = ()
    running: tuple[int, int] | None = None
    log: tuple[str, ...] = ()
    host: str = ""
    cause: int = 0
    stack: str = ""

    def encode(self) -> bytes:
        """Return the frame."""
        return _NUMBER.pack(PROTOCOL, _EXITED, self.child) + _json(self[1:])

    def __repr__(self) -> str:
        return redacted(self)


class ShownStack(NamedTuple):
    """Agent to master: the Python stacks of a child that got the signal for it."""

    child: int
    text: str

    def encode(self) -> bytes:
        """Return the frame."""
        return _NUMBER.pack(PROTOCOL, _STACK, self.child) + _utf8(self.text)

    def __repr__(self) -> str:
        return redacted(self)


class Measure(NamedTuple):
    """Master to agent: measure the child's memory and processor time."""

    child: int

    def encode(self) -> bytes:
        """Return the frame."""
        return _NUMBER.pack(PROTOCOL, _MEASURE, self.child)


class Measured(NamedTuple):
    """Agent to master: bytes of memory and milliseconds of processor time of a child."""

    child: int
    memory: int
    milliseconds: int

    def encode(self) -> bytes:
        """Return the frame."""
        return _USAGE.pack(PROTOCOL, _MEASURED, *self)


class ChildOutput(NamedTuple):
    """Agent to master: text that the child wrote to stdout or stderr."""

    child: int
    text: str

    def encode(self) -> bytes:
        """Return the frame."""
        return _NUMBER.pack(PROTOCOL, _OUTPUT, self.child) + _utf8(self.text)

    def __repr__(self) -> str:
        return redacted(self)


class TunnelOpen(NamedTuple):
    """Both directions: connect a new tunnel to the hub at ``target``."""

    tunnel: int
    target: str

    def encode(self) -> bytes:
        """Return the frame."""
        return _NUMBER.pack(PROTOCOL, _TUNNEL_OPEN, self.tunnel) + _utf8(self.target)


class TunnelData(NamedTuple):
    """Both directions: a packet in a tunnel."""

    tunnel: int
    payload: BytesLike
    buffers: Sequence[BytesLike] = ()

    def encode(self) -> bytes:
        """Return the frame."""
        return b"".join(self.pieces())

    def pieces(self) -> Sequence[BytesLike]:
        """Return the frame in pieces.  The buffers and a large payload are not copied."""
        head = _NUMBER.pack(PROTOCOL, _TUNNEL_DATA, self.tunnel)
        return pieces_of(head, self.payload, self.buffers)

    def __repr__(self) -> str:
        return redacted(self)


class TunnelClose(NamedTuple):
    """Both directions: a tunnel ended or was not opened; ``reason`` is empty at an orderly end."""

    tunnel: int
    reason: str = ""

    def encode(self) -> bytes:
        """Return the frame."""
        return _NUMBER.pack(PROTOCOL, _TUNNEL_CLOSE, self.tunnel) + _utf8(self.reason)


class MemoryMessage(NamedTuple):
    """Both directions: a message about a block of shared memory that both hosts have."""

    block: int
    payload: BytesLike

    def encode(self) -> bytes:
        """Return the frame."""
        return _NUMBER.pack(PROTOCOL, _MEMORY, self.block) + self.payload

    def __repr__(self) -> str:
        return redacted(self)


class Shutdown(NamedTuple):
    """Master to agent: end all children and then yourself; kill what is left after ``grace`` s."""

    grace: float

    def encode(self) -> bytes:
        """Return the frame."""
        return _GRACE.pack(PROTOCOL, _SHUTDOWN, self.grace)


class Leave(NamedTuple):
    """Agent to master: this agent takes no new work and ends within ``grace`` seconds.

    It closes the link after the end of its last child.
    """

    grace: float
    reason: str

    def encode(self) -> bytes:
        """Return the frame."""
        return _GRACE.pack(PROTOCOL, _LEAVE, self.grace) + _utf8(self.reason)


LinkMessage: TypeAlias = (
    BlobMessage
    | Start
    | Started
    | Signal
    | Deliver
    | DeliverShared
    | FromChild
    | Recall
    | Recalled
    | Exited
    | ShownStack
    | Measure
    | Measured
    | ChildOutput
    | TunnelOpen
    | TunnelData
    | TunnelClose
    | MemoryMessage
    | Shutdown
    | Leave
)


HubMessage: TypeAlias = TunnelOpen | TunnelData | TunnelClose | MemoryMessage
"""Message between the hubs of both sides."""

ChildRequest: TypeAlias = Deliver | DeliverShared | Signal | Recall | Measure
"""Message that asks something of a child."""


def decode(frame: BytesLike) -> LinkMessage:
    """Read a frame; ProtocolError says what is wrong with a malformed frame.

    Payloads and buffers are views of ``frame``: not copied, and writable if it is a bytearray.
    """
    if len(frame) < _HEAD.size:
        raise ProtocolError(f"a frame of {len(frame)} bytes is too short to have a kind")
    version, kind = _HEAD.unpack_from(frame)
    if version != PROTOCOL:
        raise ProtocolError(
            f"a frame is of protocol version {version}; this process has {PROTOCOL}"
        )
    reader = _READERS.get(kind)
    if reader is None:
        raise ProtocolError(f"a frame is of unknown kind {kind}")
    try:
        return reader(memoryview(frame))
    except (struct.error, ValueError, TypeError, RecursionError) as error:
        # A reader raises each of these for bytes that no writer writes.
        name = reader.__name__.removeprefix("_read_")
        raise ProtocolError(
            f"a frame of kind {name} and {len(frame)} bytes is malformed ({error})"
        ) from error


_START, _STARTED, _SIGNAL, _DELIVER, _FROM_CHILD, _RECALL, _RECALLED, _EXITED = range(1, 9)
_OUTPUT, _TUNNEL_OPEN, _TUNNEL_DATA, _TUNNEL_CLOSE, _SHUTDOWN = 9, 11, 12, 13, 14
_MEMORY, _LEAVE, _STACK, _MEASURE, _MEASURED = range(18, 23)

_DELIVER_SHARED = 28

_HEAD = struct.Struct("<BB")
_NUMBER = struct.Struct("<BBQ")
_NUMBERS = struct.Struct("<BBQq")
_DELIVERY = struct.Struct("<BBQQ")
_COUNT = struct.Struct("<I")
_SHARED_BUFFER = struct.Struct(f"<I{blob_messages.DIGEST_BYTES}s")
_USAGE = struct.Struct("<BBQQQ")
_GRACE = struct.Struct("<BBd")


def pieces(message: LinkMessage) -> Sequence[BytesLike]:
    """Return a message's frame.  Large parts are separate pieces, which are not copied."""
    if isinstance(message, Start | KeepBlob | Deliver | DeliverShared | FromChild | TunnelData):
        return message.pieces()
    return (message.encode(),)


def lane(message: LinkMessage) -> Hashable:
    """Return the lane of a message.  Messages of one lane keep their order.

    The start and the tasks of a child share a lane, and so do the messages about one blob and those
    of one tunnel.  A Signal has no lane: it does not wait for earlier messages to the child.
    """
    if isinstance(message, TunnelData | TunnelClose):
        return (_TUNNEL_DATA, message.tunnel)
    if isinstance(
        message,
        Start | Deliver | DeliverShared | FromChild | Recall | Recalled | Exited | ChildOutput,
    ):
        return (_DELIVER, message.child)
    if isinstance(message, BlobMessage):
        return (blob_messages.KEEP, message.digest)
    return None


def is_passed_on(frame: BytesLike) -> bool:
    """Tell by the first bytes of a frame whether its receiver may pass it on to another process.

    The master does not pass on packets of children.
    """
    return bytes(frame[1:2]) != bytes([_FROM_CHILD])


def _utf8(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")  # file names and output may hold lone surrogates


def _text(view: memoryview) -> str:
    return str(view, "utf-8", "surrogatepass")


def _json(value: Any) -> bytes:
    return json.dumps(value).encode()


def _read_start(view: memoryview) -> Start:
    spec, (process,) = read_packet(view, _NUMBER.size)
    return Start(_NUMBER.unpack_from(view)[2], spec, process)


def _read_started(view: memoryview) -> Started:
    _, _, child, pid = _NUMBERS.unpack(view)
    return Started(child, pid)


def _read_signal(view: memoryview) -> Signal:
    _, _, child, signum = _NUMBERS.unpack(view)
    return Signal(child, signum)


def _read_deliver(view: memoryview) -> Deliver:
    _, _, child, seq = _DELIVERY.unpack_from(view)
    return Deliver(child, seq, *read_packet(view, _DELIVERY.size))


def _read_deliver_shared(view: memoryview) -> DeliverShared:
    _, _, child, seq = _DELIVERY.unpack_from(view)
    (count,) = _COUNT.unpack_from(view, _DELIVERY.size)
    start = _DELIVERY.size + _COUNT.size
    end = start + count * _SHARED_BUFFER.size
    shared = tuple(_SHARED_BUFFER.iter_unpack(view[start:end]))
    return DeliverShared(child, seq, shared, *read_packet(view, end))


def _read_from_child(view: memoryview) -> FromChild:
    return FromChild(_NUMBER.unpack_from(view)[2], *read_packet(view, _NUMBER.size))


def _read_recall(view: memoryview) -> Recall:
    return Recall(_NUMBER.unpack(view)[2])


def _read_recalled(view: memoryview) -> Recalled:
    child = _NUMBER.unpack_from(view)[2]
    count, odd = divmod(len(view) - _NUMBER.size, 8)
    if odd:
        raise ValueError("its list of sequence numbers is cut short")
    return Recalled(child, struct.unpack_from(f"<{count}Q", view, _NUMBER.size))


def _read_exited(view: memoryview) -> Exited:
    child = _NUMBER.unpack_from(view)[2]
    delivered, exitcode, reason, unread, running, log, host, cause, stack = json.loads(
        _text(view[_NUMBER.size :])
    )
    if running is not None:
        seq, index = running
        running = (_integer(seq), _integer(index))
    return Exited(
        child,
        _integer(delivered),
        _integer(exitcode),
        _string(reason),
        tuple(map(_integer, unread)),
        running,
        tuple(map(_string, log)),
        _string(host),
        _integer(cause),
        _string(stack),
    )


def _read_stack(view: memoryview) -> ShownStack:
    _, _, child = _NUMBER.unpack_from(view)
    return ShownStack(child, _text(view[_NUMBER.size :]))


def _read_measure(view: memoryview) -> Measure:
    return Measure(_NUMBER.unpack(view)[2])


def _read_measured(view: memoryview) -> Measured:
    return Measured(*_USAGE.unpack(view)[2:])


def _read_output(view: memoryview) -> ChildOutput:
    return ChildOutput(_NUMBER.unpack_from(view)[2], _text(view[_NUMBER.size :]))


def _read_tunnel_open(view: memoryview) -> TunnelOpen:
    return TunnelOpen(_NUMBER.unpack_from(view)[2], _text(view[_NUMBER.size :]))


def _read_tunnel_data(view: memoryview) -> TunnelData:
    return TunnelData(_NUMBER.unpack_from(view)[2], *read_packet(view, _NUMBER.size))


def _read_tunnel_close(view: memoryview) -> TunnelClose:
    return TunnelClose(_NUMBER.unpack_from(view)[2], _text(view[_NUMBER.size :]))


def _read_memory(view: memoryview) -> MemoryMessage:
    return MemoryMessage(_NUMBER.unpack_from(view)[2], view[_NUMBER.size :])


def _read_shutdown(view: memoryview) -> Shutdown:
    return Shutdown(_GRACE.unpack(view)[2])


def _read_leave(view: memoryview) -> Leave:
    return Leave(_GRACE.unpack_from(view)[2], _text(view[_GRACE.size :]))


def _integer(value: Any) -> int:
    if type(value) is not int:
        raise ValueError("a field that must be a number is not")
    return value


def _string(value: Any) -> str:
    if type(value) is not str:
        raise ValueError("a field that must be a text is not")
    return value


_READERS: dict[int, Callable[[memoryview], LinkMessage]] = {
    **blob_messages.READERS,
    _START: _read_start,
    _STARTED: _read_started,
    _SIGNAL: _read_signal,
    _DELIVER: _read_deliver,
    _DELIVER_SHARED: _read_deliver_shared,
    _FROM_CHILD: _read_from_child,
    _RECALL: _read_recall,
    _RECALLED: _read_recalled,
    _EXITED: _read_exited,
    _STACK: _read_stack,
    _MEASURE: _read_measure,
    _MEASURED: _read_measured,
    _OUTPUT: _read_output,
    _TUNNEL_OPEN: _read_tunnel_open,
    _TUNNEL_DATA: _read_tunnel_data,
    _TUNNEL_CLOSE: _read_tunnel_close,
    _MEMORY: _read_memory,
    _SHUTDOWN: _read_shutdown,
    _LEAVE: _read_leave,
}
