"""Blocks of shared memory that several hosts have, at the hub of one of these hosts.

A block has a home, the host where it was made.  When a process of another host uses the block,
that host *joins*: its hub makes a local block, a *replica*, and requests the contents from the next
hub on the way to the home.  That hub joins first, unless it is the home.  So the hosts with a block
form a tree along the links, and changes travel only along this tree.

On a link each block has a number, chosen by the side that joins.  The messages about a block::

    JOIN      an Origin; the other side sends the bytes that are not zero, as patches, and READY
    READY     empty, or the reason why the block is not available
    PATCH     changes
    ACK       a patch of the side that joined has arrived
    LEAVE     the side that joined does not use the block from now on

The class ``Replicas`` and its parts run on the loop thread.  ``Twin`` and the functions below it
compute changes, without I/O.

Each side of a link between two such hosts has a *twin* of the block: the contents that both sides
agree on.  Before any other message is sent over the link, the difference from the twin is sent as a
*patch*, and links keep the order.  So a process that gets a message after a write finds the write
in its memory, however many hosts the message passed.  That is lazy release consistency (Keleher,
Cox and Zwaenepoel, 1992), with links in place of locks.

A patch names exactly the bytes that changed.  If no message orders two writes, writes to different
bytes merge.  Of two writes to one byte, the one that the home sees last wins, and finally all hosts
have it.  For that, the side that is farther from the home keeps its patches until they are
acknowledged, and its changes that are not sent yet.

A patch is a sequence of extents::

    offset:u64, length:u32, which of these bytes changed:1 bit each, the bytes
"""

from __future__ import annotations

import itertools
import os
import re
import struct
from collections import deque
from collections.abc import Callable, Iterator
from enum import IntEnum
from typing import NamedTuple, Protocol

from fiber._hub import heap
from fiber._hub.heap import Block, block_of
from fiber._hub.protocol import ONE, ObjectKind, Origin, Status
from fiber._hub.registry import NoSuchObject, Registry
from fiber._hub.streams import Stream
from fiber._wire.descriptor import own
from fiber._wire.messages import MemoryMessage, ProtocolError

PATCH = 1 << 18
"""Bytes from which a patch is sent, and another one begins."""

_SPAN = 1 << 16  # bytes that are compared at once
_CHUNK = 1 << 12  # bytes that are compared within a span that differs; limit of an extent
_HEAD = struct.Struct("<QI")
_CHANGED = bytes([ord("0")]) + bytes([ord("1")]) * 255
_RUN = re.compile(b"1+")

Contents = memoryview | bytearray


class Run(NamedTuple):
    """Consecutive bytes that changed."""

    start: int
    data: bytes


class Twin:
    """State of one side of a link for a block that both sides share.  Both begin with zeros.

    ``follows`` is True if the other side is nearer to the block's home.
    """

    def __init__(self, memory: memoryview, *, follows: bool) -> None:
        self._memory = memory
        self._agreed = bytearray(len(memory))
        self._follows = follows
        self._unacknowledged: deque[bytes] = deque()

    def collect(self) -> Iterator[bytes]:
        """Yield patches with the changes that the other side does not have, in order."""
        patch = b""
        for extent in _differences(self._agreed, self._memory):
            patch += extent
            if len(patch) >= PATCH:
                yield self._sent(patch)
                patch = b""
        if patch:
            yield self._sent(patch)

    def _sent(self, patch: bytes) -> bytes:
        if self._follows:
            self._unacknowledged.append(patch)
        return patch

    def acknowledged(self) -> None:
        """Note that the oldest unacknowledged patch has arrived."""
        self._unacknowledged.popleft()

    def merge(self, patch: memoryview) -> None:
        """Apply a patch of the other side; ValueError if it is malformed."""
        runs = list(_runs(patch, len(self._memory)))
        if self._follows:
            self._merge_newer(runs)
        else:
            for start, data in runs:
                self._memory[start : start + len(data)] = data
                self._agreed[start : start + len(data)] = data

    def _merge_newer(self, runs: list[Run]) -> None:
        before = [bytes(self._agreed[start : start + len(data)]) for start, data in runs]
        _write(self._agreed, runs)
        for patch in self._unacknowledged:
            _write(self._agreed, _runs(memoryview(patch), len(self._memory)))
        for (start, data), old in zip(runs, before, strict=True):
            end = start + len(data)
            new = bytes(self._agreed[start:end])
            here = bytes(self._memory[start:end])
            if here == old:
                self._memory[start:end] = new
                continue
            for index, (mine, was) in enumerate(zip(here, old, strict=True), start):
                if mine == was:  # otherwise a change here is not sent yet, and stays
                    self._memory[index] = new[index - start]


