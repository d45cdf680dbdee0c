"""Registry of the objects that a hub keeps for processes of other hosts.

An object stays as long as someone on another host is attached to it or a grant for it is out.  A
grant is the permission that travels inside a pickled handle: 128 random bits.  A plain one ends
with its first use; a reusable one lasts until it is released.  A user that attaches by a grant
brings a *token*, 128 random bits that it has chosen.  While it is attached, the token lets it
attach again and grant the object to others.
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
from fiber._wire.descriptor import Descriptor, opened

Hosted: TypeAlias = HostedChannel | HostedCounter | HostedMemory | HostedSemaphore | HostedWaitList


class NoSuchObject(LookupError):
    """The grant was used up or released, or the user is not attached."""


class SharedObject:
    """A channel, counter or block of this host, while others may ask for it."""

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
        """Serves those who are attached."""
        assert self.server is not None
        return self.server

    def duplicates(self) -> list[int]:
        """Duplicate its descriptors."""
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
        """End the service: no stream is attached."""
        server, self.server = self.server, None
        if server is not None:
            server.close()


class ObjectAttachment(NamedTuple):
    """Stream of a user of an object."""

    shared: SharedObject
    token: bytes


class Grant(NamedTuple):
    """A permission to use an object."""

    shared: SharedObject
    reusable: bool


class Registry:
    """The objects of one hub.  On the loop's thread, but for ``register`` and ``release``.

    Those two take no lock and wait for nothing, so that a finalizer or signal handler may come at
    any line of them: they leave a note for the loop.  Nobody can come with a grant before the loop
    has seen the note of it, since each method looks for notes first.
    """

    def __init__(
        self, host: Callable[[SharedObject], Hosted], call_soon: Callable[..., None]
    ) -> None:
        self._host = host
        self._call_soon = call_soon
        self._secret = os.urandom(SECRET_BYTES)
        self._registered: deque[tuple[bytes, Grant]] = deque()
        # So that one descriptor does for an object, however often it is registered.  Of two threads
        # that share it for the first time each may keep one: as good, but one too many.
        self._objects: weakref.WeakValueDictionary[tuple[int, ...], SharedObject] = (
            weakref.WeakValueDictionary()
        )
        self._grants: dict[bytes, Grant] = {}
        self._users: dict[bytes, list[SharedObject]] = {}
        """Objects by the tokens of their users, with an entry for each stream."""

    def register(
        self,
        kind: ObjectKind,
        fd: int,
        extent: Extent = WHOLE,
        *,
        beside: Sequence[int] = (),
        reusable: bool,
    ) -> tuple[bytes, bytes]:
        """Keep what ``fd`` refers to, which stays the caller's; a grant and its identity.

        ``beside`` are further descriptors that belong to it.
        """
        known = (kind, _identity(kind, fd), extent.offset)
        shared = self._objects.get(known)
        if shared is None:
            identity = NO_SECRET if kind in _WITHOUT_IDENTITY else self._identify(known)
            with naming_the_limit("sharing a pipe or queue with another process"):
                kept = [opened(os.dup, number) for number in (fd, *beside)]
                shared = SharedObject(kind, kept, extent, identity)
            self._objects[known] = shared
        grant = os.urandom(SECRET_BYTES)
        self._registered.append((grant, Grant(shared, reusable)))
        return grant, shared.identity

    def _identify(self, known: tuple[int, ...]) -> bytes:
        """Return an object's identity, the same each time, even after the object was forgotten."""
        return hmac.digest(self._secret, struct.pack("<3Q", *known), "sha256")[:SECRET_BYTES]

    def release(self, grants: Iterable[bytes]) -> None:
        """Have the loop take ``grants`` back, which no process will use from now on."""
        self._call_soon(self.take_back, grants)

    def take_back(self, grants: Iterable[bytes]) -> None:
        """Take ``grants`` back now."""
        self._settle()
        for grant in grants:
            self._grants.pop(grant, None)

    def grant(self, token: bytes, *, reusable: bool) -> tuple[bytes, bytes]:
        """Make one more grant for the object of this token's user; return it and the identity."""
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
        """Attach a user on another host; ``detach`` ends that.

        A user that is attached already may attach again with the same token and no grant.
        """
        shared = self._used_by(token) if grant == NO_SECRET else self._granted(grant)
        if self._users.get(token, [shared])[0] is not shared:
            raise NoSuchObject("the token is already in use for something else")
        if shared.server is None:
            with naming_the_limit("serving a pipe or queue to another host"):
                shared.server = self._host(shared)
        shared.attached += 1
        self._users.setdefault(token, []).append(shared)
        self._use(grant)
        return ObjectAttachment(shared, token)

    def hosted(self, token: bytes) -> Hosted:
        """Return what the user of this token is attached to."""
        return self._used_by(token).hosted

    def look_up(self, token: bytes, grant: bytes) -> SharedObject:
        """Return the object that the user is attached to, or may attach to by this grant."""
        return self._used_by(token) if token in self._users else self._granted(grant)

    def detach(self, attachment: ObjectAttachment) -> None:
        """Remove one stream."""
        shared, token = attachment
        streams = self._users[token]
        streams.pop()
        if not streams:
            del self._users[token]
        shared.attached -= 1
        if not shared.attached:
            shared.end_service()

    def close(self) -> None:
        """Let go of everything."""
        self._registered.clear()
        for streams in self._users.values():
            streams[0].end_service()
        self._users.clear()
        self._grants.clear()

    def _settle(self) -> None:
        """Enter what was registered meanwhile."""
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
    "the pipe, queue or event that this handle stands for is not there any more: "
    "the handle was used once already, or all of its holders have ended"
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
