"""Lease by which programs know that an operator serves their namespace.

It locks nothing: each operator that serves a namespace writes the same Lease, and programs only
look whether it is fresh.  ``leader_election.py`` decides which process acts.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Sequence

from fiber_api import names
from fiber_api.times import format_micro_time
from fiber_operator.api_errors import complaint
from fiber_operator.cluster import LEASES, ApiError, Body, Cluster, Gone
from fiber_operator.logs import about

RENEW = names.SERVING_SECONDS / 5
"""Seconds between two renewals."""
RETRY = 1.0
"""Seconds until the next look where the namespace is not served yet."""
RETRY_REFUSED = 15.0
"""Seconds until the next attempt where the Lease could not be written."""

log = logging.getLogger(__name__)


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
            return RETRY
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
        return RENEW

    async def _write(self, where: str) -> None:
        spec = {
            "holderIdentity": self._identity,
            "leaseDurationSeconds": names.SERVING_SECONDS,
            "renewTime": format_micro_time(self._wall_clock()),
        }
        try:
            await self._cluster.patch(LEASES, where, names.SERVING_LEASE, {"spec": spec})
        except Gone:
            await self._cluster.create(LEASES, where, _lease(spec))


def _lease(spec: Body) -> Body:
    labels = {names.LABEL_MANAGED_BY: names.OPERATOR_MANAGER}
    return {
        "apiVersion": "coordination.k8s.io/v1",
        "kind": "Lease",
        "metadata": {"name": names.SERVING_LEASE, "labels": labels},
        "spec": spec,
    }
