"""Workers that were made with an address or certificates that are of no use any more."""

from __future__ import annotations

import pytest

from fakes.store import Body, Failure
from fakes.world import NAMESPACE, TEMPLATE, World, played
from unit.operator_objects import MASTER


def taken(plural: str, body: Body) -> None:
    if plural == "services" and body["spec"].get("clusterIP"):
        message = 'spec.clusterIPs: Invalid value: ["10.96.0.1"]: failed to allocate IP'
        raise Failure(422, "Invalid", f"{message} 10.96.0.1: provided IP is already allocated")


def dialled(world: World) -> set[str]:
    return {
        variable["value"]
        for pod in world.pods()
        for variable in pod["spec"]["containers"][0]["env"]
        if variable["name"] == "FIBER_AGENT_ADDRESS"
    }


@played
async def test_a_service_that_was_deleted_comes_back_with_its_address(world: World) -> None:
    world.make_pool(replicas=2, master=MASTER)
    await world.ready(2)
    endpoint = world.status()["endpoint"]
    world.store.delete("services", NAMESPACE, "es-fiber")
    await world.until(lambda: world.store.list("services") != [], within=125)
    await world.settled()
    assert world.status()["endpoint"] == endpoint
    assert f"tls+tcp://{world.store.list('services')[0]['spec']['clusterIP']}:7070" == endpoint
    assert (world.reasons(), len(world.created())) == ([], 2)


@played
async def test_workers_dial_both_families_of_the_service(world: World) -> None:
    world.store.dual_stack = True
    world.make_pool(replicas=1, master={**MASTER, "host": "fd00::7"})
    await world.ready(1)
    assert dialled(world) == {"10.96.0.1:7070,[fd00:96::1]:7070"}
    assert world.reasons() == []
    world.store.delete("services", NAMESPACE, "es-fiber")
    await world.until(lambda: world.store.list("services") != [], within=125)
    await world.settled()
    (service,) = world.store.list("services")
    assert service["spec"]["clusterIPs"] == ["10.96.0.1", "fd00:96::1"]
    assert (world.reasons(), len(world.created())) == ([], 1)


@played
async def test_a_service_of_one_family_that_is_deleted_gets_the_other_for_its_master(
    world: World,
) -> None:
    world.make_pool()
    await world.until(lambda: "endpoint" in world.status())
    world.store.dual_stack = True
    world.edit(master={**MASTER, "host": "fd00::7"})
    await world.until(lambda: world.reasons() == ["InvalidSpec"])
    world.store.delete("services", NAMESPACE, "es-fiber")
    await world.until(lambda: world.reasons() == [], within=125)
    assert "[fd00:96::2]:7070" in world.status()["endpoint"]


@pytest.mark.parametrize(
    ("endpoint", "address"),
    [
        ("tls+tcp://10.96.0.77:7070", "10.96.0.77"),
        ("tls+tcp://[fd00::77]:7070", "fd00::77"),
        ("tls+tcp://[fd00::77", "10.96.0.2"),
        ("tls+tcp://es-fiber:7070", "10.96.0.2"),
        ("nonsense", "10.96.0.2"),
        ("", "10.96.0.2"),
    ],
)
def test_a_lost_service_gets_the_address_of_the_status_if_it_is_valid(
    endpoint: str, address: str
) -> None:
    @played
    async def test(world: World) -> None:
        world.make_pool()
        await world.until(lambda: "endpoint" in world.status())
        await world.stop()
        world.store.delete("services", NAMESPACE, "es-fiber")
        status = {**world.status(), "endpoint": endpoint}
        world.store.set_status("fiberpools", NAMESPACE, "es", status)
        world.start()
        await world.until(lambda: world.store.list("services") != [])
        assert world.store.list("services")[0]["spec"]["clusterIP"] == address

    test()


async def lose_the_address(world: World) -> str:
    """Delete the Service, and let another have its address; the one that workers dial."""
    (before,) = dialled(world)
    world.store.admit = taken
    world.store.delete("services", NAMESPACE, "es-fiber")
    await world.until(lambda: world.store.list("services") != [], within=125)
    return before


@played
async def test_workers_without_a_master_that_dial_an_old_address_are_replaced(
    world: World,
) -> None:
    world.make_pool(replicas=8)
    await world.ready(8)
    before = await lose_the_address(world)
    await world.until(lambda: "AddressChanged" in world.reasons(), 5)
    assert before in world.status()["problems"][0]["message"]
    await world.until(lambda: before not in dialled(world))
    await world.ready(8)
    assert world.reasons() == []
    assert f"tls+tcp://{dialled(world).pop()}" == world.status()["endpoint"]


@played
async def test_workers_of_a_master_that_dial_an_old_address_stay_and_are_reported(
    world: World,
) -> None:
    world.make_pool(replicas=3, master=MASTER)
    await world.ready(3)
    before = await lose_the_address(world)
    await world.settled(60)
    assert dialled(world) == {before}
    (problem,) = world.status()["problems"]
    assert (problem["reason"], problem["count"]) == ("AddressChanged", 3)
    assert "kubectl -n team delete pods -l fiber.dev/pool=es" in problem["message"]
    assert (world.status()["phase"], world.status()["updatedReplicas"]) == ("Degraded", 0)
    for name in world.names():
        world.store.delete("pods", NAMESPACE, name)
    await world.ready(3)
    await world.until(lambda: world.reasons() == [])


@played
async def test_a_template_with_an_agent_address_is_not_reported_as_cut_off(world: World) -> None:
    env = [{"name": "FIBER_AGENT_ADDRESS", "value": "10.0.0.1:7"}]
    container = {**TEMPLATE["spec"]["containers"][0], "env": env}
    world.make_pool(replicas=2, template={"spec": {"containers": [container]}})
    await world.ready(2)
    await world.settled(60)
    assert (world.reasons(), len(world.created())) == ([], 2)


@played
async def test_workers_without_a_master_that_hold_old_credentials_are_replaced(
    world: World,
) -> None:
    world.make_pool(replicas=8)
    await world.ready(8)
    await world.settled()
    before = world.names()
    world.store.delete("secrets", NAMESPACE, "es-fiber-key")
    await world.until(lambda: "CredentialsChanged" in world.reasons(), 125)
    await world.until(lambda: not {*before} & {*world.names()})
    await world.ready(8)
    assert world.reasons() == []


@played
async def test_workers_of_a_master_that_hold_old_credentials_stay_and_are_reported(
    world: World,
) -> None:
    world.make_pool(replicas=3, master=MASTER)
    await world.ready(3)
    await world.settled()
    before = world.names()
    world.store.delete("secrets", NAMESPACE, "es-fiber-key")
    await world.until(lambda: "CredentialsChanged" in world.reasons(), 125)
    await world.settled(120)
    assert world.names() == before
    (problem,) = world.status()["problems"]
    assert "Restart the master" in problem["message"]
    assert world.status()["phase"] == "Degraded"
    for name in before:
        world.store.delete("pods", NAMESPACE, name)
    await world.ready(3)
    await world.until(lambda: world.reasons() == [])
