"""What a pool has beside its pods: the Secret, the Service and its EndpointSlice.

They are looked at when the operator meets a pool, again every ``LOOK_AGAIN`` seconds, and for as
long as something is wrong with them; between that, only a new master causes a call.
"""

from __future__ import annotations

import asyncio
import datetime
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from fiber_api import names
from fiber_api.certificates import Certificates, InvalidCertificates, make_pool_certificates
from fiber_api.names import Reason
from fiber_api.v1alpha1 import FiberPool, Master
from fiber_operator import manifests
from fiber_operator.cluster import (
    SECRETS,
    SERVICES,
    SLICES,
    Body,
    Cluster,
    Conflict,
    Gone,
    Invalid,
    Refused,
    Resource,
    Unavailable,
)
from fiber_operator.documents import items, mapping
from fiber_operator.plans import Obstacle

LOOK_AGAIN = 50.0


@dataclass(frozen=True)
class Surroundings:
    """What was found or made."""

    address: str | None
    """``host:port`` of the Service."""
    obstacles: tuple[Obstacle, ...]
    master: Master | None
    """Where the EndpointSlice leads."""
    looked: float


class _Obstructed(Exception):
    def __init__(self, obstacle: Obstacle) -> None:
        super().__init__(obstacle.message)
        self.obstacle = obstacle


class Keeper:
    """Makes and mends them.  ``now`` gives unix seconds."""

    def __init__(self, cluster: Cluster, now: Callable[[], float]) -> None:
        self._cluster = cluster
        self._now = now

    async def ensure(self, pool: FiberPool, known: Surroundings | None) -> Surroundings:
        """What there is now; ``known`` is what this returned for the pool last time."""
        fresh = known is not None and self._now() - known.looked < LOOK_AGAIN
        if known is not None and fresh and not known.obstacles:
            if known.master == pool.spec.master:
                return known
            (slice_,) = await self._all(self._slice(pool))
            return Surroundings(known.address, slice_[1], pool.spec.master, known.looked)
        found = await self._all(self._slice(pool), self._service(pool), self._secret(pool))
        obstacles = tuple(obstacle for _, several in found for obstacle in several)
        return Surroundings(found[1][0], obstacles, pool.spec.master, self._now())

    async def _all(self, *steps: Any) -> list[tuple[str | None, tuple[Obstacle, ...]]]:
        """What each step returns, and what stands in its way; the first other error is raised."""
        results: list[tuple[str | None, tuple[Obstacle, ...]]] = []
        for result in await asyncio.gather(*steps, return_exceptions=True):
            if isinstance(result, _Obstructed):
                results.append((None, (result.obstacle,)))
            elif isinstance(result, BaseException):
                raise result
            else:
                results.append((result, ()))
        return results

    async def _secret(self, pool: FiberPool) -> None:
        now = datetime.datetime.fromtimestamp(self._now(), datetime.UTC)
        name, namespace = names.secret_name(pool.metadata.name), pool.metadata.namespace

        def new() -> Body:
            made = make_pool_certificates(pool.metadata.name, namespace, now)
            return manifests.secret(pool, made.texts())

        existing = await self._have(pool, SECRETS, name, new)
        try:
            certificates = Certificates.from_secret(mapping(existing, "data"))
            certificates.check(names.server_name(pool.metadata.name, namespace), now)
        except InvalidCertificates as error:
            message = (
                f"the Secret {name} cannot serve: {error}. Delete it: the operator makes a new "
                "one. Then restart the master and the workers, which hold the old ones."
            )
            raise _Obstructed(Obstacle(Reason.INVALID_CREDENTIALS, message, True)) from None

    async def _service(self, pool: FiberPool) -> str:
        name, namespace = names.service_name(pool.metadata.name), pool.metadata.namespace
        wanted = manifests.service(pool)
        existing = await self._have(pool, SERVICES, name, lambda: wanted)
        spec = mapping(existing, "spec")
        if spec.get("selector") or not _has_ports(spec, wanted["spec"]["ports"]):
            patch = {"spec": {"selector": None, "ports": wanted["spec"]["ports"]}}
            await self._cluster.patch(SERVICES, namespace, name, patch)
        host = spec.get("clusterIP")
        if not isinstance(host, str) or host in ("", "None"):
            message = (
                f"the Service {name} has no cluster IP, which agents dial. Delete it: the operator "
                "makes a new one."
            )
            raise _Obstructed(Obstacle(Reason.NAME_TAKEN, message, True))
        return names.address_of(host, names.MASTER_PORT)

    async def _slice(self, pool: FiberPool) -> None:
        name, namespace = names.endpoint_slice_name(pool.metadata.name), pool.metadata.namespace
        wanted = manifests.endpoint_slice(pool)
        existing = await self._have(pool, SLICES, name, lambda: wanted)
        if manifests.slice_must_be_replaced(pool, existing):
            uid = str(mapping(existing, "metadata").get("uid"))
            await self._cluster.delete(SLICES, namespace, name, uid=uid)
            await self._have(pool, SLICES, name, lambda: wanted)
            return
        patch = manifests.slice_patch(pool, existing)
        if patch is not None:
            await self._cluster.patch(SLICES, namespace, name, patch)

    async def _have(
        self, pool: FiberPool, resource: Resource, name: str, new: Callable[[], Body]
    ) -> Body:
        """The object of this name, made if there is none; obstructed if it is another's."""
        namespace = pool.metadata.namespace
        try:
            existing = await self._cluster.read(resource, namespace, name)
        except Gone:
            return await self._make(pool, resource, name, new())
        if not manifests.is_ours(pool, existing):
            raise _Obstructed(_taken(pool, resource, name, existing))
        return existing

    async def _make(self, pool: FiberPool, resource: Resource, name: str, body: Body) -> Body:
        what = f"the {body['kind']} {name}"
        try:
            return await self._cluster.create(resource, pool.metadata.namespace, body)
        except Conflict:
            # It was made between the two calls; the next look finds out by whom.
            raise
        except (Refused, Invalid) as error:
            message = (
                f"{what} cannot be made: {error.message}. The pool needs it; remove what refuses "
                "it (a quota, a policy, missing rights of the operator)."
            )
            raise _Obstructed(Obstacle(Reason.FORBIDDEN, message)) from error
        except Unavailable as error:
            message = (
                f"{what} could not be made: {error.message}. The operator tries again; look at "
                "the API server if this stays."
            )
            raise _Obstructed(Obstacle(Reason.API_UNAVAILABLE, message)) from error


def _has_ports(spec: Mapping[str, Any], ports: list[Body]) -> bool:
    there = [{key: port.get(key) for key in ports[0]} for port in items(spec.get("ports"))]
    return there == ports


def _taken(pool: FiberPool, resource: Resource, name: str, existing: Body) -> Obstacle:
    owners = [
        owner
        for owner in items(mapping(existing, "metadata").get("ownerReferences"))
        if owner.get("kind") == names.KIND and owner.get("name") == pool.metadata.name
    ]
    what = f"{existing.get('kind', resource.plural)} {name}"
    if owners:
        return Obstacle(
            Reason.NAME_TAKEN,
            f"the {what} of an earlier FiberPool {pool.metadata.name} is still there. Kubernetes "
            "deletes it soon; if it stays, delete it yourself.",
        )
    return Obstacle(
        Reason.NAME_TAKEN,
        f"there is a {what} that is not this pool's, and the pool needs the name. Delete or "
        "rename it, or give the pool another name.",
        terminal=True,
    )
