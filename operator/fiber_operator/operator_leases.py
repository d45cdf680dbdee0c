"""Leases that the operator itself holds: one to act, and one to show programs that it serves.

Leader election: of several processes of one release, at most one acts.  Each process judges by its
monotonic clock whether another process's Lease has expired, from the moment it last saw that Lease
change.  Clocks of different machines are never compared.  The holder counts its time from before
its request.  It starts no write after two thirds of that time, and limits each write, so that none
is under way when another process may begin::

    request                       the last write starts    the last write ends  others may begin
      |------ 2/3 of the duration ------|-----------------------|-------- 1/10 --------|

The heartbeat locks nothing: each operator that serves a namespace writes the same Lease, and
programs only look whether it is fresh.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

from fiber_api import names
from fiber_api.times import format_micro_time
from fiber_operator.cluster import LEASES, Cluster
from fiber_operator.logs import about
from fiber_operator.responses import ApiError, Body, Conflict, Gone, Unavailable, complaint

log = logging.getLogger(__name__)


HELD_SHARE = 2 / 3
"""Share of the duration for which a renewal lets the holder act."""
WRITTEN_SHARE = 9 / 10
"""Share of the duration after which its last write has ended.  The rest is for differing clocks."""
LONGEST_PATIENCE = 10
"""Times this operator's own duration that a Lease lasts which is not renewed, whatever it says: an
account that may write it must not stop the operator for years."""
RENEW_SHARE = 1 / 3
RETRY_SHARE = 1 / 8


class NotLeader(Exception):
    """The Lease that this operator needs to change anything is not its own."""


class LeaderElector:
    """Gets and keeps the Lease.  ``on_change`` is called with whether this operator may act."""

    def __init__(
        self,
        cluster: Cluster,
        *,
        namespace: str,
        name: str,
        identity: str,
        seconds: float,
        on_change: Callable[[bool], None] = lambda held: None,
        clock: Callable[[], float] | None = None,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        self._cluster = cluster
        self._namespace = namespace
        self._name = name
        self._identity = identity
        self._seconds = seconds
        self._on_change = on_change
        self._clock = clock or asyncio.get_running_loop().time
        self._wall_clock = wall_clock
        self._asked = float("-inf")
        """Time at which it asked for the Lease that it holds."""
        self._failures = 0
        self._told = False
        self._lease: Body | None = None
        self._seen: tuple[object, ...] = ()
        self._seen_at = 0.0
        self._resigned = False
        self.why = "the Lease was not read yet"
        """Why this operator does not act; empty while it does."""

    @property
    def is_leader(self) -> bool:
        """True while this operator may act."""
        return self._clock() < self._until

    @property
    def _until(self) -> float:
        return self._asked + HELD_SHARE * self._seconds

    def require(self) -> float:
        """The seconds that a write may last which begins now; NotLeader if none may begin."""
        now = self._clock()
        if now >= self._until:
            raise NotLeader(f"this operator does not hold the Lease {self._name}: {self.why}")
        return self._asked + WRITTEN_SHARE * self._seconds - now

    async def run(self) -> None:
        """Get the Lease and renew it until cancelled."""
        while True:
            pause = await self.step()
            self._tell()
            await asyncio.sleep(pause)

    def resign(self) -> None:
        """Act no more from now on.  The Lease stays until ``release``, so that what is under way
        can end before another operator begins."""
        self._resigned = True
        self._lose("this operator is stopping")

    async def release(self) -> None:
        """Let another operator begin at once, if the API server can be had.  After ``resign``."""
        try:
            lease = await self._read()
            if _spec(lease).get("holderIdentity") == self._identity:
                await self._write(lease, holder="", seconds=1)
        except ApiError as error:
            log.warning("the Lease could not be released: %s", error)

    async def step(self) -> float:
        """Ask for the Lease, or renew it; returns the seconds until the next step is due."""
        started = self._clock()
        try:
            if self._lease is None or not self.is_leader:
                self._lease = await self._read()
            try:
                await self._ask(started)
            except (Conflict, Gone):
                # By somebody else, or by us and the answer was lost: what it says now decides.
                self._lease = await self._read()
                await self._ask(started)
            self._failures = 0
        except Conflict:
            self._lose("another operator wrote the Lease")
        except ApiError as error:
            # The time that the last renewal gave goes on; after that, ``is_leader`` is false.
            self.why = str(error)
            self._failures += 1
        return self._pause()

    async def _ask(self, started: float) -> None:
        if self._may_take(self._lease):
            self._lease = await self._write(
                self._lease, holder=self._identity, seconds=int(self._seconds)
            )
            if not self._resigned:
                self._asked, self.why = started, ""

    def _pause(self) -> float:
        if self.is_leader and not self.why:
            pause = RENEW_SHARE * self._seconds
        elif self._failures:
            pause = min(RETRY_SHARE * self._seconds, 2.0 ** min(self._failures - 1, 10))
        else:
            pause = RETRY_SHARE * self._seconds
        if self.is_leader:
            # Not beyond the moment at which it lapses, so that it is told of in time.
            pause = min(pause, max(self._until - self._clock(), 0.0) + 0.001)
        return pause

    async def _read(self) -> Body | None:
        try:
            return await self._cluster.read(LEASES, self._namespace, self._name)
        except Gone:
            return None

    def _may_take(self, lease: Body | None) -> bool:
        spec = _spec(lease)
        holder = spec.get("holderIdentity") or ""
        if holder in ("", self._identity):
            return True
        now, seen = self._clock(), (holder, spec.get("renewTime"), spec.get("leaseTransitions"))
        if seen != self._seen:
            self._seen, self._seen_at = seen, now
        patience = spec.get("leaseDurationSeconds")
        if not isinstance(patience, int) or patience <= 0:
            patience = int(self._seconds)
        patience = min(patience, LONGEST_PATIENCE * self._seconds)
        if now - self._seen_at >= patience:
            return True
        self._lose(f"{holder} holds it")
        return False

    async def _write(self, lease: Body | None, *, holder: str, seconds: int) -> Body:
        spec = _spec(lease)
        stamp = format_micro_time(self._wall_clock())
        fresh = (spec.get("holderIdentity") or "") != self._identity
        transitions = spec.get("leaseTransitions")
        turns = transitions if isinstance(transitions, int) else 0
        body: Body = {
            "apiVersion": "coordination.k8s.io/v1",
            "kind": "Lease",
            "metadata": {"name": self._name, "namespace": self._namespace},
            "spec": {
                "holderIdentity": holder,
                "leaseDurationSeconds": seconds,
                "acquireTime": stamp if fresh else spec.get("acquireTime", stamp),
                "renewTime": stamp,
                "leaseTransitions": turns + 1 if fresh and lease is not None else turns,
            },
        }
        if lease is None:
            return await self._cluster.create(LEASES, self._namespace, body)
        version = lease["metadata"].get("resourceVersion")
        if not version:
            # Without it another's Lease could be written over.
            raise Unavailable("the Lease has no resourceVersion")
        body["metadata"]["resourceVersion"] = version
        return await self._cluster.replace(LEASES, self._namespace, self._name, body)

    def _lose(self, why: str) -> None:
        self._asked, self.why = float("-inf"), why

    def _tell(self) -> None:
        if self.is_leader == self._told:
            return
        self._told = self.is_leader
        if self._told:
            log.info("this operator acts now", extra=about(reason="LeaseHeld"))
        else:
            log.warning("this operator acts no more: %s", self.why, extra=about(reason="LeaseLost"))
        self._on_change(self._told)


def _spec(lease: Body | None) -> dict[str, Any]:
    spec = lease.get("spec") if lease is not None else None
    return spec if isinstance(spec, dict) else {}


# -- The heartbeat

RENEW_SERVING = names.SERVING_SECONDS / 5
"""Seconds between two renewals."""
RETRY_SERVING = 1.0
"""Seconds until the next look where the namespace is not served yet."""
RETRY_REFUSED = 15.0
"""Seconds until the next attempt where the Lease could not be written."""


class Heartbeat:
    """Renews the Lease wherever ``serves`` says so.  ``namespaces`` are served; empty: all."""

    def __init__(
        self,
        cluster: Cluster,
        *,
        namespaces: Sequence[str],
        identity: str,
        serves: Callable[[str], bool],
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        """``serves`` is called with a namespace, or with nothing (all namespaces)."""
        self._cluster = cluster
        self._namespaces = tuple(namespaces) or ("",)
        self._identity = identity
        self._serves = serves
        self._wall_clock = wall_clock
        self._failures: dict[str, str] = {}
        """Namespace of a Lease -> why it cannot be written."""

    async def run(self) -> None:
        """Go on until cancelled."""
        await asyncio.gather(*map(self._keep, self._namespaces))

    async def _keep(self, namespace: str) -> None:
        while True:
            await asyncio.sleep(await self._step(namespace))

    async def _step(self, namespace: str) -> float:
        """Renew the Lease if the namespace is served; returns the seconds until the next step."""
        if not self._serves(namespace):
            return RETRY_SERVING
        where = namespace or names.SERVING_NAMESPACE
        try:
            await self._write(where)
        except ApiError as error:
            failure = complaint(error)
            if self._failures.get(where) != failure:
                log.warning(
                    "programs with backend='auto' do not find this operator: %s",
                    failure,
                    extra=about(where, reason=error.reason),
                )
            self._failures[where] = failure
            return RETRY_REFUSED
        self._failures.pop(where, None)
        return RENEW_SERVING

    async def _write(self, where: str) -> None:
        spec = {
            "holderIdentity": self._identity,
            "leaseDurationSeconds": names.SERVING_SECONDS,
            "renewTime": format_micro_time(self._wall_clock()),
        }
        try:
            await self._cluster.patch(LEASES, where, names.SERVING_LEASE, {"spec": spec})
        except Gone:
            await self._cluster.create(LEASES, where, _serving_lease(spec))


def _serving_lease(spec: Body) -> Body:
    labels = {names.LABEL_MANAGED_BY: names.OPERATOR_MANAGER}
    return {
        "apiVersion": "coordination.k8s.io/v1",
        "kind": "Lease",
        "metadata": {"name": names.SERVING_LEASE, "labels": labels},
        "spec": spec,
    }
