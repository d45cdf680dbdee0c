"""Registry of the objects that a hub keeps for processes of other hosts.

An object stays as long as a process of another host is attached to it, or there is a grant for it.
A grant is the permission in a pickled handle: 128 random bits.  A plain grant ends with its first
use; a reusable one lasts until it is released.  A process that attaches by a grant also sends a
*token*, 128 random bits of its choice.  While it is attached, the token allows it to attach again,
and to get grants for other processes.
"""

from __future__ import annotations

import hmac
import os
import stat
import struct
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypeAlias

from fiber._hub.hosted import (
    HostedChannel,
    HostedCounter,
    HostedMemory,
    HostedSemaphore,
    HostedWaitList,
)
from fiber._hub.protocol import NO_SECRET, SECRET_BYTES, WHOLE, Extent, ObjectKind
from fiber._transport.channels import naming_the_limit
from fiber._wire.descriptor import Descriptor, own

Hosted: TypeAlias = HostedChannel | HostedCounter | HostedMemory | HostedSemaphore | HostedWaitList


class NoSuchObject(LookupError):
    """Error: the grant was used or released, or the user is not attached."""


class SharedObject:
    """Channel, counter or block of this host that other processes may request."""

    __slots__ = (
        "__weakref__",
        "_descriptors",
        "attached",
        "extent",
        "identity",
        "kind",
        "server",
    )

    def __init__(
        self,
        kind: ObjectKind,
        descriptors: Sequence[Descriptor],
        extent: Extent,
        identity: bytes,
    ) -> None:
        self.kind = kind
        self._descriptors = descriptors
        self.extent = extent
        self.identity = identity
        """Identity of shared memory, the same in each handle of it, known to its users alone."""
        self.attached = 0
        self.server: Hosted | None = None

    @property
    def hosted(self) -> Hosted:
        """Server for the attached streams."""
        assert self.server is not None
        return self.server

    def duplicates(self) -> list[int]:
        """Return duplicates of the descriptors."""
        numbers: list[int] = []
        try:
            for descriptor in self._descriptors:
                numbers.append(os.dup(descriptor.fileno()))
        except OSError:
            for number in numbers:
                os.close(number)
            raise
        return numbers

    def end_service(self) -> None:
        """Stop serving the object, as no stream is attached."""
        server, self.server = self.server, None
        if server is not None:
            server.close()


class ObjectAttachment(NamedTuple):
    """Attachment of one stream to an object."""

    shared: SharedObject
    token: bytes


class Grant(NamedTuple):
    """Permission to use an object."""

    shared: SharedObject
    reusable: bool


