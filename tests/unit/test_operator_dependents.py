"""Objects of a pool beside its pods, and their owners."""

from __future__ import annotations

import asyncio
import base64
from typing import Any

import pytest

from fakes import virtual_time
from fakes.kubernetes_api import Fault
from fakes.world import NAMESPACE, World, a_world, played
from fiber_api.signatures import pool_signer
from unit.operator_objects import MASTER

LABELS = {"fiber.dev/pool": "es", "fiber.dev/pool-uid": "1"}


def bring(world: World, name: str, **texts: str) -> None:
    data = {key: base64.b64encode(text.encode()).decode() for key, text in texts.items()}
    world.store.create("secrets", NAMESPACE, {"metadata": {"name": name}, "data": data})


@played
async def test_a_secret_that_the_pool_names_is_not_made(world: World) -> None:
    bring(world, "mine", key="ab" * 32)
    world.make_pool(replicas=2, credentialsSecretName="mine")
    await world.ready(2)
    await world.settled(120)
    calls = {call.verb for call in world.api.calls if call.plural == "secrets"}
    assert calls == {"get"}, "to see that it is no other pool's"
    assert world.status()["credentialsSecret"] == "mine"
    for pod in world.pods():
        assert pod["spec"]["volumes"][0]["secret"]["secretName"] == "mine"


@pytest.mark.parametrize("by", ["owner", "label"])
def test_a_secret_of_another_pool_is_refused(by: str) -> None:
    @played
    async def test(world: World) -> None:
        owner = {"kind": "FiberPool", "name": "theirs", "uid": "77", "controller": True}
        metadata: dict[str, Any] = {"name": "renamed"}
        if by == "owner":
            metadata["ownerReferences"] = [owner]
        else:
            metadata["labels"] = {"fiber.dev/pool": "theirs"}
        world.store.create("secrets", NAMESPACE, {"metadata": metadata, "data": {}})
        world.make_pool(replicas=2, credentialsSecretName="renamed")
        await world.until(lambda: "InvalidCredentials" in world.reasons(), 30)
        assert world.pods() == []
        message = world.status()["problems"][0]["message"]
        assert "which is the Secret of the FiberPool theirs" in message
        assert "Leave credentialsSecretName out" in message

    test()


@pytest.mark.parametrize("name", ["later-fiber-key", f"later-fiber-key-{'a1' * 8}"])
def test_the_name_of_another_pools_secret_is_refused_before_that_pool_exists(name: str) -> None:
    @played
    async def test(world: World) -> None:
        world.make_pool(replicas=1, credentialsSecretName=name)
        await world.until(lambda: "InvalidCredentials" in world.reasons(), 30)
        assert world.pods() == []
        message = world.status()["problems"][0]["message"]
        assert "reserved for the Secret of a FiberPool later" in message

    test()


def shared(world: World, pool: str) -> bool:
    problems = world.status(pool).get("problems") or []
    return any("which the earlier FiberPool es names too" in p["message"] for p in problems)


def test_a_secret_that_an_earlier_pool_names_too_is_refused() -> None:
    async def main() -> None:
        async with a_world() as world:
            bring(world, "mine", key="ab" * 32)
            world.make_pool(replicas=1, credentialsSecretName="mine")
            await world.ready(1)
            await asyncio.sleep(1)  # creationTimestamp is in whole seconds
            world.make_pool("another", replicas=1, credentialsSecretName="mine")
            await world.until(lambda: shared(world, "another"), 30)
            await world.stop()
            # The later pool is the first that the operator sees.
            world.start()
            world.edit("another", replicas=2)
            await world.settled(120)
            assert shared(world, "another")
            assert len(world.pods()) == 1, "all of the earlier pool"
            world.store.delete("fiberpools", NAMESPACE, "es", {})
            await world.ready(2, "another")

    virtual_time.run(main())


@played
async def test_a_brought_secret_gives_the_public_key_once_it_is_there(world: World) -> None:
    pool = world.make_pool(replicas=2, credentialsSecretName="mine")
    await world.until(lambda: "InvalidCredentials" in world.reasons(), 30)
    message = world.status()["problems"][0]["message"]
    assert "there is no Secret mine, which spec.credentialsSecretName names" in message
    assert world.pods() == []
    assert "publicKey" not in world.status()
    bring(world, "mine", key="ab" * 32)
    await world.ready(2)
    signer = pool_signer("ab" * 32, pool["metadata"]["uid"])
    assert world.status()["publicKey"] == signer.public_key.hex()
    world.store.remove("secrets", NAMESPACE, "mine")
    await world.until(lambda: "publicKey" not in world.status(), 120)


