"""The Lease by which programs know that an operator serves their namespace."""

from __future__ import annotations

import asyncio

import pytest

from fakes import virtual_time
from fakes.kubernetes_api import Fault
from fakes.store import Body
from fakes.world import World, a_world, played
from fiber_api import names
from fiber_api.times import parse_time


def lease(world: World, namespace: str = names.SERVING_NAMESPACE) -> Body | None:
    found = world.store.list("leases", namespace)
    return next((one for one in found if one["metadata"]["name"] == names.SERVING_LEASE), None)


def holder(world: World) -> str | None:
    """Return the identity in it."""
    spec = (lease(world) or {"spec": {}})["spec"]
    identity: str | None = spec.get("holderIdentity")
    return identity


def is_fresh(world: World, namespace: str = names.SERVING_NAMESPACE) -> bool:
    """Return whether a program would take the operator for a living one."""
    spec = (lease(world, namespace) or {"spec": {}})["spec"]
    if not spec:
        return False
    fresh_until: float = parse_time(spec["renewTime"]) + spec["leaseDurationSeconds"]
    return world.store.unix_now() < fresh_until


@played
async def test_an_operator_of_all_namespaces_shows_it_in_one(world: World) -> None:
    await world.until(lambda: is_fresh(world), within=10)
    assert holder(world) == "operator-1"
    await world.settled(3600)
    assert is_fresh(world)
    renewals = [call for call in world.api.calls if call.namespace == names.SERVING_NAMESPACE]
    assert len(renewals) < 70  # one a minute


def test_an_operator_of_some_namespaces_shows_it_in_each() -> None:
    async def test() -> None:
        async with a_world(namespaces=("team", "lab")) as world:
            await world.until(lambda: is_fresh(world, "team") and is_fresh(world, "lab"), within=10)
            assert lease(world) is None
            assert lease(world, "others") is None

    virtual_time.run(test())


@played
async def test_the_heartbeat_of_a_killed_operator_expires(world: World) -> None:
    await world.until(lambda: is_fresh(world))
    await world.kill()
    await world.settled(names.SERVING_SECONDS + 1)
    assert not is_fresh(world)


@pytest.mark.parametrize("graceful", [True, False])
def test_a_restart_is_not_seen(graceful: bool) -> None:
    async def test() -> None:
        async with a_world() as world:
            await world.until(lambda: is_fresh(world))
            await (world.stop() if graceful else world.kill())
            await world.settled(60)
            assert is_fresh(world)
            world.start(identity="operator-2")
            await world.until(lambda: holder(world) == "operator-2")

    virtual_time.run(test())


def test_an_operator_that_cannot_list_pools_writes_no_heartbeat() -> None:
    async def test() -> None:
        async with a_world(operator=False) as world:
            refused = Fault("list", "fiberpools", 403, "Forbidden", times=float("inf"))
            world.api.faults.append(refused)
            world.start()
            await world.settled(120)
            assert lease(world) is None
            refused.times = 0
            await world.until(lambda: is_fresh(world), within=30)

    virtual_time.run(test())


@played
async def test_an_operator_that_is_not_the_leader_writes_no_heartbeat(world: World) -> None:
    await world.until(lambda: is_fresh(world))
    second = world.another(
        host="127.0.0.1", port=0, identity="operator-2", namespace="fiber-system"
    )
    stop = asyncio.Event()
    waiting = asyncio.ensure_future(second.run(stop))
    await world.settled(600)
    assert holder(world) == "operator-1"
    stop.set()
    await waiting


def test_a_missing_right_to_the_heartbeat_is_logged_once_and_harms_no_pool(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def test() -> None:
        async with a_world(operator=False) as world:
            refused = Fault(
                "patch", "leases", 403, "Forbidden", times=float("inf"), name=names.SERVING_LEASE
            )
            world.api.faults.append(refused)
            world.start()
            world.make_pool(minReplicas=2)
            await world.ready(2)
            await world.settled(300)
            assert world.program.health.ready() == []
            refused.times = 0
            await world.until(lambda: is_fresh(world), within=30)

    virtual_time.run(test())
    said = [line for line in caplog.messages if "do not find this operator" in line]
    assert len(said) == 1
