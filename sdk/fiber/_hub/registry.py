"""Which objects a hub hosts, and what keeps each of them there.

An object stays as long as someone on another host is attached to it or a grant for it is out.  A
grant is the permission that travels inside a pickled handle.  A plain one is used up by whoever
takes it first; a reusable one lasts until it is released.
"""

from __future__ import annotations

import itertools
import os
import stat
import threading
from collections.abc import Callable

from fiber._hub.hosted import Hosted
from fiber._hub.protocol import ObjectKind
from fiber._transport.unix import naming_the_limit


class NoSuchObject(LookupError):
    """The grant was used up or released, or nobody holds the object any more."""


class Entry:
    """A hosted object and its holders."""

    __slots__ = ("attached", "grants", "hosted", "identity", "number")

    def __init__(self, number: int, hosted: Hosted, identity: tuple[int, int]) -> None:
        self.number = number
        self.hosted = hosted
        self.identity = identity
        self.attached = 0
        self.grants: set[int] = set()


class Registry:
    """The objects of one hub.  Any thread.

    A finalizer or signal handler that shares something may interrupt a thread that holds the lock,
    and takes it again.  So between any two lines everything is in order, and ``register`` makes
    sure that what it found is still there once it holds it.

    ``call_soon`` has something done in a moment, and takes no lock for it.
    """

    def __init__(
        self,
        host: Callable[[ObjectKind, int], Hosted],
        discard: Callable[[Hosted], None],
        call_soon: Callable[..., None],
    ) -> None:
        self._host = host
        self._discard = discard
        self._call_soon = call_soon
        self._lock = threading.RLock()
        # Ids are unguessable only in so far as nobody without the hub's key gets to ask for one.
        self._numbers = itertools.count(1)
        self._entries: dict[int, Entry] = {}
        self._by_identity: dict[tuple[int, int], Entry] = {}
        self._grants: dict[int, Entry] = {}
        self._reusable: set[int] = set()

    def register(self, kind: ObjectKind, fd: int, *, reusable: bool) -> tuple[int, int]:
        """Host what ``fd`` refers to, which stays the caller's; its number and a grant."""
        identity = _identity(kind, fd)
        with self._lock:
            grant = next(self._numbers)
            entry = self._by_identity.get(identity)
            if entry is None or not self._hold(entry, grant):
                with naming_the_limit("sharing a pipe or queue with another process"):
                    hosted = self._host(kind, os.dup(fd))
                entry = Entry(next(self._numbers), hosted, identity)
                entry.grants.add(grant)
                self._entries[entry.number] = self._by_identity[identity] = entry
            self._note(entry, grant, reusable)
            return entry.number, grant

    def grant(self, number: int, *, reusable: bool) -> int:
        """One more grant for an object."""
        with self._lock:
            entry, grant = self._find(number), next(self._numbers)
            self._hold(entry, grant)
            self._note(entry, grant, reusable)
            return grant

    def fetch(self, number: int, grant: int) -> int:
        """A descriptor for someone on this host; uses up a plain grant."""
        with self._lock:
            entry = self._find(number, grant)
            with naming_the_limit("receiving a pipe or queue from another process"):
                fd = os.dup(entry.hosted.fileno())
            self._use(entry, grant)
        return fd

    def attach(self, number: int, grant: int) -> Entry:
        """Someone on another host uses it now; ``detach`` ends that.

        Who is attached already may attach again with grant 0.
        """
        with self._lock:
            entry = self._find(number, grant)
            entry.attached += 1
            self._use(entry, grant)
        return entry

    def detach(self, entry: Entry) -> None:
        """One user less."""
        with self._lock:
            entry.attached -= 1
            self._drop_if_unused(entry)

    def release(self, grant: int) -> None:
        """Nobody will use the grant any more."""
        with self._lock:
            entry = self._grants.get(grant)
            if entry is not None:
                self._end(entry, grant)

    def release_soon(self, grant: int) -> None:
        """The same for finalizers, which run anywhere, even where this thread holds a lock."""
        self._call_soon(self.release, grant)

    def close(self) -> None:
        """Let go of everything."""
        with self._lock:
            for entry in list(self._entries.values()):
                self._discard(entry.hosted)
            self._entries.clear()
            self._by_identity.clear()
            self._grants.clear()
            self._reusable.clear()

    def __len__(self) -> int:
        return len(self._entries)

    def _find(self, number: int, grant: int = 0) -> Entry:
        entry = self._entries.get(number)
        if entry is None or (grant and grant not in entry.grants) or not (grant or entry.attached):
            raise NoSuchObject(
                "the pipe, queue or event that this handle stands for is not there any more: "
                "the handle was used once already, or all of its holders have ended"
            )
        return entry

    def _hold(self, entry: Entry, grant: int) -> bool:
        """Keep the object; False if its last holder has just let go of it."""
        entry.grants.add(grant)
        return entry.number in self._entries

    def _note(self, entry: Entry, grant: int, reusable: bool) -> None:
        if reusable:
            self._reusable.add(grant)
        self._grants[grant] = entry

    def _use(self, entry: Entry, grant: int) -> None:
        if grant and grant not in self._reusable:
            self._end(entry, grant)

    def _end(self, entry: Entry, grant: int) -> None:
        self._grants.pop(grant, None)
        self._reusable.discard(grant)
        entry.grants.discard(grant)
        self._drop_if_unused(entry)

    def _drop_if_unused(self, entry: Entry) -> None:
        if entry.attached or entry.grants:
            return
        if self._entries.pop(entry.number, None) is not None:
            if self._by_identity.get(entry.identity) is entry:
                del self._by_identity[entry.identity]
            self._discard(entry.hosted)


def _identity(kind: ObjectKind, fd: int) -> tuple[int, int]:
    """What two descriptors of one kernel object have in common, while it exists."""
    if kind is ObjectKind.CHANNEL:
        status = os.fstat(fd)
        if not stat.S_ISSOCK(status.st_mode):
            raise ValueError(f"descriptor {fd} is not a socket")
        return kind, status.st_ino
    with open(f"/proc/self/fdinfo/{fd}", "rb") as info:
        for line in info:
            if line.startswith(b"eventfd-id:"):
                return kind, int(line.split()[1])
    raise ValueError(f"descriptor {fd} is not an event counter")