@played
async def test_a_secret_that_names_the_only_master_gives_no_public_key(world: World) -> None:
    bring(world, "mine", key="ab" * 32, master="cd" * 32)
    world.make_pool(replicas=1, credentialsSecretName="mine")
    await world.ready(1)
    assert "publicKey" not in world.status()
    world.make_pool("another", replicas=1)
    await world.ready(1, "another")
    assert "publicKey" in world.status("another")
    patch = {"data": {"master": base64.b64encode(b"cd" * 32).decode()}}
    world.store.merge("secrets", NAMESPACE, "another-fiber-key", patch)
    await world.until(lambda: "publicKey" not in world.status("another"), 120)


@played
async def test_a_brought_secret_without_a_valid_key_is_a_problem(world: World) -> None:
    bring(world, "mine", key="secret")
    world.make_pool(replicas=1, credentialsSecretName="mine")
    await world.until(lambda: "InvalidCredentials" in world.reasons(), 30)
    message = world.status()["problems"][0]["message"]
    assert "the Secret mine has no valid key" in message
    assert "openssl rand -hex 32" in message
    assert "secret" not in message


def test_a_secret_that_names_the_pool_as_its_owner_is_taken() -> None:
    """The operator may have made it and ended before it wrote the status."""

    async def main() -> None:
        async with a_world() as world:
            world.make_pool("another")
            await world.ready(0, "another")
            another = world.store.get("secrets", NAMESPACE, "another-fiber-key")
            await world.stop()
            pool = world.make_pool(replicas=1)
            owner = {"kind": "FiberPool", "uid": pool["metadata"]["uid"], "controller": True}
            metadata = {"name": "es-fiber-key", "ownerReferences": [owner]}
            planted = {**another, "metadata": metadata}
            world.store.create("secrets", NAMESPACE, planted)
            world.start()
            await world.ready(1)
            assert world.store.get("secrets", NAMESPACE, "es-fiber-key")["data"] == planted["data"]

    virtual_time.run(main())


@played
async def test_objects_with_likely_names_of_users_do_not_collide_with_a_pools(world: World) -> None:
    """<pool>-tls is what cert-manager is told to write to, <pool>-master is a likely Service."""
    for plural, name in (("secrets", "es-tls"), ("services", "es-master"), ("leases", "es")):
        world.store.create(plural, NAMESPACE, {"metadata": {"name": name}})
    world.make_pool(replicas=1)
    await world.ready(1)
    assert world.reasons() == []
    assert world.status()["credentialsSecret"] == "es-fiber-key"
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
    await world.until(lambda: "LeaseNotFound" in world.reasons(), within=10)
    assert 90 <= await world.until(lambda: not world.store.list("fiberpools"), within=120) <= 105
    for plural in ("secrets", "services", "endpointslices", "pods"):
        assert world.store.list(plural, NAMESPACE) == []


def alive(world: World) -> str:
    (found,) = (c for c in world.status()["conditions"] if c["type"] == "MasterAlive")
    return str(found["status"])


def budgets(world: World) -> list[int]:
    return [b["spec"]["minAvailable"] for b in world.store.list("poddisruptionbudgets", NAMESPACE)]


@played
async def test_a_disruption_budget_follows_its_field(world: World) -> None:
    world.make_pool(minReplicas=3, minAvailable=1)
    await world.ready(3)
    (budget,) = world.store.list("poddisruptionbudgets", NAMESPACE)
    assert budget["metadata"]["name"] == "es-fiber"
    (pod, *_) = world.pods()
    assert budget["spec"]["selector"]["matchLabels"].items() <= pod["metadata"]["labels"].items()
    world.edit(minAvailable=2)
    await world.until(lambda: budgets(world) == [2], 5)
    await world.stop()
    world.start()
    world.edit(minAvailable=None)
    await world.until(lambda: budgets(world) == [], 60)
    world.edit(minAvailable=2)
    await world.until(lambda: budgets(world) == [2], 5)
    world.store.delete("fiberpools", NAMESPACE, "es", {})
    assert budgets(world) == []


@played
async def test_a_budget_that_is_not_the_pools_is_left_alone(world: World) -> None:
    foreign = {"metadata": {"name": "es-fiber"}, "spec": {"minAvailable": 9}}
    world.store.create("poddisruptionbudgets", NAMESPACE, foreign)
    world.make_pool(minReplicas=2)
    await world.ready(2)
    world.edit(minAvailable=1)
    await world.until(lambda: "NameTaken" in world.reasons(), 30)
    world.edit(minAvailable=None)
    await world.until(lambda: world.reasons() == [], 60)
    assert budgets(world) == [9]


@played
async def test_without_rights_on_budgets_pools_without_one_go_on(world: World) -> None:
    world.make_pool(minReplicas=1)
    await world.ready(1)
    refuse = Fault("", "poddisruptionbudgets", status=403, reason="Forbidden", times=10**6)
    world.api.faults.append(refuse)
    await world.stop()
    world.start()
    world.edit(minReplicas=2)
    await world.ready(2)
    assert world.reasons() == []
