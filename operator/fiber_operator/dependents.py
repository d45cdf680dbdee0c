"""Objects of a pool beside its workers: Service, EndpointSlice, Secret, PodDisruptionBudget, relay.

They are checked when the operator first sees a pool, every ``CHECK_INTERVAL`` seconds, and in each
reconcile while something is wrong with them.  Between the checks only a new master, another budget
or the begin or end of a relay causes calls.
A Secret that ``spec.credentialsSecretName`` names belongs to the user; the operator only makes
sure that it is not another pool's, and signs with its key.
"""

from __future__ import annotations

import asyncio
import ipaddress
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any

from fiber_api import identity, names, signatures
from fiber_api.names import Reason
from fiber_api.rest import (
    BUDGETS,
    DEPLOYMENTS,
    SECRETS,
    SERVICES,
    SLICES,
    ApiError,
    Body,
    Conflict,
    Forbidden,
    Invalid,
    NotFound,
    ResourceType,
)
from fiber_api.v1alpha1 import FiberPool, MasterSpec
from fiber_operator.cluster import MAY_PASS, Cluster
from fiber_operator.planning import manifests, messages, relay
from fiber_operator.planning.documents import items, mapping, seconds, text
from fiber_operator.planning.plans import Obstacle, PoolSecret

CHECK_INTERVAL = 50.0


@dataclass(frozen=True)
class Dependents:
    """State of a pool's dependents after they were checked."""

    address: str | None
    """``host:port`` of the Service."""
    obstacles: tuple[Obstacle, ...]
    master: MasterSpec | None
    """Master that the EndpointSlice leads to."""
    checked: float
    """Time of the last complete check."""
    credentials: bool
    """True if the Secret belongs to the pool, or is the user's, and has a valid key."""
    secret: PoolSecret | None = None
    """The pool's Secret; None if ``credentials`` is False."""
    budget: int | None = None
    """Value of the PodDisruptionBudget.  None: there is none.  0: not known."""
    relay_name: str | None = ""
    """Name of the relay's Deployment.  Empty: there is none.  None: not known."""
    awaits_relay: bool = False
    """True if it is too early to say whether the pod of the relay is refused: check again soon."""
    failure: ApiError | None = None
    """Error of a call with an unknown outcome, to be raised after the status was written."""


@dataclass(frozen=True)
class _Found:
    """Outcome of one step."""

    value: str | PoolSecret | None = None
    """Address of the Service, the Secret, or the name of a relay that the cluster acts on."""
    obstacle: Obstacle | None = None
    failure: ApiError | None = None


_Step = Callable[[FiberPool], Awaitable[str | PoolSecret | None]]


class _Obstructed(Exception):
    def __init__(self, obstacle: Obstacle) -> None:
        super().__init__(obstacle.message)
        self.obstacle = obstacle


class _SecretUsers:
    """Pools that name a Secret in ``spec.credentialsSecretName``, each as it was last checked."""

    def __init__(self) -> None:
        self._pools: dict[tuple[str, str], tuple[str, float]] = {}

    def __contains__(self, pool: FiberPool) -> bool:
        return (pool.metadata.namespace, pool.metadata.name) in self._pools

    def earlier(self, pool: FiberPool, secret: str) -> str | None:
        """Note the pool as a user; return the name of the first one that names the Secret."""
        namespace, name = pool.metadata.namespace, pool.metadata.name
        self._pools[namespace, name] = secret, pool.metadata.creation_timestamp or 0.0
        users = [
            (made, user)
            for (where, user), (named, made) in self._pools.items()
            if (where, named) == (namespace, secret)
        ]
        first = min(users)[1]
        return None if first == name else first

    def forget(self, namespace: str, name: str) -> None:
        """Forget a pool that is gone."""
        self._pools.pop((namespace, name), None)


