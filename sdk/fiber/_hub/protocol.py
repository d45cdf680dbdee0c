"""Messages on a stream to a hub, and the doorbell of a hub.

A message is one packet.  Requests and replies are a few numbers.  The payload that a user sends or
receives is in the packet's buffers, payload first.  The hub never unpickles it.

The first request is ``HELLO``.  ``CONNECT`` goes on to another host's hub, and the following
requests are for that hub, ``HELLO`` first.  ``ATTACH`` chooses the object of the following
requests.  A hub replies to these three only if it refuses them.  So a client opens a stream and
sends its first request without waiting.  At most one request of a stream waits for its reply;
another request withdraws it.

Layout (little endian): kind:u8, number:u32, and the fields of the request or reply.

A process that changed shared memory rings the doorbell, and the hub looks at the memory.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from enum import IntEnum, IntFlag
from typing import NamedTuple

VERSION = 8
KEY_BYTES = 32

SECRET_BYTES = 16
"""Length of grants, tokens and identities: 128 bits, which cannot be guessed."""

NO_SECRET = bytes(SECRET_BYTES)
"""Value that stands for no secret."""


class HubAddress(NamedTuple):
    """Address of a hub.  Its key admits a process; an object needs a grant."""

    host: str
    path: str
    """Path of the hub's unix socket; empty if it could not open one."""
    key: bytes
    problem: str = ""
    """Text that says why it could not open a socket, and what to do."""

    def __repr__(self) -> str:
        return f"HubAddress(host={self.host!r}, path={self.path!r})"


class ObjectKind(IntEnum):
    """Kind of an object."""

    CHANNEL = 1
    COUNTER = 2
    # Blocks of shared memory
    MEMORY = 3
    SEMAPHORE = 4
    WAIT_LIST = 5
    # Ends of a one-way channel, each with a block
    SENDER = 6
    RECEIVER = 7


class Extent(NamedTuple):
    """Position and size of an object in its segment."""

    offset: int = 0
    size: int = 0


WHOLE = Extent()
"""Extent of a channel or counter."""


class GrantFlags(IntFlag):
    """Flags that say how long a grant lasts."""

    REUSABLE = 1  # it does not end with its first use
    ENDS_WITH_STREAM = 2  # it ends with the stream on which it was requested


NUMBERS = "I"
"""Code of ``array`` for the numbers of requests."""

TAKEN, HALF_FULL = 1, 2
"""Flags of a reply to SEND: the channel has the message; the pipe is at least half full."""


class Op(IntEnum):
    """Kind of a request."""

    HELLO = 1  # version, key
    CONNECT = 2  # host
    REGISTER = 3  # kind, flags, offset, size; descriptors beside it -> grant, identity
    FETCH = 4  # grant -> its descriptors beside the reply
    ATTACH = 5  # token, grant: the token is for more streams of the same user, without a grant
    GRANT = 6  # flags, token -> grant, identity
    RELEASE = 7  # grant; silent
    CANCEL = 8  # number of a request: replies NO to it if it still waits; otherwise silent
    SYNC = 9  # number of a request that is given up, or 0: takes back its token -> nothing
    RING = 30  # shared memory of this host has changed; silent
    REPLICATE = 31  # an Origin beside it -> offset in the segment whose descriptor is beside it
    # For an attached channel
    SEND = 10  # payload and buffers beside it -> 0 once it is queued, then TAKEN once sent
    RECV = 11  # -> more; payload and buffers beside it
    EXCHANGE = 12  # as SEND, then as RECV; BROKEN if it was not sent
    POLL = 13
    WATCH = 14  # silent; the stream gets READY once the channel is readable
    CHECK = 15  # NO if it is not readable now; then as WATCH
    DRAW = 16  # token of a counter -> as RECV; raises that counter by one
    PUT_ITEMS = 17  # token of a counter; a bundle beside it -> 0 once counted, then 1 once sent
    GET_ITEM = 18  # token of a counter -> as RECV; lowers that counter by one
    # For an attached counter
    ADD = 20  # how much
    TAKE = 21
    CLEAR = 22  # -> count
    VALUE = 23  # -> count
    CHANGED = 25  # since
    CLAIM = 26  # as TAKE; undone at the end of the stream or at the next request, except
    KEEP = 27  # which keeps it; silent
    # For an attached semaphore
    ACQUIRE = 40  # name of the process beside it -> 1 if the stream keeps it; dead holder beside it
    RETURN_TOKEN = 41  # NO if the semaphore is at its maximum
    TOKENS = 42  # -> number of tokens
    DISOWN = 43  # the stream no longer keeps its token, which stays taken; silent
    # For an attached wait list
    ENTER = 50
    SLEEP = 51
    LEAVE = 52  # NO if the stream's place was not notified
    NOTIFY = 53  # number of waiters
    WAITERS = 54  # -> number of waiters
    REMOVE_DEAD = 55  # -> number of waiters that died
    GET = 56  # which -> the word
    SET = 57  # which, the word
    HOLD = 58  # number of things of the stream's process; silent
    RECLAIM = 59  # token of a counter, which is raised by -> number of things of dead processes
    HELD = 61  # -> number of things of all processes
    # For the members of a barrier
    MEET = 62  # tokens of condition and lock, parties, 1 if there is an action, microseconds or
    # ENDLESS; name of the process beside it -> index; or BROKEN, and why; or ACT, and the process
    ACTED = 63  # has called the action -> index