class Registry:
    """Objects of one hub.  Runs on the loop thread, except ``register`` and ``release``.

    Those two take no lock and never wait, so a finalizer or signal handler may interrupt them at
    any step.  They leave a note for the loop.  Each other method reads the notes first, so a grant
    is known before a process can use it.
    """

    def __init__(
        self, host: Callable[[SharedObject], Hosted], call_soon: Callable[..., None]
    ) -> None:
        self._host = host
        self._call_soon = call_soon
        self._secret = os.urandom(SECRET_BYTES)
        self._registered: deque[tuple[bytes, Grant]] = deque()
        # An object that is registered several times needs one descriptor.  Two threads may each
        # register it first at the same time, and keep two, which does no harm.
        self._objects: weakref.WeakValueDictionary[tuple[int, ...], SharedObject] = (
            weakref.WeakValueDictionary()
        )
        self._grants: dict[bytes, Grant] = {}
        self._users: dict[bytes, list[SharedObject]] = {}
        """Objects by the token of their user, with an entry for each stream."""

    def register(
        self,
        kind: ObjectKind,
        fd: int,
        extent: Extent = WHOLE,
        *,
        beside: Sequence[int] = (),
        reusable: bool,
    ) -> tuple[bytes, bytes]:
        """Keep the object of ``fd``; return a grant for it and its identity.

        ``beside`` are further descriptors of the object.  The caller keeps its descriptors.
        """
        known = (kind, _identity(kind, fd), extent.offset)
        shared = self._objects.get(known)
        if shared is None:
            identity = NO_SECRET if kind in _WITHOUT_IDENTITY else self._identify(known)
            with naming_the_limit("sharing a pipe or queue with another process"):
                kept = [own(os.dup(number)) for number in (fd, *beside)]
                shared = SharedObject(kind, kept, extent, identity)
            self._objects[known] = shared
        grant = os.urandom(SECRET_BYTES)
        self._registered.append((grant, Grant(shared, reusable)))
        return grant, shared.identity

    def _identify(self, known: tuple[int, ...]) -> bytes:
        """Return an object's identity, the same each time, also after it was forgotten."""
        return hmac.digest(self._secret, struct.pack("<3Q", *known), "sha256")[:SECRET_BYTES]

    def release(self, grants: Iterable[bytes]) -> None:
        """Ask the loop to end ``grants``, which no process uses from now on."""
        self._call_soon(self.take_back, grants)

    def take_back(self, grants: Iterable[bytes]) -> None:
        """End ``grants`` now."""
        self._settle()
        for grant in grants:
            self._grants.pop(grant, None)

    def grant(self, token: bytes, *, reusable: bool) -> tuple[bytes, bytes]:
        """Make a grant for the object of this token's user; return it and the identity."""
        shared = self._used_by(token)
        grant = os.urandom(SECRET_BYTES)
        self._grants[grant] = Grant(shared, reusable)
        return grant, shared.identity

    def fetch(self, grant: bytes) -> list[int]:
        """Return an object's descriptors for a process on this host; use up a plain grant."""
        shared = self._granted(grant)
        with naming_the_limit("receiving a pipe or queue from another process"):
            fds = shared.duplicates()
        self._use(grant)
        return fds

    def attach(self, token: bytes, grant: bytes = NO_SECRET) -> ObjectAttachment:
        """Attach a stream of a user on another host, until ``detach``.

        A user that is attached may attach another stream with the same token and no grant.
        """
        shared = self._used_by(token) if grant == NO_SECRET else self._granted(grant)
        if self._users.get(token, [shared])[0] is not shared:
            raise NoSuchObject("the token is already in use for another object")
        if shared.server is None:
            with naming_the_limit("serving a pipe or queue to another host"):
                shared.server = self._host(shared)
        shared.attached += 1
        self._users.setdefault(token, []).append(shared)
        self._use(grant)
        return ObjectAttachment(shared, token)

    def hosted(self, token: bytes) -> Hosted:
        """Return the server of the object that the user of this token is attached to."""
        return self._used_by(token).hosted

    def look_up(self, token: bytes, grant: bytes) -> SharedObject:
        """Return the object that the user is attached to or may attach to by this grant."""
        return self._used_by(token) if token in self._users else self._granted(grant)

    def detach(self, attachment: ObjectAttachment) -> None:
        """Detach one stream."""
        shared, token = attachment
        streams = self._users[token]
        streams.pop()
        if not streams:
            del self._users[token]
        shared.attached -= 1
        if not shared.attached:
            shared.end_service()

    def close(self) -> None:
        """Drop all objects."""
        self._registered.clear()
        for streams in self._users.values():
            streams[0].end_service()
        self._users.clear()
        self._grants.clear()

    def _settle(self) -> None:
        """Read the notes of ``register``."""
        while self._registered:
            grant, granted = self._registered.popleft()
            self._grants[grant] = granted

    def _granted(self, grant: bytes) -> SharedObject:
        self._settle()
        granted = self._grants.get(grant)
        if granted is None:
            raise NoSuchObject(_NOT_THERE)
        return granted.shared

    def _used_by(self, token: bytes) -> SharedObject:
        streams = self._users.get(token)
        if streams is None:
            raise NoSuchObject(_NOT_THERE)
        return streams[0]

    def _use(self, grant: bytes) -> None:
        granted = self._grants.get(grant)
        if granted is not None and not granted.reusable:
            del self._grants[grant]


_CHANNELS = (ObjectKind.CHANNEL, ObjectKind.SENDER, ObjectKind.RECEIVER)
_WITHOUT_IDENTITY = (*_CHANNELS, ObjectKind.COUNTER)

_NOT_THERE = (
    "the pipe, queue or other object of this handle is gone: the handle was used once already, "
    "or all processes with the object have ended"
)


def _identity(kind: ObjectKind, fd: int) -> int:
    """Return a number that all descriptors of one kernel object share, while it exists."""
    if kind is ObjectKind.COUNTER:
        return _event_counter(fd)
    status = os.fstat(fd)
    is_channel = kind in _CHANNELS
    if is_channel and not stat.S_ISSOCK(status.st_mode):
        raise ValueError(f"descriptor {fd} is not a socket")
    if not is_channel and not stat.S_ISREG(status.st_mode):
        raise ValueError(f"descriptor {fd} is not shared memory")
    return status.st_ino


def _event_counter(fd: int) -> int:
    with open(f"/proc/self/fdinfo/{fd}", "rb") as info:
        for line in info:
            if line.startswith(b"eventfd-id:"):
                return int(line.split()[1])
    raise ValueError(f"descriptor {fd} is not an event counter")