class DependentsReconciler:
    """Creates and repairs the dependents of pools.  ``now`` returns unix seconds."""

    def __init__(self, cluster: Cluster, now: Callable[[], float]) -> None:
        self._cluster = cluster
        self._now = now
        self._users = _SecretUsers()

    def forget(self, namespace: str, name: str) -> None:
        """Forget a pool that is gone."""
        self._users.forget(namespace, name)

    async def ensure(self, pool: FiberPool, known: Dependents | None) -> Dependents:
        """Create what is missing; ``known`` is the result of the last call for the pool.

        A failure becomes an obstacle.  Only a Conflict is raised: the next reconcile then finds out
        what exists.
        """
        name = pool.metadata.name
        steps: list[tuple[str, _Step]] = [
            (f"the EndpointSlice {names.endpoint_slice_name(name)}", self._slice)
        ]
        fresh = known is not None and self._now() - known.checked < CHECK_INTERVAL
        relay_name = names.relay_name(name) if relay.is_wanted(pool) else ""
        complete = (
            known is None
            or not fresh
            or bool(known.obstacles)
            or known.awaits_relay
            or known.relay_name != relay_name  # the Service changes, too
        )
        if known is not None and not complete:
            if (known.master, known.budget) == (pool.spec.master, pool.spec.min_available):
                return known
            address, secret, checked = known.address, known.secret, known.checked
            whole = known.credentials
        else:
            address, secret, checked = None, None, self._now()
            whole = False
            steps += [
                (f"the Service {names.service_name(name)}", self._service),
                (f"the Secret {pool.credentials_secret}", self._secret),
            ]
        budgeted = _concerns_budget(pool, known)
        if budgeted:
            steps.append((f"the PodDisruptionBudget {names.budget_name(name)}", self._budget))
        relayed = complete and (relay_name or _may_have_relay(pool, known))
        if relayed:
            steps.insert(0, (f"the Deployment {names.relay_name(name)}", self._relay))
        outcomes = await _all(*(self._attempt(pool, *step) for step in steps))
        relay_found, *found = outcomes if relayed else (_Found(), *outcomes)
        if complete:
            service, made = found[1].value, found[2].value
            address = service if isinstance(service, str) else None
            secret = made if isinstance(made, PoolSecret) else None
            whole = found[2].obstacle is None
        led = found[0].obstacle is None
        before = known.master if known is not None else None
        return Dependents(
            address,
            tuple(step.obstacle for step in outcomes if step.obstacle is not None),
            pool.spec.master if led else before,
            checked,
            whole,
            secret,
            0 if budgeted and found[-1].obstacle is not None else pool.spec.min_available,
            None if relay_found.obstacle is not None else relay_name,
            bool(relayed and relay_name and relay_found == _Found())
            and not (known is not None and known.awaits_relay),
            next((step.failure for step in outcomes if step.failure is not None), None),
        )

    async def _attempt(self, pool: FiberPool, what: str, step: _Step) -> _Found:
        try:
            return _Found(await step(pool))
        except _Obstructed as obstructed:
            return _Found(obstacle=obstructed.obstacle)
        except Conflict:
            raise
        except ApiError as error:
            obstacle = messages.object_obstacle(error, what)
            return _Found(None, obstacle, error if isinstance(error, MAY_PASS) else None)

    async def _secret(self, pool: FiberPool) -> PoolSecret | None:
        if (brought := pool.spec.credentials_secret_name) is not None:
            return await self._check_brought(pool, brought)
        name = names.secret_name(pool.metadata.name)

        def new() -> Body:
            return manifests.secret(pool, {names.KEY_POOL: identity.new_key()})

        existing = await self._have(pool, SECRETS, name, new)
        remedy = (
            "Delete it: the operator makes a new one. Then restart the master and the workers, "
            "which hold the old key"
        )
        made = seconds(text(mapping(existing, "metadata").get("creationTimestamp")))
        return PoolSecret(made, _signer(pool, existing, remedy))

    async def _check_brought(self, pool: FiberPool, name: str) -> PoolSecret | None:
        """Return the Secret, unless it belongs to another pool, or an earlier pool names it too."""
        reserved = names.pool_of_secret(name)
        if reserved is None:
            self._check_users(pool, name)
        elif reserved != pool.metadata.name:
            why = f"a name that is reserved for the Secret of a FiberPool {reserved}"
            raise _wrong_secret(name, why, reserved)
        try:
            existing = await self._cluster.read(SECRETS, pool.metadata.namespace, name)
        except NotFound:
            if manifests.is_of_a_program(pool):
                return PoolSecret()  # the program is about to make it
            message = (
                f"there is no Secret {name}, which spec.credentialsSecretName names. Make it, with "
                f"{_KEY_ADVICE}."
            )
            raise _Obstructed(Obstacle(Reason.INVALID_CREDENTIALS, message)) from None
        if (other := manifests.other_owner(pool, existing)) is not None:
            raise _wrong_secret(name, f"which is the Secret of the FiberPool {other}", other)
        return PoolSecret(signer=_signer(pool, existing, f"It needs {_KEY_ADVICE}"))

    def _check_users(self, pool: FiberPool, name: str) -> None:
        """Refuse a Secret that an earlier pool names too."""
        is_new = pool not in self._users
        if (earlier := self._users.earlier(pool, name)) is not None:
            raise _wrong_secret(name, f"which the earlier FiberPool {earlier} names too", earlier)
        refused = [p for p in pool.status.problems if p.reason == Reason.INVALID_CREDENTIALS]
        if is_new and refused:
            # After a restart of the operator, the earlier pool may not have been checked yet.
            raise _Obstructed(Obstacle(Reason.INVALID_CREDENTIALS, refused[0].message, True))

    async def _service(self, pool: FiberPool) -> str:
        name, namespace = names.service_name(pool.metadata.name), pool.metadata.namespace
        wanted = manifests.service(pool)
        existing = await self._have_service(pool, name, wanted)
        spec = mapping(existing, "spec")
        selected = mapping(spec, "selector")
        patch = manifests.selector_patch(pool, selected)
        if patch or not _has_ports(spec, wanted["spec"]["ports"]):
            patch["ports"] = wanted["spec"]["ports"]
            await self._cluster.patch(SERVICES, namespace, name, {"spec": patch})
        if selected and not pool.spec.relay and not pool.status.relay:
            # An operator may have ended between the relay's making and its note in the status.
            await self._remove(pool, DEPLOYMENTS, names.relay_name(pool.metadata.name))
        host = spec.get("clusterIP")
        if not isinstance(host, str) or host in ("", "None"):
            message = (
                f"the Service {name} has no cluster IP for agents to dial. Delete it: the operator "
                "makes a new one."
            )
            raise _Obstructed(Obstacle(Reason.NAME_TAKEN, message, True))
        hosts = spec.get("clusterIPs") or [host]
        return ",".join(names.address_of(one, names.MASTER_PORT) for one in hosts)

    async def _have_service(self, pool: FiberPool, name: str, wanted: Body) -> Body:
        """Return the Service, created if needed with its former addresses, which workers dial."""
        if addresses := _former_addresses(pool):
            # A second address would be one that existing workers do not know.
            policy = "PreferDualStack" if len(addresses) > 1 else "SingleStack"
            again = {
                "clusterIP": addresses[0],
                "clusterIPs": addresses,
                "ipFamilyPolicy": policy,
            }
            former = {**wanted, "spec": {**wanted["spec"], **again}}
            try:
                return await self._have(pool, SERVICES, name, lambda: former)
            except Invalid:
                pass  # another Service has the address now
        return await self._have(pool, SERVICES, name, lambda: wanted)

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

    async def _relay(self, pool: FiberPool) -> str | None:
        """Make, replace or remove the relay; ``_service`` leads agents to it.

        Return its name if the cluster has acted on it.
        """
        name, namespace = names.relay_name(pool.metadata.name), pool.metadata.namespace
        if not relay.is_wanted(pool):
            await self._remove(pool, DEPLOYMENTS, name)
            return None
        wanted = relay.deployment(pool)
        try:
            existing = await self._have(pool, DEPLOYMENTS, name, lambda: wanted)
            if not relay.may_stay(pool, existing, wanted):
                uid = str(mapping(existing, "metadata").get("uid"))
                await self._cluster.delete(DEPLOYMENTS, namespace, name, uid=uid)
                existing = await self._cluster.create(DEPLOYMENTS, namespace, wanted)
        except Invalid as error:
            raise _Obstructed(messages.refused_relay(error, name)) from None
        if words := relay.refusal(existing):
            raise _Obstructed(messages.refused_relay_pod(words, name))
        return name if relay.is_observed(existing) else None

    async def _budget(self, pool: FiberPool) -> None:
        name, namespace = names.budget_name(pool.metadata.name), pool.metadata.namespace
        if pool.spec.min_available is None:
            await self._remove(pool, BUDGETS, name)
            return
        wanted = manifests.budget(pool)
        existing = await self._have(pool, BUDGETS, name, lambda: wanted)
        if not wanted["spec"].items() <= mapping(existing, "spec").items():
            await self._cluster.patch(BUDGETS, namespace, name, {"spec": wanted["spec"]})

    async def _remove(self, pool: FiberPool, resource: ResourceType, name: str) -> None:
        """Delete an object of the pool, if it exists."""
        namespace = pool.metadata.namespace
        try:
            existing = await self._cluster.read(resource, namespace, name)
        except NotFound:
            return
        except Forbidden:
            if resource == BUDGETS:
                return  # without the right to read one, the operator has made none
            raise
        if manifests.is_ours(pool, existing):
            uid = str(mapping(existing, "metadata").get("uid"))
            await self._cluster.delete(resource, namespace, name, uid=uid)

    async def _have(
        self, pool: FiberPool, resource: ResourceType, name: str, new: Callable[[], Body]
    ) -> Body:
        """Return the object of this name, created if needed; raise if it is not the pool's."""
        namespace = pool.metadata.namespace
        if pool.status.endpoint is None:
            # A pool without a status usually has no objects yet.
            try:
                return await self._cluster.create(resource, namespace, new())
            except Conflict as error:
                if error.reason != "AlreadyExists":
                    raise
        try:
            existing = await self._cluster.read(resource, namespace, name)
        except NotFound:
            # A Conflict means that it was created between the two calls.
            return await self._cluster.create(resource, namespace, new())
        if not manifests.is_ours(pool, existing):
            raise _Obstructed(_taken(pool, resource, name, existing))
        return existing


