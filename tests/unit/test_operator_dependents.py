"""What a pool has beside its pods, and whose it is."""

from __future__ import annotations

import asyncio

from fakes.world import NAMESPACE, World, played
from unit.operator_objects import MASTER

LABELS = {"fiber.dev/pool": "es", "fiber.dev/pool-uid": "1"}


@played
async def test_a_secret_that_the_pool_names_is_neither_made_nor_read(world: World) -> None:
    world.make_pool(replicas=2, credentialsSecretName="mine")
    await world.ready(2)
    await world.settled(120)
    assert [call for call in world.api.calls if call.plural == "secrets"] == []
    assert world.status()["credentialsSecret"] == "mine"
    for pod in world.pods():
        (volume,) = pod["spec"]["volumes"]
        assert volume["projected"]["sources"][0]["secret"]["name"] == "mine"


@played
async def test_names_are_the_pools_and_fibers(world: World) -> None:
    """<pool>-tls is what cert-manager is told to write to, <pool>-master is a likely Service."""
    for plural, name in (("secrets", "es-tls"), ("services", "es-master"), ("leases", "es")):
        world.store.create(plural, NAMESPACE, {"metadata": {"name": name}})
    world.make_pool(replicas=1)
    await world.ready(1)
    assert world.reasons() == []
    assert world.status()["credentialsSecret"] == "es-fiber-tls"
    assert world.store.get("services", NAMESPACE, "es-fiber")["spec"]["clusterIP"]


@played
async def test_the_lease_of_a_master_is_watched(world: World) -> None:
    world.make_pool(replicas=1, master={**MASTER, "leaseName": "fiber-es"})
    lease = {"metadata": {"name": "fiber-es", "labels": LABELS}}
    world.store.create("leases", NAMESPACE, lease)
    await world.ready(1)
    world.api.calls.clear()
    for number in range(30):
        world.store.merge("leases", NAMESPACE, "fiber-es", {"spec": {"renewTime": str(number)}})
        await asyncio.sleep(10)
        assert alive(world) == "True"
    reads = [call for call in world.api.calls if call.name == "fiber-es"]
    assert reads == []


@played
async def test_a_program_that_dies_before_it_makes_its_lease_leaves_no_pool(world: World) -> None:
    master = {**MASTER, "leaseName": "fiber-es", "leaseDurationSeconds": 30, "lostGraceSeconds": 60}
    world.make_pool(master=master, onLost="Delete")
    await world.until(lambda: "LeaseNotFound" in world.reasons(), within=5)
    assert 90 <= await world.until(lambda: not world.store.list("fiberpools"), within=120) <= 105
    for plural in ("secrets", "services", "endpointslices", "pods"):
        assert world.store.list(plural, NAMESPACE) == []


def alive(world: World) -> str:
    (found,) = (c for c in world.status()["conditions"] if c["type"] == "MasterAlive")
    return str(found["status"])