class Status(IntEnum):
    """Kind of a reply."""

    OK = 0
    NO = 1  # cancelled, or false
    EOF = 2
    BROKEN = 3
    READY = 4  # sent to a watching stream; replies to no request
    GONE = 5  # the stream ends; the reason follows
    ACT = 6  # the client has to call the action of the barrier, whose lock its stream keeps


class BarrierState(IntEnum):
    """State of threading's barrier."""

    FILLING = 0
    DRAINING = 1
    RESETTING = -1
    BROKEN = -2


class Breach(IntEnum):
    """Reason why a wait at a barrier ends with BROKEN."""

    BEFORE = 0  # another thread broke it
    DIED = 1  # a process that took part has died
    LATE = 2  # the others did not come in time


RECHECK = 1.0
"""Seconds after which a waiter checks for itself: the process that should wake it may be dead."""

ENDLESS = (1 << 64) - 1
"""Timeout that never ends, in microseconds."""


class Origin(NamedTuple):
    """Block of shared memory, and the permission to use it."""

    home: str
    """Host where the block was made."""
    identity: bytes
    """Secret name of the block, which only its users know."""
    size: int
    token: bytes
    grant: bytes

    @property
    def block(self) -> tuple[str, bytes]:
        """Name of the block on every host."""
        return self.home, self.identity

    def __repr__(self) -> str:
        return f"Origin(home={self.home!r}, size={self.size})"

    def encode(self) -> bytes:
        """Return the bytes that travel between hubs."""
        return _ORIGIN.pack(*self[1:]) + self.home.encode()

    @classmethod
    def decode(cls, data: memoryview) -> Origin:
        """Decode what ``encode`` returned; struct.error or ValueError for other bytes."""
        return cls(str(data[_ORIGIN.size :], "utf-8"), *_ORIGIN.unpack_from(data))


_SECRET = f"{SECRET_BYTES}s"
_ORIGIN = struct.Struct(f"<{_SECRET}Q{_SECRET}{_SECRET}")

HEAD = struct.Struct("<BI")
HELLO = struct.Struct(f"<BIB{KEY_BYTES}s")
TWO = struct.Struct("<BIQQ")
FOUR = struct.Struct("<BIQQQQ")
ONE = struct.Struct("<BIQ")
SECRET = struct.Struct(f"<BI{_SECRET}")
SECRETS = struct.Struct(f"<BI{_SECRET}{_SECRET}")
GRANTING = struct.Struct(f"<BIQ{_SECRET}")
MEETING = struct.Struct(f"<BI{_SECRET}{_SECRET}QQQ")


def hello(key: bytes) -> bytes:
    """Return the first message of a stream."""
    return HELLO.pack(Op.HELLO, 0, VERSION, key)


def connect(host: str) -> bytes:
    """Return the message that connects a stream to the hub of ``host``."""
    return HEAD.pack(Op.CONNECT, 0) + host.encode()


def microseconds(timeout: float | None) -> int:
    """Return a timeout in seconds as MEET has it."""
    within = ENDLESS if timeout is None else max(0.0, timeout) * 1e6
    return ENDLESS if within >= ENDLESS else math.ceil(within)


def seconds(within: int) -> float:
    """Return the timeout of a MEET request."""
    return math.inf if within == ENDLESS else within / 1e6


def gone(reason: str) -> bytes:
    """Return the last message of a stream that a hub ends."""
    return HEAD.pack(Status.GONE, 0) + reason.encode(errors="replace")


def text(payload: memoryview) -> str:
    """Return the text in a CONNECT or GONE message."""
    return str(payload[HEAD.size :], "utf-8", "replace")


class Doorbell:
    """Doorbell of one hub.  Runs on the loop thread, except ``ring``."""

    def __init__(self, call_soon: Callable[..., None]) -> None:
        self._call_soon = call_soon
        self._listeners: set[Callable[[], None]] = set()

    def listen(self, listener: Callable[[], None]) -> None:
        """Call ``listener`` whenever the bell rings, also if its memory did not change."""
        self._listeners.add(listener)

    def forget(self, listener: Callable[[], None]) -> None:
        """Stop calling ``listener``."""
        self._listeners.discard(listener)

    def ring(self) -> None:
        """Have all listeners called.  Any thread; never waits."""
        self._call_soon(self.rung)

    def rung(self) -> None:
        """Call all listeners."""
        for listener in tuple(self._listeners):
            listener()
