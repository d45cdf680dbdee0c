"""Whether the masters of the pools are alive, judged by their Leases.

A master is alive while its Lease changes.  Only this process's monotonic clock counts, and only
time in which it looked: while the API server cannot be had a master cannot renew its Lease either,
so the watch begins anew after every gap.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from fiber_operator.cluster import LEASES, ApiError, Body, Cluster, Gone, Refused
from fiber_operator.logs import about
from fiber_operator.planning.plans import LeaseVerdict
from fiber_operator.workqueue import Key

LOOKS = 3
"""Looks within one duration; the SDK renews as often."""
LONGEST_PAUSE = 30.0
AT_ONCE = 8
"""Leases that are read at the same time."""

log = logging.getLogger(__name__)


class Term(NamedTuple):
    """What is watched: one master of a pool.  Another epoch is another master."""

    lease: str
    epoch: int
    seconds: float


@dataclass
class _Watched:
    term: Term
    due: float
    verdict: LeaseVerdict
    seen: tuple[object, ...] | None = None
    """What the Lease said at the last look; None: there was none, or there is a gap since."""
    changed: float = 0.0
    """When it was first seen to say so."""
    looked: float = 0.0

    @property
    def pause(self) -> float:
        return min(self.term.seconds / LOOKS, LONGEST_PAUSE)


class Masters:
    """Looks at the Leases that pools name and tells when a verdict changes."""

    def __init__(self, cluster: Cluster, on_change: Callable[[Key], None]) -> None:
        self._cluster = cluster
        self._on_change = on_change
        self._watched: dict[Key, _Watched] = {}
        self._wake = asyncio.Event()

    def follow(self, key: Key, term: Term | None) -> LeaseVerdict:
        """Watch this master of the pool from now on (None: none) and say what is known of it."""
        watched = self._watched.get(key)
        if term is None:
            self._watched.pop(key, None)
            return LeaseVerdict()
        if watched is None or watched.term != term:
            watched = self._watched[key] = _Watched(term, self._now(), LeaseVerdict())
            self._wake.set()
        return watched.verdict

    async def run(self) -> None:
        """Look when it is time to, until cancelled."""
        while True:
            self._wake.clear()
            due = [key for key, watched in self._watched.items() if watched.due <= self._now()]
            for start in range(0, len(due), AT_ONCE):
                await asyncio.gather(*(self._look(key) for key in due[start : start + AT_ONCE]))
            soonest = min((watched.due for watched in self._watched.values()), default=None)
            try:
                async with asyncio.timeout_at(soonest):
                    await self._wake.wait()
            except TimeoutError:
                pass  # a look is due

    async def _look(self, key: Key) -> None:
        watched = self._watched.get(key)
        if watched is None:
            return
        lease: Body = {}
        try:
            lease = await self._cluster.read(LEASES, key.namespace, watched.term.lease)
        except Gone:
            pass  # judged like one that does not change: it may be made yet
        except ApiError as error:
            log.warning("the master's Lease cannot be read: %s", error, extra=about(*key))
            watched.seen, watched.due = None, self._now() + watched.pause
            if isinstance(error, Refused):
                self._conclude(key, watched, LeaseVerdict(unreadable=error.message))
            return
        verdict = self._judge(watched, lease)
        watched.looked = self._now()
        watched.due = watched.looked + watched.pause
        self._conclude(key, watched, verdict)

    def _conclude(self, key: Key, watched: _Watched, verdict: LeaseVerdict) -> None:
        before, watched.verdict = watched.verdict, verdict
        if watched.verdict != before and self._watched.get(key) is watched:
            self._on_change(key)

    def _judge(self, watched: _Watched, lease: Body) -> LeaseVerdict:
        spec = lease.get("spec")
        spec = spec if isinstance(spec, dict) else {}
        holder, seen = (
            spec.get("holderIdentity") or "",
            (spec.get("holderIdentity"), spec.get("renewTime")),
        )
        now, alive = self._now(), watched.verdict.alive
        gap = now - watched.looked > 2 * watched.pause + 1
        if watched.seen is None or gap:
            watched.changed = now
        elif seen != watched.seen:
            # One that was deleted or let go may be taken up by the next master: that is waited for.
            watched.changed, alive = now, True if holder else alive
        elif now - watched.changed >= watched.term.seconds:
            alive = False
        watched.seen = seen
        return LeaseVerdict(alive=alive, holder=str(holder), missing=not lease)

    def _now(self) -> float:
        return asyncio.get_running_loop().time()
