"""Which objects of its host a hub keeps for others, and what keeps each of them there.

An object stays as long as someone on another host is attached to it or a grant for it is out.  A
grant is the permission that travels inside a pickled handle.  A plain one is used up by whoever
takes it first; a reusable one lasts until it is released.
"""

from __future__ import annotations

import itertools
import os
import stat
import weakref
from collections import deque
from collections.abc import Callable, Iterable
from typing import TypeAlias

from fiber._hub.hosted import HostedChannel, HostedCounter, HostedMemory
from fiber._hub.hosted_semaphore import HostedSemaphore
from fiber._hub.hosted_wait_list import HostedWaitList
from fiber._hub.protocol import WHOLE, Extent, ObjectKind
from fiber._transport.unix import naming_the_limit
from fiber._wire.descriptor import Descriptor, opened

Hosted: TypeAlias = HostedChannel | HostedCounter | HostedMemory | HostedSemaphore | HostedWaitList


class NoSuchObject(LookupError):
    """The grant was used up or released, or nobody holds the object any more."""


class SharedObject:
    """A channel, counter or block of this host, while others may ask for it."""

    __slots__ = ("__weakref__", "attached", "descriptor", "extent", "hosted", "kind")

    def __init__(self, kind: ObjectKind, descriptor: Descriptor, extent: Extent) -> None:
        self.kind = kind
        self.descriptor = descriptor
        self.extent = extent
        self.attached = 0
        self.hosted: Hosted | None = None
        """What serves those who are attached."""

    def end_service(self) -> None:
        """Nobody is attached any more."""
        hosted, self.hosted = self.hosted, None
        if hosted is not None:
            hosted.close()


class Entry:
    """An object as it was registered once, and its holders."""

    __slots__ = ("attached", "grants", "number", "shared")

    def __init__(self, number: int, shared: SharedObject) -> None:
        self.number = number
        self.shared = shared
        self.attached = 0
        self.grants: set[int] = set()

    @property
    def hosted(self) -> Hosted:
        """The object, for those who are attached."""
        assert self.shared.hosted is not None
        return self.shared.hosted


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
        # Ids are unguessable only in so far as nobody without the hub's key gets to ask for one.
        self._numbers = itertools.count(1)
        self._registered: deque[tuple[Entry, int, bool]] = deque()
        # So that one descriptor does for an object, however often it is registered.  Of two threads
        # that share it for the first time each may keep one: as good, but one too many.
        self._objects: weakref.WeakValueDictionary[tuple[int, ...], SharedObject] = (
            weakref.WeakValueDictionary()
        )
        self._entries: dict[int, Entry] = {}
        self._grants: dict[int, Entry] = {}
        self._reusable: set[int] = set()

    def register(
        self, kind: ObjectKind, fd: int, extent: Extent = WHOLE, *, reusable: bool
    ) -> tuple[int, int]:
        """Keep what ``fd`` refers to, which stays the caller's; a number for it and a grant."""
        identity = (kind, _identity(kind, fd), extent.offset)
        shared = self._objects.get(identity)
        if shared is None:
            with naming_the_limit("sharing a pipe or queue with another process"):
                shared = SharedObject(kind, opened(os.dup, fd), extent)
            self._objects[identity] = shared
        number, grant = next(self._numbers), next(self._numbers)
        self._registered.append((Entry(number, shared), grant, reusable))
        return number, grant

    def release(self, grants: Iterable[int]) -> None:
        """Nobody will use them any more.  It is done in a moment."""
        self._call_soon(self.take_back, grants)

    def take_back(self, grants: Iterable[int]) -> None:
        """The same, now."""
        self._settle()
        for grant in grants:
            self._end(grant)

    def grant(self, number: int, *, reusable: bool) -> int:
        """One more grant for an object."""
        self._settle()
        entry, grant = self._find(number), next(self._numbers)
        self._note(entry, grant, reusable)
        return grant

    def fetch(self, number: int, grant: int) -> int:
        """A descriptor for someone on this host; uses up a plain grant."""
        self._settle()
        entry = self._find(number, grant)
        with naming_the_limit("receiving a pipe or queue from another process"):
            fd = os.dup(entry.shared.descriptor.fileno())
        self._use(grant)
        return fd

    def attach(self, number: int, grant: int) -> Entry:
        """Someone on another host uses it now; ``detach`` ends that.

        Who is attached already may attach again with grant 0.
        """
        self._settle()
        entry = self._find(number, grant)
        shared = entry.shared
        if shared.hosted is None:
            with naming_the_limit("serving a pipe or queue to another host"):
                shared.hosted = self._host(shared)
        shared.attached += 1
        entry.attached += 1
        self._use(grant)
        return entry

    def look_up(self, number: int, grant: int) -> SharedObject:
        """What somebody is attached to, or is about to be by this grant."""
        self._settle()
        entry = self._entries.get(number)
        return self._find(number, grant if entry and grant in entry.grants else 0).shared

    def detach(self, entry: Entry) -> None:
        """One user less."""
        entry.attached -= 1
        entry.shared.attached -= 1
        if not entry.shared.attached:
            entry.shared.end_service()
        self._drop_if_unused(entry)

    def close(self) -> None:
        """Let go of everything."""
        self._registered.clear()
        for entry in self._entries.values():
            entry.shared.end_service()
        self._entries.clear()
        self._grants.clear()
        self._reusable.clear()

    def _settle(self) -> None:
        """Enter what was registered meanwhile."""
        while self._registered:
            entry, grant, reusable = self._registered.popleft()
            self._note(entry, grant, reusable)
            self._entries[entry.number] = entry

    def _find(self, number: int, grant: int = 0) -> Entry:
        entry = self._entries.get(number)
        if entry is None or (grant and grant not in entry.grants) or not (grant or entry.attached):
            raise NoSuchObject(
                "the pipe, queue or event that this handle stands for is not there any more: "
                "the handle was used once already, or all of its holders have ended"
            )
        return entry

    def _note(self, entry: Entry, grant: int, reusable: bool) -> None:
        if reusable:
            self._reusable.add(grant)
        entry.grants.add(grant)
        self._grants[grant] = entry

    def _use(self, grant: int) -> None:
        if grant not in self._reusable:
            self._end(grant)

    def _end(self, grant: int) -> None:
        entry = self._grants.pop(grant, None)
        if entry is not None:
            self._reusable.discard(grant)
            entry.grants.discard(grant)
            self._drop_if_unused(entry)

    def _drop_if_unused(self, entry: Entry) -> None:
        if not entry.attached and not entry.grants:
            self._entries.pop(entry.number, None)


def _identity(kind: ObjectKind, fd: int) -> int:
    """What two descriptors of one kernel object have in common, while it exists."""
    if kind is ObjectKind.COUNTER:
        return _event_counter(fd)
    status = os.fstat(fd)
    if kind is ObjectKind.CHANNEL and not stat.S_ISSOCK(status.st_mode):
        raise ValueError(f"descriptor {fd} is not a socket")
    if kind is not ObjectKind.CHANNEL and not stat.S_ISREG(status.st_mode):
        raise ValueError(f"descriptor {fd} is not shared memory")
    return status.st_ino


def _event_counter(fd: int) -> int:
    with open(f"/proc/self/fdinfo/{fd}", "rb") as info:
        for line in info:
            if line.startswith(b"eventfd-id:"):
                return int(line.split()[1])
    raise ValueError(f"descriptor {fd} is not an event counter")
