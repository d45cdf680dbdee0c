"""Monitor of the masters' Leases, by which the operator knows whether masters live.

A master is alive while its Lease changes.  One watch (``watches.py``) reports the changes of all
masters' Leases, selected by their label.  The monitor reads a Lease itself only when its master is
new, and twice before it calls the master lost, since a watch may be late or broken.  So a thousand
healthy masters cost no requests.

Only this process's monotonic clock counts, and only time in which the Lease could be read: while
the API server cannot be reached, a master cannot renew its Lease either.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import NamedTuple

from fiber_api.names import ANNOTATION_CONNECTED
from fiber_operator.cluster import LEASES, Cluster
from fiber_operator.logs import about
from fiber_operator.planning.documents import mapping, text
from fiber_operator.planning.plans import LeaseVerdict
from fiber_operator.responses import ApiError, Gone, Refused
from fiber_operator.workqueue import Key

log = logging.getLogger(__name__)


CONFIRMED_AFTER = 1 / 3
"""Share of the duration in which an unchanged Lease must change before its master is lost.  The SDK
renews as often, so a master that could not renew for a while gets its turn."""
MISSING_AFTER = 5.0
"""Seconds after which a Lease that is not there is missed: a program makes it after its pool."""
RECHECK = 60.0
"""Seconds after which the Lease of a lost master is read again."""
AT_ONCE = 8
"""Leases that are read at the same time."""


class MasterLease(NamedTuple):
    """Master of a pool that is watched.  Another epoch is another master."""

    name: str
    epoch: int
    seconds: float


@dataclass
class _Watched:
    lease: MasterLease
    changed: float
    """Time at which the Lease was first seen in its present state."""
    due: float
    """Time at which to read the Lease."""
    version: str | None = None
    """Version of the Lease; empty: there is no such Lease, None: it was not read yet."""
    doubted: bool = False
    """A read has found it unchanged for the whole duration."""
    verdict: LeaseVerdict = field(default_factory=LeaseVerdict)

    def begin_anew(self, now: float) -> None:
        """The whole duration is the master's again."""
        self.changed, self.due, self.doubted = now, now + self.lease.seconds, False


class LeaseMonitor:
    """Watches the Leases that pools name and tells when a verdict changes."""

    def __init__(self, cluster: Cluster, on_change: Callable[[Key], None]) -> None:
        self._cluster = cluster
        self._on_change = on_change
        self._watched: dict[Key, _Watched] = {}
        self._pools: dict[tuple[str, str], set[Key]] = {}
        """Pools by the namespace and the name of the Lease."""
        self._wake = asyncio.Event()

    def follow(self, key: Key, lease: MasterLease | None) -> LeaseVerdict:
        """Watch this master of the pool from now on (None: none) and say what is known of it."""
        watched = self._watched.get(key)
        if watched is not None and watched.lease == lease:
            return watched.verdict
        if watched is not None:
            self._forget(key, watched)
        if lease is not None:
            self._watched[key] = _Watched(lease, self._now(), self._now())
            self._pools.setdefault((key.namespace, lease.name), set()).add(key)
            self._wake.set()
        return LeaseVerdict()

    def heard(self, namespace: str, name: str, version: str, connected: int | None = None) -> None:
        """The watch says what a Lease's resourceVersion is now; empty: it was deleted.

        ``connected`` is how many agents the master says it has.
        """
        for key in tuple(self._pools.get((namespace, name), ())):
            self._see(key, self._watched[key], version, connected)

    async def run(self) -> None:
        """Read the Leases of which nothing is heard, until cancelled."""
        while True:
            self._wake.clear()
            due = in_turn(key for key, seen in self._watched.items() if seen.due <= self._now())
            for start in range(0, len(due), AT_ONCE):
                await asyncio.gather(*(self._read(key) for key in due[start : start + AT_ONCE]))
            soonest = min((watched.due for watched in self._watched.values()), default=None)
            try:
                async with asyncio.timeout_at(soonest):
                    await self._wake.wait()
            except TimeoutError:
                pass  # one is due

    def _forget(self, key: Key, watched: _Watched) -> None:
        del self._watched[key]
        place = key.namespace, watched.lease.name
        self._pools[place].discard(key)
        if not self._pools[place]:
            del self._pools[place]

    async def _read(self, key: Key) -> None:
        watched = self._watched.get(key)
        if watched is None:
            return
        late = self._now() - watched.due > watched.lease.seconds * CONFIRMED_AFTER
        connected = None
        try:
            lease = await self._cluster.read(LEASES, key.namespace, watched.lease.name)
            version = text(mapping(lease, "metadata").get("resourceVersion"))
            connected = connected_in(lease)
        except Gone:
            version = ""  # judged like one that does not change: it may be made yet
        except ApiError as error:
            log.warning("the master's Lease cannot be read: %s", error, extra=about(*key))
            watched.begin_anew(self._now())
            if isinstance(error, Refused):
                watched.version = None
                self._conclude(key, watched, LeaseVerdict(unreadable=error.message))
            return
        if self._see(key, watched, version, connected):
            return
        if late and watched.verdict.alive is not False:
            # This process was stopped, or busy: what did not reach it meanwhile says nothing.
            watched.begin_anew(self._now())
        else:
            self._find_unchanged(key, watched)

    def _see(self, key: Key, watched: _Watched, version: str, connected: int | None) -> bool:
        """Note the state of a Lease; return whether it has changed.

        To find it is no sign of life, for it may be that of a master that died long ago.
        """
        before, watched.version = watched.version, version
        if before is None and not version:
            watched.due = self._now() + min(MISSING_AFTER, watched.lease.seconds)
            return True
        if version == before:
            return False
        alive = watched.verdict.alive
        if before is None or version:
            watched.begin_anew(self._now())
            alive = None if before is None else True
        # Until it changes, it may be the word of the master before.
        said = connected if alive else None
        self._conclude(key, watched, LeaseVerdict(alive, missing=not version, connected=said))
        return True

    def _find_unchanged(self, key: Key, watched: _Watched) -> None:
        now, seconds = self._now(), watched.lease.seconds
        if not (watched.version or watched.verdict.missing):
            self._conclude(key, watched, replace(watched.verdict, missing=True))
        if now - watched.changed < seconds:
            watched.due = watched.changed + seconds
        elif not watched.doubted:
            watched.doubted, watched.due = True, now + seconds * CONFIRMED_AFTER
        else:
            watched.due = now + max(RECHECK, seconds)
            self._conclude(key, watched, LeaseVerdict(alive=False, missing=not watched.version))

    def _conclude(self, key: Key, watched: _Watched, verdict: LeaseVerdict) -> None:
        before, watched.verdict = watched.verdict, verdict
        if verdict != before and self._watched.get(key) is watched:
            self._on_change(key)

    def _now(self) -> float:
        return asyncio.get_running_loop().time()


def connected_in(lease: object) -> int | None:
    """Return how many agents the Lease says its master has, if it says so."""
    said = text(mapping(lease, "metadata", "annotations").get(ANNOTATION_CONNECTED))
    return int(said) if said.isascii() and said.isdigit() and len(said) < 10 else None


def in_turn(keys: Iterable[Key]) -> list[Key]:
    """Return ``keys`` with one of each namespace first, then a second of each, and so on."""
    namespaces: dict[str, list[Key]] = {}
    for key in keys:
        namespaces.setdefault(key.namespace, []).append(key)
    rounds = zip_longest(*namespaces.values())
    return [key for found in rounds for key in found if key is not None]
