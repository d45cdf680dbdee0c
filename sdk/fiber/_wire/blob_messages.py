"""Frames about blobs: between the master and an agent, and between two agents.

``Want`` and its answer, a ``KeepBlob``, travel between agents.  All others travel between the
master and an agent.  See ``fiber._engine.fanout`` for who serves whom.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

from fiber._wire.memory_files import BytesLike
from fiber._wire.packet_layout import PROTOCOL, redacted

DIGEST_BYTES = 32
"""Length of a blob's name, the SHA-256 of its bytes."""

RECEIVER = "a receiver"
"""Name under which an agent asks another one for a blob."""

KEEP, FORGET, LACKING = 15, 16, 17
SERVE, FETCH, HOLDING, UNFETCHED, WANT = range(23, 28)

_HEAD = struct.Struct(f"<BB{DIGEST_BYTES}s")


class KeepBlob(NamedTuple):
    """Keep this blob; Start frames name it by its digest until a Forget.

    The master sends it to an agent, or an agent to another one in answer to Want.
    """

    digest: bytes
    data: BytesLike

    @staticmethod
    def frame_size(size: int) -> int:
        """Return the bytes of the frame of a blob that has ``size`` bytes."""
        return _HEAD.size + size

    def encode(self) -> bytes:
        """Return the frame."""
        return b"".join(self.pieces())

    def pieces(self) -> Sequence[BytesLike]:
        """Return the frame in pieces.  The data is not copied."""
        return _HEAD.pack(PROTOCOL, KEEP, self.digest), self.data

    def __repr__(self) -> str:
        return redacted(self)


class Forget(NamedTuple):
    """Master to agent: no later Start names this blob, unless it is sent again."""

    digest: bytes

    def encode(self) -> bytes:
        """Return the frame."""
        return _HEAD.pack(PROTOCOL, FORGET, self.digest)


class Lacking(NamedTuple):
    """Agent to master: this blob is missing here; send it again before a child needs it."""

    digest: bytes

    def encode(self) -> bytes:
        """Return the frame."""
        return _HEAD.pack(PROTOCOL, LACKING, self.digest)


class Serve(NamedTuple):
    """Master to agent: serve the blob that came before to other agents, and answer Holding."""

    digest: bytes
    number: int
    """Number of this order, for Holding."""
    port: int
    """Port to serve at; 0 takes a free one."""

    def encode(self) -> bytes:
        """Return the frame."""
        return _encode(SERVE, self)


class Fetch(NamedTuple):
    """Master to agent: fetch the blob from another agent, then serve it, too.

    Replaces an earlier Fetch of the blob.  The answer is Holding or Unfetched.
    """

    digest: bytes
    number: int
    """Number of this order, for Holding and Unfetched."""
    size: int
    """Bytes of the blob, which bound the time and the memory of the transfer."""
    address: str
    uid: str
    """Random word under which the agent asks: each order has another one."""
    key: str
    """Key that proves RECEIVER and ``uid`` to the other agent."""
    certificate: str
    """Fingerprint of the other agent's certificate."""
    port: int

    def encode(self) -> bytes:
        """Return the frame."""
        return _encode(FETCH, self)

    def __repr__(self) -> str:
        return redacted(self)


class Holding(NamedTuple):
    """Agent to master: the blob is here, as the order asked, and this is how others get it."""

    digest: bytes
    number: int
    address: str = ""
    """Address for other agents; empty if this one cannot serve."""
    key: str = ""
    """Key from which the master derives those of the receivers."""
    certificate: str = ""

    def encode(self) -> bytes:
        """Return the frame."""
        return _encode(HOLDING, self)

    def __repr__(self) -> str:
        return redacted(self)


class Unfetched(NamedTuple):
    """Agent to master: the order of this number has failed."""

    digest: bytes
    number: int
    reason: str

    def encode(self) -> bytes:
        """Return the frame."""
        return _encode(UNFETCHED, self)


class Want(NamedTuple):
    """Agent to agent: send this blob."""

    digest: bytes

    def encode(self) -> bytes:
        """Return the frame."""
        return _HEAD.pack(PROTOCOL, WANT, self.digest)


BlobMessage: TypeAlias = KeepBlob | Forget | Lacking | Serve | Fetch | Holding | Unfetched | Want


def _encode(kind: int, message: Serve | Fetch | Holding | Unfetched) -> bytes:
    digest, *fields = message
    return _HEAD.pack(PROTOCOL, kind, digest) + json.dumps(fields).encode()


def _fields(view: memoryview, *kinds: type) -> tuple[Any, ...]:
    """Return the digest, and the fields of exactly these types."""
    fields = json.loads(bytes(view[_HEAD.size :]))
    if type(fields) is not list or [type(field) for field in fields] != list(kinds):
        raise ValueError("its fields are not those of its kind")
    return _HEAD.unpack_from(view)[2], *fields


def _read_blob(view: memoryview) -> KeepBlob:
    return KeepBlob(_HEAD.unpack_from(view)[2], view[_HEAD.size :])


def _read_forget(view: memoryview) -> Forget:
    return Forget(_HEAD.unpack(view)[2])


def _read_lacking(view: memoryview) -> Lacking:
    return Lacking(_HEAD.unpack(view)[2])


def _read_serve(view: memoryview) -> Serve:
    return Serve(*_fields(view, int, int))


def _read_fetch(view: memoryview) -> Fetch:
    return Fetch(*_fields(view, int, int, str, str, str, str, int))


def _read_holding(view: memoryview) -> Holding:
    return Holding(*_fields(view, int, str, str, str))


def _read_unfetched(view: memoryview) -> Unfetched:
    return Unfetched(*_fields(view, int, str))


def _read_want(view: memoryview) -> Want:
    return Want(_HEAD.unpack(view)[2])


READERS: dict[int, Callable[[memoryview], BlobMessage]] = {
    KEEP: _read_blob,
    FORGET: _read_forget,
    LACKING: _read_lacking,
    SERVE: _read_serve,
    FETCH: _read_fetch,
    HOLDING: _read_holding,
    UNFETCHED: _read_unfetched,
    WANT: _read_want,
}
"""Readers of frames by their kinds."""