def _differences(old: bytearray, memory: memoryview) -> Iterator[bytes]:
    """Update ``old`` from ``memory``, and yield the extents that changed."""
    for start in range(0, len(old), _SPAN):
        # Processes may write meanwhile.  Each byte is read once; later writes are found next time.
        now = bytes(memory[start : start + _SPAN])
        was = bytes(old[start : start + _SPAN])
        if now == was:
            continue
        old[start : start + _SPAN] = now
        for at in range(0, len(now), _CHUNK):
            new, before = now[at : at + _CHUNK], was[at : at + _CHUNK]
            if new != before:
                yield _extent(start + at, before, new)


def _extent(start: int, old: bytes, new: bytes) -> bytes:
    changed = int.from_bytes(old) ^ int.from_bytes(new)
    marks = changed.to_bytes(len(new)).translate(_CHANGED)
    first, end = marks.index(b"1"), marks.rindex(b"1") + 1
    bits = int(marks[first:end], 2).to_bytes(-(-(end - first) // 8))
    return b"".join((_HEAD.pack(start + first, end - first), bits, new[first:end]))


def _runs(patch: memoryview, size: int) -> Iterator[Run]:
    at = 0
    while at < len(patch):
        start, length = _HEAD.unpack_from(patch, at)
        bits = at + _HEAD.size
        data = bits + -(-length // 8)
        at = data + length
        if not 0 < length <= _CHUNK or start + length > size or at > len(patch):
            raise ValueError("malformed patch of shared memory")
        marks = format(int.from_bytes(patch[bits:data]), f"0{length}b").encode()
        if len(marks) != length:
            raise ValueError("malformed patch of shared memory")
        for run in _RUN.finditer(marks):
            first, end = run.span()
            yield Run(start + first, bytes(patch[data + first : data + end]))


def _write(memory: bytearray, runs: list[Run] | Iterator[Run]) -> None:
    for start, data in runs:
        memory[start : start + len(data)] = data


BlockIdentity = tuple[str, bytes]
"""Home of a block, and its secret name there."""
SendMemoryMessage = Callable[[MemoryMessage], None]


class _MemoryKind(IntEnum):
    JOIN = 1
    READY = 2
    PATCH = 3
    ACK = 4
    LEAVE = 5


_KINDS = {kind: bytes([kind]) for kind in _MemoryKind}


class Joiner(Protocol):
    """Object that waits until a block is here."""

    def joined(self, block: Block) -> None:
        """Take the block, which has its contents now."""

    def refused(self, reason: str) -> None:
        """Note that the block is not available."""


class ReplyingHandler(Protocol):
    """Handler of a stream that requests memory of another host.

    ``ClientHandler`` implements it.  This module stands below ``client_handler``.
    """

    stream: Stream

    def close(self, reason: str) -> None:
        """End the stream."""


class Joining:
    """Client's request for memory of another host; a ``Joiner``."""

    def __init__(self, handler: ReplyingHandler, number: int) -> None:
        self._handler = handler
        self._number = number

    def joined(self, block: Block) -> None:
        """Reply with the block."""
        reply = ONE.pack(Status.OK, self._number, block.offset)
        self._handler.stream.send(reply, (), [os.dup(block.segment.fileno())])

    def refused(self, reason: str) -> None:
        """Close the stream, as there is no block to send."""
        self._handler.close(reason)


class Replica:
    """Block that this host shares with other hosts: made here, or a copy."""

    def __init__(self, origin: Origin, block: Block) -> None:
        self.identity = origin.block
        self.block = block
        self.memory = block.view
        self.joiners: list[Joiner] = []
        """Objects that wait for the contents."""
        self.users: set[object] = set()
        """Streams of processes of this host, and links whose other side has joined here."""
        self.upstream: _Share | None = None
        """Share on the link towards the home; None at the home, and after that link has ended."""
        self.ready = True


class _Share:
    """Block on one link."""

    def __init__(self, link: MemoryLink, number: int, replica: Replica, *, follows: bool) -> None:
        self.link = link
        self.number = number
        self.replica = replica
        self.follows = follows
        self.twin = Twin(replica.memory, follows=follows)


class Replicas:
    """Replicas of one hub."""

    def __init__(self, host: str, registry: Registry) -> None:
        self._host = host
        self._registry = registry
        self._replicas: dict[BlockIdentity, Replica] = {}
        self._links: dict[str | None, MemoryLink] = {}

    def link(self, host: str | None, send: SendMemoryMessage, *, dialer: bool) -> MemoryLink:
        """Add a link, as ``Router.link`` does."""
        link = self._links[host] = MemoryLink(self, send, dialer=dialer)
        return link

    def unlink(self, host: str | None, reason: str) -> None:
        """Remove a link that has ended."""
        link = self._links.pop(host, None)
        if link is not None:
            link.lost(reason)

    def join(self, origin: Origin, user: object, joiner: Joiner) -> None:
        """Get the block here for ``user``, until ``user`` leaves; then call ``joiner``.

        Away from its home no grant is checked: only users of the block know its secret name.
        """
        try:
            own = self._own_block(origin) if origin.home == self._host else None
            replica = self._replicas.get(origin.block) or self._new(origin, own)
        except (LookupError, OSError) as error:
            joiner.refused(str(error))
            return
        replica.users.add(user)
        if replica.ready:
            joiner.joined(replica.block)
        else:
            replica.joiners.append(joiner)

    def leave(self, identity: BlockIdentity, user: object) -> None:
        """Note that ``user`` no longer uses the block."""
        replica = self._replicas.get(identity)
        if replica is None or user not in replica.users:
            return
        replica.users.discard(user)
        if not replica.users:
            del self._replicas[identity]
            if replica.upstream is not None:
                replica.upstream.link.leave(replica.upstream)

    def at(self, identity: BlockIdentity) -> Replica:
        """Return a block that is here."""
        return self._replicas[identity]

    def arrived(self, replica: Replica, problem: str) -> None:
        """Note that the contents have arrived, or a ``problem`` in place of them."""
        replica.ready = not problem
        joiners, replica.joiners = replica.joiners, []
        if problem:
            self._replicas.pop(replica.identity, None)
        for joiner in joiners:
            if problem:
                joiner.refused(problem)
            else:
                joiner.joined(replica.block)

    def _new(self, origin: Origin, own: Block | None) -> Replica:
        if own is not None:
            replica = Replica(origin, own)
        else:
            link = self._towards(origin.home)
            replica = Replica(origin, heap.allocate(origin.size))
            replica.block.give()
            replica.ready = False
            replica.upstream = link.join(replica, origin)
        self._replicas[replica.identity] = replica
        return replica

    def _own_block(self, origin: Origin) -> Block:
        shared = self._registry.look_up(origin.token, origin.grant)
        expected = ObjectKind.MEMORY, origin.identity, origin.size
        if expected != (shared.kind, shared.identity, shared.extent.size):
            raise NoSuchObject("there is no such block of shared memory")
        (segment,) = map(own, shared.duplicates())
        return block_of(segment, *shared.extent)

    def _towards(self, host: str) -> MemoryLink:
        link = self._links.get(host, self._links.get(None))
        if link is None:
            raise NoSuchObject(f"host {host!r} cannot be reached: no agent of that name is there")
        return link


class MemoryLink:
    """Blocks that both sides of one link have."""

    def __init__(self, home: Replicas, send: SendMemoryMessage, *, dialer: bool) -> None:
        self._home = home
        self._send = send
        self._numbers = itertools.count(1 if dialer else 2, 2)
        self._shares: dict[int, _Share] = {}
        self._joining: dict[int, _Downstream] = {}

    def __bool__(self) -> bool:
        """Tell whether both sides have a block."""
        return bool(self._shares)

    def flush(self) -> None:
        """Send the changes of this side.  Call it before any other message is sent."""
        for share in self._shares.values():
            self._flush(share)

    def _flush(self, share: _Share) -> None:
        if share.replica.ready:
            for patch in share.twin.collect():
                self._say(share.number, _MemoryKind.PATCH, patch)

    def _say(self, number: int, kind: _MemoryKind, data: bytes = b"") -> None:
        self._send(MemoryMessage(number, _KINDS[kind] + data))

    def on_frame(self, frame: MemoryMessage) -> None:
        """Take a message of the other side; ProtocolError if it is malformed."""
        payload = memoryview(frame.payload)
        try:
            kind = _MemoryKind(payload[0])
            if kind is _MemoryKind.JOIN:
                self._accept(frame.block, Origin.decode(payload[1:]))
            else:
                self._receive(frame.block, kind, payload[1:])
        except (struct.error, ValueError, IndexError) as error:
            raise ProtocolError(f"malformed data about shared memory: {error}") from error

    # The side that joins

    def join(self, replica: Replica, origin: Origin) -> _Share:
        """Request a block from the other side."""
        share = _Share(self, next(self._numbers), replica, follows=True)
        self._shares[share.number] = share
        self._say(share.number, _MemoryKind.JOIN, origin.encode())
        return share

    def leave(self, share: _Share) -> None:
        """Leave a block that no process of this host uses."""
        if self._shares.pop(share.number, None) is not None:
            self._flush(share)
            self._say(share.number, _MemoryKind.LEAVE)

    # The other side

    def _accept(self, number: int, origin: Origin) -> None:
        downstream = self._joining[number] = _Downstream(self, number, origin.block)
        self._home.join(origin, downstream, downstream)

    def accepted(self, downstream: _Downstream) -> None:
        """Send the contents, which are here now, to the other side."""
        number = downstream.number
        if number not in self._joining:
            return  # the other side left while it waited
        replica = self._home.at(downstream.identity)
        share = self._shares[number] = _Share(self, number, replica, follows=False)
        self._flush(share)
        self._say(number, _MemoryKind.READY)

    def refused(self, downstream: _Downstream, reason: str) -> None:
        """Tell the other side why it cannot have the contents."""
        if self._joining.pop(downstream.number, None) is not None:
            self._say(downstream.number, _MemoryKind.READY, reason.encode(errors="replace"))

    def _receive(self, number: int, kind: _MemoryKind, data: memoryview) -> None:
        if kind is _MemoryKind.LEAVE:
            self._shares.pop(number, None)
            downstream = self._joining.pop(number, None)
            if downstream is not None:
                self._home.leave(downstream.identity, downstream)
            return
        share = self._shares.get(number)
        if share is None:
            return  # this side left while the message was on its way
        if kind is _MemoryKind.PATCH:
            share.twin.merge(data)
            if not share.follows:
                self._say(number, _MemoryKind.ACK)
        elif kind is _MemoryKind.ACK:
            share.twin.acknowledged()
        else:
            problem = str(data, "utf-8", "replace")
            if problem:
                del self._shares[number]
            self._home.arrived(share.replica, problem)

    def lost(self, reason: str) -> None:
        """Note that the link has ended.  Blocks here keep their contents."""
        shares, self._shares = self._shares, {}
        joining, self._joining = self._joining, {}
        for share in shares.values():
            if share.follows:
                share.replica.upstream = None
                if not share.replica.ready:
                    self._home.arrived(share.replica, reason)
        for downstream in joining.values():
            self._home.leave(downstream.identity, downstream)


class _Downstream:
    """Other side of a link that has joined here, or waits for that; a ``Joiner``."""

    def __init__(self, link: MemoryLink, number: int, identity: BlockIdentity) -> None:
        self.number = number
        self.identity = identity
        self._link = link

    def joined(self, block: Block) -> None:
        """Send the contents to the other side."""
        self._link.accepted(self)

    def refused(self, reason: str) -> None:
        """Send the reason to the other side."""
        self._link.refused(self, reason)