_KEY_ADVICE = f"the output of `openssl rand -hex 32` in the entry {names.KEY_POOL}"


def _signer(pool: FiberPool, secret: Body, remedy: str) -> signatures.Signer | None:
    """Return the signer with the pool's key; None if the Secret names the pool's only master.

    ``remedy`` says what helps if there is no key.
    """
    data = mapping(secret, "data")
    if names.KEY_MASTER in data:
        return None
    try:
        return signatures.pool_signer(identity.key_in(data), pool.metadata.uid)
    except identity.InvalidKey as error:
        name = text(mapping(secret, "metadata").get("name"))
        message = f"the Secret {name} has no valid key: {error}. {remedy}."
        raise _Obstructed(Obstacle(Reason.INVALID_CREDENTIALS, message, True)) from None


def _may_have_relay(pool: FiberPool, known: Dependents | None) -> bool:
    return bool(pool.status.relay) if known is None else known.relay_name != ""


def _concerns_budget(pool: FiberPool, known: Dependents | None) -> bool:
    """Return True if the pool has or should have a PodDisruptionBudget, or may have one."""
    if pool.spec.min_available is not None:
        return True
    # A pool without a status has none yet.
    return pool.status.endpoint is not None if known is None else known.budget is not None


async def _all(*steps: Awaitable[_Found]) -> list[_Found]:
    """Await all steps; return their outcomes, or raise the error of one once all have ended."""
    found = []
    for result in await asyncio.gather(*steps, return_exceptions=True):
        if isinstance(result, BaseException):
            raise result
        found.append(result)
    return found


