"""Monitor of the masters' Leases, which tells whether the master of a pool is alive.

A master is alive while its Lease changes.  One watch (``watches.py``) reports the changes of all
masters' Leases.  A watch may be late or broken.  So the monitor reads a Lease itself when its
master is new, and twice before it declares the master lost.  A thousand healthy masters cost no
requests.

The monitor measures time with this process's monotonic clock.  Time in which the Lease could not be
read does not count: a master could not renew it either.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import NamedTuple

from fiber_api.names import ANNOTATION_CONNECTED
from fiber_api.rest import LEASES, ApiError, Forbidden, NotFound
from fiber_operator.cluster import Cluster
from fiber_operator.logs import about
from fiber_operator.planning.documents import mapping, text
from fiber_operator.planning.plans import LeaseVerdict
from fiber_operator.workqueue import Key

log = logging.getLogger(__name__)


CONFIRMED_AFTER = 1 / 3
"""Share of the duration for which the monitor waits once more after a Lease has expired.  The SDK
renews this often, so a master that could not renew for a while has time for one renewal."""
MISSING_AFTER = 5.0
"""Seconds until a Lease that does not exist is reported.  A program makes its Lease after its
pool."""
RECHECK = 60.0
"""Seconds after which the Lease of a lost master is read again."""
READS_AT_ONCE = 8
"""Leases that are read at the same time, at most."""


class MasterLease(NamedTuple):
    """Lease of one master of a pool."""

    name: str
    epoch: int
    """Number of the master: each master of a pool has another."""
    seconds: float
    """Duration of the Lease."""


@dataclass
class _Watched:
    lease: MasterLease
    changed: float
    """Time of the last change that was seen."""
    due: float
    """Time of the next read."""
    version: str | None = None
    """resourceVersion of the Lease; empty: it does not exist, None: it was not read yet."""
    suspected: bool = False
    """True if a read has found that the Lease has expired."""
    verdict: LeaseVerdict = field(default_factory=LeaseVerdict)

    def restart_clock(self, now: float) -> None:
        """Give the master the whole duration of its Lease again."""
        self.changed, self.due, self.suspected = now, now + self.lease.seconds, False


class LeaseMonitor:
    """Observer of the Leases that pools name; calls ``on_change`` when a verdict changes."""

    def __init__(self, cluster: Cluster, on_change: Callable[[Key], None]) -> None:
        self._cluster = cluster
        self._on_change = on_change
        self._watched: dict[Key, _Watched] = {}
        self._pools: dict[tuple[str, str], set[Key]] = {}
        """Pools by the namespace and the name of the Lease."""
        self._wake = asyncio.Event()

    def follow(self, key: Key, lease: MasterLease | None) -> LeaseVerdict:
        """Observe this Lease for the pool from now on (None: no Lease); return its verdict."""
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

    def lease_changed(
        self, namespace: str, name: str, version: str, connected: int | None = None
    ) -> None:
        """Note the resourceVersion (empty: deleted) of a Lease that the watch has reported.

        ``connected`` is the number of agents that the master has, if the Lease says so.
        """
        for key in tuple(self._pools.get((namespace, name), ())):
            self._note_state(key, self._watched[key], version, connected)

    async def run(self) -> None:
        """Read the Leases whose changes the watch does not report, until cancelled."""
        while True:
            self._wake.clear()
            due = in_turn(
                key for key, watched in self._watched.items() if watched.due <= self._now()
            )
            for start in range(0, len(due), READS_AT_ONCE):
                await asyncio.gather(
                    *(self._read(key) for key in due[start : start + READS_AT_ONCE])
                )
            soonest = min((watched.due for watched in self._watched.values()), default=None)
            try:
                async with asyncio.timeout_at(soonest):
                    await self._wake.wait()
            except TimeoutError:
                pass  # a read is due

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
        except NotFound:
            version = ""  # as if it did not change: the program may still make it
        except ApiError as error:
            log.warning("the master's Lease cannot be read: %s", error, extra=about(*key))
            watched.restart_clock(self._now())
            if isinstance(error, Forbidden):
                watched.version = None
                self._conclude(key, watched, LeaseVerdict(unreadable=error.message))
            return
        if self._note_state(key, watched, version, connected):
            return
        if late and watched.verdict.alive is not False:
            # This process was stopped or busy, and may have missed changes.
            watched.restart_clock(self._now())
        else:
            self._judge_unchanged(key, watched)

    def _note_state(self, key: Key, watched: _Watched, version: str, connected: int | None) -> bool:
        """Note the state of a Lease.  Return True if it has changed.

        The first read does not show that the master lives: a dead master may have left the Lease.
        """
        before, watched.version = watched.version, version
        if before is None and not version:
            watched.due = self._now() + min(MISSING_AFTER, watched.lease.seconds)
            return True
        if version == before:
            return False
        alive = watched.verdict.alive
        if before is None or version:
            watched.restart_clock(self._now())
            alive = None if before is None else True
        # Until the Lease changes, the number may be that of an earlier master.
        counted = connected if alive else None
        self._conclude(key, watched, LeaseVerdict(alive, missing=not version, connected=counted))
        return True

    def _judge_unchanged(self, key: Key, watched: _Watched) -> None:
        now, seconds = self._now(), watched.lease.seconds
        if not (watched.version or watched.verdict.missing):
            self._conclude(key, watched, replace(watched.verdict, missing=True))
        if now - watched.changed < seconds:
            watched.due = watched.changed + seconds
        elif not watched.suspected:
            watched.suspected, watched.due = True, now + seconds * CONFIRMED_AFTER
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
    """Return the number of agents that the Lease's annotation gives, or None."""
    number = text(mapping(lease, "metadata", "annotations").get(ANNOTATION_CONNECTED))
    return int(number) if number.isascii() and number.isdigit() and len(number) < 10 else None


def in_turn(keys: Iterable[Key]) -> list[Key]:
    """Return ``keys`` so that namespaces take turns: the first of each, the second of each, …"""
    namespaces: dict[str, list[Key]] = {}
    for key in keys:
        namespaces.setdefault(key.namespace, []).append(key)
    rounds = zip_longest(*namespaces.values())
    return [key for keys_of_round in rounds for key in keys_of_round if key is not None]
