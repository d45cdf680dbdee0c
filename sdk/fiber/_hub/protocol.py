"""Messages on a stream to a hub, and the doorbell of a hub.

A message is one packet.  Requests and replies are a few numbers.  The payload that a user sends or
receives is in the packet's buffers, payload first, and nothing here is ever unpickled.

``HELLO`` comes first and is silent unless refused, as are ``CONNECT`` (go on to another host's hub;
what follows is for that one, ``HELLO`` first) and ``ATTACH`` (what follows concerns one object).
So a client opens a stream and makes its first request without waiting.  At most one request of a
stream is unanswered; another one withdraws it.

Layout (little endian): request kind:u8, number:u32, and its own fields; reply the same.

A process that changed shared memory rings the doorbell, and the hub looks at the memory.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import IntEnum, IntFlag
from typing import NamedTuple

VERSION = 3
KEY_BYTES = 32

SECRET_BYTES = 16
"""Length of grants, tokens and identities: 128 bits, which cannot be guessed."""

NO_SECRET = bytes(SECRET_BYTES)
"""Stands for none."""


class HubAddress(NamedTuple):
    """Address of a hub.  Its key admits a process; an object needs a grant."""

    host: str
    path: str
    """Path of its unix socket; empty if it could not open one."""
    key: bytes
    problem: str = ""
    """Reason why it could not, and what to do."""

    def __repr__(self) -> str:
        return f"HubAddress(host={self.host!r}, path={self.path!r})"


class ObjectKind(IntEnum):
    """Kind of an object."""

    CHANNEL = 1
    COUNTER = 2
    # What is a block of shared memory
    MEMORY = 3
    SEMAPHORE = 4
    WAIT_LIST = 5
    # A channel's end and, beside it, a block
    SENDER = 6
    RECEIVER = 7


class Extent(NamedTuple):
    """Part of a segment that an object is."""

    offset: int = 0
    size: int = 0


WHOLE = Extent()
"""Extent of a channel or counter."""


class GrantFlags(IntFlag):
    """Life of a grant."""

    REUSABLE = 1  # beyond its first use
    ENDS_WITH_STREAM = 2  # with the one on which it was asked for


class Op(IntEnum):
    """Requests."""

    HELLO = 1  # version, key
    CONNECT = 2  # host
    REGISTER = 3  # kind, flags, offset, size; descriptors beside it -> grant, identity
    FETCH = 4  # grant -> its descriptors beside the reply
    ATTACH = 5  # token, grant: the token is for more streams of the same user, without a grant
    GRANT = 6  # flags, token -> grant, identity
    RELEASE = 7  # grant; silent
    CANCEL = 8  # answers the request of this number NO, if it is still waiting; otherwise silent
    SYNC = 9  # number of the request that is given up, or 0: takes back what it got -> nothing
    RING = 30  # something in shared memory of this host has changed; silent
    REPLICATE = 31  # an Origin beside it -> where in the segment whose descriptor is beside it
    # For an attached channel
    SEND = 10  # payload and buffers beside it
    RECV = 11  # -> more; payload and buffers beside it
    TRY_RECV = 12  # -> the same, or NO
    POLL = 13
    WATCH = 14  # silent; the stream gets READY once the channel is readable
    CHECK = 15  # whether it is readable now; then as WATCH
    DRAW = 16  # token of a counter -> as RECV; raises that counter by one
    TRY_DRAW = 17  # the same -> as TRY_RECV
    # For an attached counter
    ADD = 20  # how much
    TAKE = 21
    CLEAR = 22  # -> count
    VALUE = 23  # -> count
    WAIT = 24
    CHANGED = 25  # since
    CLAIM = 26  # as TAKE; taken back at the end of the stream or the next request, unless
    KEEP = 27  # says before that it is to be kept; silent
    # For an attached semaphore
    ACQUIRE = 40  # the process's name beside it -> whether the stream keeps it; who died beside it
    POST = 41  # NO if there are as many tokens as there can be
    TOKENS = 42  # -> how many there are
    # For an attached wait list
    ENTER = 50
    SLEEP = 51
    LEAVE = 52  # NO if the stream's place was not notified
    NOTIFY = 53  # how many
    WAITERS = 54  # -> how many
    BURY = 55  # -> how many
    GET = 56  # which -> the word
    SET = 57  # which, the word
    HOLD = 58  # how many things the stream's place has; silent
    RECLAIM = 59  # token of a counter, which is raised by -> how many things the dead had
    TALLY = 60  # how many things the stream's place has; the second word
    HELD = 61  # -> how many things all places have


class Status(IntEnum):
    """Replies."""

    OK = 0
    NO = 1  # cancelled, or not so
    EOF = 2
    BROKEN = 3
    READY = 4  # of a watching stream; answers nothing
    GONE = 5  # why the stream ends


class Origin(NamedTuple):
    """A block of shared memory, and what entitles a process to it."""

    home: str
    """The host where it was made."""
    identity: bytes
    """Secret that tells it from all other blocks: only its users know it."""
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
        """The same back; struct.error or ValueError for what is none."""
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


def hello(key: bytes) -> bytes:
    """The first message of every stream."""
    return HELLO.pack(Op.HELLO, 0, VERSION, key)


def connect(host: str) -> bytes:
    """Go on to the hub of ``host``."""
    return HEAD.pack(Op.CONNECT, 0) + host.encode()


def gone(reason: str) -> bytes:
    """The last message of a stream that a hub ends."""
    return HEAD.pack(Status.GONE, 0) + reason.encode(errors="replace")


def text(payload: memoryview) -> str:
    """Return the text after the numbers of CONNECT and GONE."""
    return str(payload[HEAD.size :], "utf-8", "replace")


class Doorbell:
    """Doorbell of one hub.  Runs on the loop's thread, but for ``ring``."""

    def __init__(self, call_soon: Callable[..., None]) -> None:
        self._call_soon = call_soon
        self._listeners: set[Callable[[], None]] = set()

    def listen(self, listener: Callable[[], None]) -> None:
        """Call it whenever the bell is rung, and perhaps for nothing."""
        self._listeners.add(listener)

    def forget(self, listener: Callable[[], None]) -> None:
        """Stop calling ``listener``."""
        self._listeners.discard(listener)

    def ring(self) -> None:
        """Have all listeners look.  Any thread; waits for nothing."""
        self._call_soon(self.rung)

    def rung(self) -> None:
        """Call all listeners."""
        for listener in tuple(self._listeners):
            listener()
