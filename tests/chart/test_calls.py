"""Check that the operator's rights are exactly the calls that it makes.

The operator lives through all that makes it call the API server, in virtual time and with a fake
one, which takes note.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable

import pytest

from chart.helm import NAMESPACE as OWN
from chart.helm import Helm, allowed, named
from fakes import virtual_time
from fakes.kubernetes_api import Call
from fakes.store import KINDS
from fakes.world import NAMESPACE, World, a_world, configuration
from fiber_api.names import SERVING_LEASE, SERVING_NAMESPACE
from fiber_operator import watches
from fiber_operator.cluster import Configuration
from fiber_operator.events import PAUSE

Right = tuple[str, str, str]
MASTER = {
    "host": "10.0.3.7",
    "port": 41337,
    "epoch": 1,
    "identity": "laptop-7:4711",
    "leaseName": "es",
}


@pytest.fixture(scope="module")
def calls() -> list[Call]:
    """Return the calls of an operator that meets every event."""
    made: list[Call] = []

    async def test() -> None:
        async with a_world(namespace=OWN, resync_seconds=20) as world:
            stop = asyncio.Event()
            watching = asyncio.ensure_future(watch(world, stop))
            for happens in (
                grows,
                loses_workers,
                keeps_a_budget,
                uses_a_relay,
                gets_stuck,
                meets_masters,
                is_orphaned,
            ):
                await happens(world)
            stop.set()
            await watching
            made.extend(world.api.calls)

    virtual_time.run(test())
    return made


async def watch(world: World, stop: asyncio.Event) -> None:
    """Run the watches of the operator's own thread."""

    async def configure() -> Configuration:
        return configuration(world.api)

    async def gate() -> None: ...

    await watches.watch(
        lambda *notice: None, configure=configure, namespaces=(), gate=gate, stop=stop
    )


async def grows(world: World) -> None:
    world.make_pool(minReplicas=2)
    await world.ready(2)


async def loses_workers(world: World) -> None:
    """A user deletes one after the other, which causes the same event again."""
    for _ in range(2):
        world.store.delete("pods", NAMESPACE, world.names()[0], {})
        await world.settled(PAUSE + 1)
        await world.ready(2)


async def keeps_a_budget(world: World) -> None:
    """Ask for a budget, change it from outside, and remove the request."""
    world.edit(minAvailable=1)
    await world.until(lambda: bool(counted(world, "create", "poddisruptionbudgets")))
    meddled = {"spec": {"minAvailable": 5}}
    world.store.merge("poddisruptionbudgets", NAMESPACE, "es-fiber", meddled)
    await world.until(lambda: bool(counted(world, "patch", "poddisruptionbudgets")), 120)
    world.edit(minAvailable=None)
    await world.until(lambda: bool(counted(world, "delete", "poddisruptionbudgets")))


async def uses_a_relay(world: World) -> None:
    """Ask for a relay, and let the next master come without one."""
    world.edit(relay=True)
    await world.until(lambda: bool(counted(world, "create", "deployments")))
    world.edit(relay=False)
    await world.until(lambda: bool(counted(world, "delete", "deployments")))


async def gets_stuck(world: World) -> None:
    """Request a worker that its node cannot start, as only an event says; then scale down."""
    world.kubelet.auto = False
    world.edit(replicas=3)
    await world.until(lambda: len(world.names()) == 3)
    for pod in world.pods():
        if "nodeName" not in pod["spec"]:
            world.kubelet.waiting(NAMESPACE, pod["metadata"]["name"], "ContainerCreating")
    await world.until(lambda: bool(counted(world, "list", "events")))
    world.edit(replicas=2)
    await world.until(lambda: len(world.names()) == 2)


async def meets_masters(world: World) -> None:
    """Attach masters of both address families, while the Service is changed from outside."""
    world.store.create("leases", NAMESPACE, {"metadata": {"name": MASTER["leaseName"]}})
    world.edit(master=MASTER, onLost="Delete")
    meddled = {"spec": {"selector": {"app": "x"}}}
    world.store.merge("services", NAMESPACE, "es-fiber", meddled)
    await world.until(
        lambda: (
            "selector" not in world.store.get("services", NAMESPACE, "es-fiber")["spec"]
            and bool(counted(world, "patch", "endpointslices"))
        )
    )
    world.edit(master={**MASTER, "host": "fd00::7"})
    await world.until(lambda: bool(counted(world, "delete", "endpointslices")))


async def is_orphaned(world: World) -> None:
    """Let the Lease of a master expire."""
    await world.until(lambda: not world.store.list("fiberpools"), within=600)


def counted(world: World, verb: str, plural: str) -> int:
    return sum(call.verb == verb and call.plural == plural for call in world.api.calls)


def rights(calls: Iterable[Call], where: Callable[[Call], bool]) -> set[Right]:
    """Return the permissions that RBAC was asked for."""
    return {
        (
            KINDS[call.plural][0].rpartition("/")[0],
            f"{call.plural}/{call.subresource}" if call.subresource else call.plural,
            call.verb,
        )
        for call in calls
        if where(call)
    }


def test_the_rights_on_pools_match_the_calls(helm: Helm, calls: list[Call]) -> None:
    role = named(helm.render(), "ClusterRole", f"{OWN}:fiber-fiber-operator")
    places = (OWN, SERVING_NAMESPACE)
    assert rights(calls, lambda call: call.namespace not in places) == set(allowed(role))


def test_the_rights_on_the_own_lease_match_the_calls(helm: Helm, calls: list[Call]) -> None:
    role = named(helm.render(), "Role", "fiber-fiber-operator-lease")
    assert rights(calls, lambda call: call.namespace == OWN) == set(allowed(role))
    (names,) = (rule["resourceNames"] for rule in role["rules"] if "resourceNames" in rule)
    renewed = {call.name for call in calls if call.namespace == OWN and call.verb == "update"}
    assert {name.replace("fiber-fiber-operator", "fiber-operator") for name in names} == renewed


def test_the_rights_on_the_serving_lease_match_the_calls(helm: Helm, calls: list[Call]) -> None:
    role = named(helm.render(), "Role", f"{OWN}:fiber-fiber-operator-serving-lease")
    assert role["metadata"]["namespace"] == SERVING_NAMESPACE
    assert rights(calls, lambda call: call.namespace == SERVING_NAMESPACE) == set(allowed(role))
    (names,) = (rule["resourceNames"] for rule in role["rules"] if "resourceNames" in rule)
    assert names == [SERVING_LEASE]