def _former_addresses(pool: FiberPool) -> list[str]:
    """Return the IP addresses in ``status.endpoint``; none if they do not suit the master.

    A Service with one IP family cannot lead to a master with the other.
    """
    endpoint = (pool.status.endpoint or "").removeprefix(f"{names.ENDPOINT_SCHEME}://")
    try:
        found = [
            ipaddress.ip_address(address.rpartition(":")[0].strip("[]"))
            for address in endpoint.split(",")
        ]
    except ValueError:
        return []
    master = None if pool.spec.relay else pool.spec.master
    if master and ipaddress.ip_address(master.host).version not in {one.version for one in found}:
        return []
    return [str(one) for one in found]


def _has_ports(spec: Mapping[str, Any], ports: list[Body]) -> bool:
    there = [{key: port.get(key) for key in ports[0]} for port in items(spec.get("ports"))]
    return there == ports


def _wrong_secret(name: str, why: str, other: str) -> _Obstructed:
    message = (
        f"spec.credentialsSecretName is {name}, {why}. Its reader could pose as a program of "
        f"{other}. Leave credentialsSecretName out, so that the operator makes a Secret, or name "
        "one that belongs to no other pool. The field cannot be changed, so make the pool anew."
    )
    return _Obstructed(Obstacle(Reason.INVALID_CREDENTIALS, message, True))


def _taken(pool: FiberPool, resource: ResourceType, name: str, existing: Body) -> Obstacle:
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
        f"there is a {what} that does not belong to this pool, and the pool needs the name. "
        "Delete or rename it, or give the pool another name.",
        terminal=True,
    )
