"""Leases of the operator itself: one for leader election, and one that shows programs that it runs.

Leader election: of the processes of one release, only the leader changes objects.  Each process
measures with its monotonic clock whether the leader's Lease has expired, from the moment at which
it last saw that Lease change.  It never compares clocks of two machines.  The leader measures its
time from the moment before its request.  It starts no write after two thirds of that time, and
limits the duration of each write.  So no write runs when another process becomes the leader::

    request                       the last write starts    the last write ends  others may begin
      |------ 2/3 of the duration ------|-----------------------|-------- 1/10 --------|

The heartbeat is no lock: each operator that serves a namespace writes the same Lease, and programs
only check that it is recent.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

from fiber_api import names
from fiber_api.rest import LEASES, ApiError, Body, Conflict, NotFound, ServerUnreachable
from fiber_api.times import format_micro_time
from fiber_operator.cluster import Cluster
from fiber_operator.logs import about
from fiber_operator.responses import complaint

log = logging.getLogger(__name__)


HELD_SHARE = 2 / 3
"""Share of the duration in which the leader may start writes after a renewal."""
WRITTEN_SHARE = 9 / 10
"""Share of the duration after which the last write has ended.  The rest allows for clock drift."""
LONGEST_DURATION = 10
"""Longest duration that another process's Lease may claim, in durations of this operator.  An
account that may write the Lease must not stop the operator for years."""
RENEW_SHARE = 1 / 3
"""Share of the duration between two renewals."""
RETRY_SHARE = 1 / 8
"""Share of the duration between two attempts to become the leader."""


class NotLeader(Exception):
    """Error of a write while this operator is not the leader."""


class LeaderElector:
    """Candidate for the Lease of the leader.

    ``on_change`` is called with True when this operator becomes the leader, and with False when it
    stops being the leader.
    """

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
        self._renewed_at = float("-inf")
        """Time just before the last request that renewed the Lease."""
        self._failures = 0
        """Requests that failed one after the other."""
        self._reported = False
        """Last value that ``on_change`` got."""
        self._lease: Body | None = None
        self._other: tuple[object, ...] = ()
        """State in which the Lease of another process was last seen."""
        self._other_since = 0.0
        """Time at which ``_other`` was first seen."""
        self._resigned = False
        self.why = "it has not read the Lease yet"
        """Reason why this operator is not the leader; empty while it is."""

    @property
    def is_leader(self) -> bool:
        """True while this operator may change objects."""
        return self._clock() < self._until

    @property
    def _until(self) -> float:
        return self._renewed_at + HELD_SHARE * self._seconds

    def require(self) -> float:
        """Return the seconds that a write may last which begins now.  Raises NotLeader."""
        now = self._clock()
        if now >= self._until:
            raise NotLeader(
                f"this operator does not hold the Lease {self._name}, because {self.why}"
            )
        return self._renewed_at + WRITTEN_SHARE * self._seconds - now

    async def run(self) -> None:
        """Get the Lease and renew it until cancelled."""
        while True:
            pause = await self.step()
            self._report()
            await asyncio.sleep(pause)

    def resign(self) -> None:
        """Stop being the leader, but keep the Lease until ``release``.

        So running calls can end before another operator begins.
        """
        self._resigned = True
        self._lose("this operator is stopping")

    async def release(self) -> None:
        """Give up the Lease, so that another operator may begin at once.  Call ``resign`` first."""
        try:
            lease = await self._read()
            if _spec(lease).get("holderIdentity") == self._identity:
                await self._write(lease, holder="", seconds=1)
        except ApiError as error:
            log.warning(
                "the Lease is kept until it expires, as its release failed: %s",
                error,
            )

    async def step(self) -> float:
        """Take or renew the Lease if possible.  Return the seconds until the next step."""
        started = self._clock()
        try:
            if self._lease is None or not self.is_leader:
                self._lease = await self._read()
            try:
                await self._take_or_renew(started)
            except (Conflict, NotFound):
                # Another process wrote it, or the answer to this one was lost: read the holder.
                self._lease = await self._read()
                await self._take_or_renew(started)
            self._failures = 0
        except Conflict:
            self._lose("another operator wrote the Lease")
        except ApiError as error:
            # The last renewal stays valid.  When its time ends, ``is_leader`` becomes False.
            self.why = str(error)
            self._failures += 1
        return self._pause()

    async def _take_or_renew(self, started: float) -> None:
        if self._may_take(self._lease):
            self._lease = await self._write(
                self._lease, holder=self._identity, seconds=int(self._seconds)
            )
            if not self._resigned:
                self._renewed_at, self.why = started, ""

    def _pause(self) -> float:
        if self.is_leader and not self.why:
            pause = RENEW_SHARE * self._seconds
        elif self._failures:
            pause = min(RETRY_SHARE * self._seconds, 2.0 ** min(self._failures - 1, 10))
        else:
            pause = RETRY_SHARE * self._seconds
        if self.is_leader:
            # Wake up when the renewal expires, so that ``on_change`` is called in time.
            pause = min(pause, max(self._until - self._clock(), 0.0) + 0.001)
        return pause

    async def _read(self) -> Body | None:
        try:
            return await self._cluster.read(LEASES, self._namespace, self._name)
        except NotFound:
            return None

    def _may_take(self, lease: Body | None) -> bool:
        spec = _spec(lease)
        holder = spec.get("holderIdentity") or ""
        if holder in ("", self._identity):
            return True
        now, other = self._clock(), (holder, spec.get("renewTime"), spec.get("leaseTransitions"))
        if other != self._other:
            self._other, self._other_since = other, now
        duration = spec.get("leaseDurationSeconds")
        if not isinstance(duration, int) or duration <= 0:
            duration = int(self._seconds)
        duration = min(duration, LONGEST_DURATION * self._seconds)
        if now - self._other_since >= duration:
            return True
        self._lose(f"{holder} holds the Lease")
        return False

    async def _write(self, lease: Body | None, *, holder: str, seconds: int) -> Body:
        spec = _spec(lease)
        stamp = format_micro_time(self._wall_clock())
        new_holder = (spec.get("holderIdentity") or "") != self._identity
        transitions = spec.get("leaseTransitions")
        turns = transitions if isinstance(transitions, int) else 0
        body: Body = {
            "apiVersion": "coordination.k8s.io/v1",
            "kind": "Lease",
            "metadata": {"name": self._name, "namespace": self._namespace},
            "spec": {
                "holderIdentity": holder,
                "leaseDurationSeconds": seconds,
                "acquireTime": stamp if new_holder else spec.get("acquireTime", stamp),
                "renewTime": stamp,
                "leaseTransitions": turns + 1 if new_holder and lease is not None else turns,
            },
        }
        if lease is None:
            return await self._cluster.create(LEASES, self._namespace, body)
        version = lease["metadata"].get("resourceVersion")
        if not version:
            # Without it this write could replace the Lease of another process.
            raise ServerUnreachable("the Lease has no resourceVersion")
        body["metadata"]["resourceVersion"] = version
        return await self._cluster.replace(LEASES, self._namespace, self._name, body)

    def _lose(self, why: str) -> None:
        self._renewed_at, self.why = float("-inf"), why

    def _report(self) -> None:
        if self.is_leader == self._reported:
            return
        self._reported = self.is_leader
        if self._reported:
            log.info("this operator is the leader now", extra=about(reason="LeaseHeld"))
        else:
            log.warning(
                "this operator is the leader no longer: %s",
                self.why,
                extra=about(reason="LeaseLost"),
            )
        self._on_change(self._reported)


def _spec(lease: Body | None) -> dict[str, Any]:
    spec = lease.get("spec") if lease is not None else None
    return spec if isinstance(spec, dict) else {}


# -- The heartbeat

RENEW_SERVING = names.SERVING_SECONDS / 5
"""Seconds between two renewals."""
RETRY_SERVING = 1.0
"""Seconds until the next step in a namespace that is not served yet."""
RETRY_REFUSED = 15.0
"""Seconds until the next attempt after the Lease could not be written."""


class Heartbeat:
    """Writer of the Lease that shows programs that an operator serves ``namespaces`` (empty: all).

    A Lease is renewed while ``serves`` returns True for its namespace (empty: all).
    """

    def __init__(
        self,
        cluster: Cluster,
        *,
        namespaces: Sequence[str],
        identity: str,
        serves: Callable[[str], bool],
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        self._cluster = cluster
        self._namespaces = tuple(namespaces) or ("",)
        self._identity = identity
        self._serves = serves
        self._wall_clock = wall_clock
        self._failures: dict[str, str] = {}
        """Errors of Leases that could not be written, by namespace."""

    async def run(self) -> None:
        """Renew the Leases until cancelled."""
        await asyncio.gather(*map(self._keep_fresh, self._namespaces))

    async def _keep_fresh(self, namespace: str) -> None:
        while True:
            await asyncio.sleep(await self._step(namespace))

    async def _step(self, namespace: str) -> float:
        """Renew the Lease if the namespace is served.  Return the seconds until the next step."""
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
        except NotFound:
            await self._cluster.create(LEASES, where, _serving_lease(spec))


def _serving_lease(spec: Body) -> Body:
    labels = {names.LABEL_MANAGED_BY: names.OPERATOR_MANAGER}
    return {
        "apiVersion": "coordination.k8s.io/v1",
        "kind": "Lease",
        "metadata": {"name": names.SERVING_LEASE, "labels": labels},
        "spec": spec,
    }
