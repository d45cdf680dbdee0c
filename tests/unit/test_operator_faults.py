"""The API server fails in every way; pools come out as they should, and no worker is lost by it."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from fakes import virtual_time
from fakes.kubernetes_api import Call, Fault
from fakes.world import NAMESPACE, OWN_LEASE, World, a_world, played
from fiber_operator import controller
from unit.operator_objects import MASTER

CALLS = [
    ("get", "fiberpools"),
    ("list", "fiberpools"),
    ("patch", "fiberpools"),
    ("get", "services"),
    ("create", "services"),
    ("create", "secrets"),
    ("create", "endpointslices"),
    ("list", "pods"),
    ("create", "pods"),
    ("create", "events"),
    ("create", "leases"),
]
WAYS: dict[str, dict[str, Any]] = {
    "reset": {},
    "reset-after": {"carried_out": True},
    "500": {"status": 500},
    "500-after": {"status": 500, "carried_out": True},
    "504": {"status": 504},
    "429": {"status": 429, "retry_after": 3},
    "401": {"status": 401, "reason": "Unauthorized"},
    "409": {"status": 409, "reason": "Conflict"},
    "nonsense": {"text": "<html>"},
    "nonsense-after": {"text": "{}", "carried_out": True},
    "slow": {"late": 8},
    "too-slow": {"late": 40},
}


@pytest.mark.parametrize("way", WAYS)
def test_a_pool_is_created_in_spite_of_any_fault(way: str) -> None:
    """Each kind of call fails twice, then works."""

    async def main() -> None:
        async with a_world(operator=False) as world:
            world.api.faults = [Fault(*call, times=2, **WAYS[way]) for call in CALLS]
            world.start()
            world.make_pool(replicas=5)
            await world.ready(5, within=3000)
            await world.settled(100)
            assert all(fault.times < 2 for fault in world.api.faults)
            assert len(world.pods()) == len(world.created()) == 5
            assert [len(world.store.list(p)) for p in ("services", "secrets")] == [1, 1]

    virtual_time.run(main())


@pytest.mark.parametrize("way", ["reset-after", "500-after", "nonsense-after", "too-slow"])
def test_no_pod_is_made_twice_because_an_answer_was_lost(way: str) -> None:
    @played
    async def test(world: World) -> None:
        world.api.faults.append(Fault("create", "pods", times=6, skip=1, **WAYS[way]))
        world.make_pool(replicas=10)
        await world.ready(10)
        await world.settled(100)
        assert len(world.created()) == 10
        assert world.live_at_most == 10

    test()


@played
async def test_a_minute_without_api_server_costs_no_worker(world: World) -> None:
    world.make_pool(replicas=5, master={**MASTER, "leaseName": "es", "leaseDurationSeconds": 30})
    world.store.create("leases", NAMESPACE, {"metadata": {"name": "es"}})
    renewing = asyncio.ensure_future(renew(world))
    await world.ready(5)
    await world.settled(45)
    world.api.down = True
    await world.settled(60)
    assert world.program.health.alive() == []
    world.api.down = False
    await world.settled(120)
    renewing.cancel()
    assert world.deleted() == []
    assert len(world.created()) == 5
    assert world.status()["phase"] == "Ready"
    world.edit(replicas=7)
    await world.ready(7)


async def renew(world: World) -> None:
    """The master of the pool, who can do nothing while the API server is down."""
    for number in range(10**6):
        if not world.api.down:
            spec = {"holderIdentity": "es-1", "renewTime": str(number)}
            world.store.merge("leases", NAMESPACE, "es", {"spec": spec})
        await asyncio.sleep(10)


@played
async def test_long_trouble_is_got_over_within_a_minute(world: World) -> None:
    world.make_pool(replicas=5)
    await world.ready(5)
    trouble = [
        Fault("list", "pods", status=500, times=10**6),
        Fault("list", "fiberpools", times=10**6),
    ]
    world.api.faults += trouble
    world.program.informer.refresh()
    await world.settled(1200)
    assert world.api.count("list", "pods") < 100
    for fault in trouble:
        fault.times = 0
    world.edit(replicas=7)
    assert await world.ready(7) < 60


@played
async def test_a_server_that_is_busy_is_left_alone(world: World) -> None:
    world.make_pool(replicas=5)
    await world.ready(5)
    busy = Fault("get", "fiberpools", status=429, retry_after=30, times=10**6)
    world.api.faults.append(busy)
    world.api.calls.clear()
    for replicas in range(6, 60):
        world.edit(replicas=replicas)
        await asyncio.sleep(1)
    assert world.api.count("get", "fiberpools") <= 3
    busy.times = 0
    await world.ready(59)


@pytest.mark.parametrize(
    "text",
    [
        "{}",
        '{"kind": "PodList", "metadata": {}, "items": null}',
        '{"kind": "Status", "status": "Success", "items": []}',
        '{"apiVersion": "v1", "items": [], "metadata": {}}',
    ],
)
def test_an_invalid_list_of_pods_creates_no_pods(text: str) -> None:
    @played
    async def test(world: World) -> None:
        world.make_pool(replicas=5)
        await world.ready(5)
        fault = Fault("list", "pods", text=text, times=10**6)
        world.api.faults.append(fault)
        world.program.informer.refresh()
        world.edit(replicas=6)
        await world.settled(120)
        assert len(world.created()) == 5
        fault.times = 0
        await world.ready(6)
        assert len(world.created()) == 6
        assert world.deleted() == []

    test()


@pytest.mark.parametrize(
    "text", ["{}", '{"metadata": {}}', '{"metadata": {"name": "other", "uid": "1"}}']
)
def test_an_answer_that_is_not_the_pool_changes_no_pod(text: str) -> None:
    @played
    async def test(world: World) -> None:
        world.make_pool(replicas=5)
        await world.ready(5)
        world.api.faults.append(Fault("get", "fiberpools", text=text, times=5))
        world.kubelet.evict(NAMESPACE, world.names()[0])
        await world.until(lambda: len(world.created()) == 6)
        await world.ready(5)
        assert len(world.created()) == 6

    test()


@played
async def test_failed_pods_are_kept_until_the_status_that_counts_them_is_written(
    world: World,
) -> None:
    """A failed pod is deleted only once its failure is safely counted."""
    world.make_pool(replicas=8, failurePolicy={"backoffBaseSeconds": 1, "backoffLimit": 100})
    await world.ready(8)
    unwritable = Fault("patch", "fiberpools", status=500, times=10**6)
    world.api.faults.append(unwritable)
    for name in world.names():
        world.kubelet.exit(NAMESPACE, name, 3)
    await world.settled(120)
    assert world.deleted() == []
    unwritable.times = 0
    await world.until(lambda: world.status()["failures"]["total"] == 8)
    await world.ready(8)


@played
async def test_events_that_cannot_be_posted_delay_no_action(world: World) -> None:
    world.api.faults.append(Fault("create", "events", status=403, times=10**6))
    world.make_pool(replicas=5)
    assert await world.ready(5) < 5


@played
async def test_slow_events_delay_no_action(world: World) -> None:
    world.make_pool(replicas=3)
    await world.ready(3)
    world.slow("create", "events", 4.5)
    for number, name in enumerate(world.names()[:2]):
        world.kubelet.exit(NAMESPACE, name, 3)
        told = await world.until(
            lambda n=number + 1: world.status()["failures"]["total"] == n  # type: ignore[misc]
        )
        assert told <= 1.0


@played
async def test_a_long_scale_up_is_one_event(world: World) -> None:
    world.slow("create", "pods", 0.3)
    world.make_pool(replicas=200, scaleUp={"maxInFlight": 10})
    await world.ready(200)
    reasons = [event["reason"] for event in world.store.list("events")]
    assert reasons.count("ScaledUp") == 1


@played
async def test_a_namespace_that_ends_is_no_storm(world: World) -> None:
    message = "namespace team is being terminated"
    world.api.faults.append(Fault("create", "pods", status=403, message=message, times=10**6))
    world.make_pool(replicas=50)
    await world.settled(120)
    assert world.api.count("create", "pods") < 30


@played
async def test_a_lost_lease_stops_a_scale_up_at_once(world: World) -> None:
    world.slow("create", "pods", 0.5)
    world.make_pool(replicas=300)
    await world.until(lambda: len(world.pods()) > 10)
    spec = {"holderIdentity": "another", "leaseDurationSeconds": 15, "renewTime": "now"}
    world.store.merge("leases", "fiber-system", OWN_LEASE, {"spec": spec})
    await world.until(lambda: not world.program.elector.is_leader)
    at_loss = len(world.created())
    assert world.program.health.ready() != []
    await world.settled(12)
    under_way = world.program.queue.statistics().running
    assert under_way == 0
    assert len(world.created()) - at_loss <= 32, "what was sent is carried out, and no more"
    await world.ready(300)
    assert len(world.created()) == 300


def test_two_operators_do_the_work_of_one() -> None:
    async def main() -> None:
        async with a_world() as world:
            stop = asyncio.Event()
            second = world.another(
                host="127.0.0.1", port=0, identity="operator-2", namespace="fiber-system"
            )
            task = asyncio.ensure_future(second.run(stop))
            world.slow("create", "pods", 0.2)
            world.make_pool(replicas=60)
            await world.until(lambda: len(world.pods()) > 20)
            await world.kill()
            await world.until_settled(60)
            assert len(world.created()) == 60
            assert second.elector.is_leader
            stop.set()
            await task

    virtual_time.run(main())


@played
async def test_sigterm_ends_a_scale_up_between_two_calls(world: World) -> None:
    world.slow("create", "pods", 0.5)
    world.make_pool(replicas=300)
    await world.until(lambda: len(world.pods()) > 10)
    await asyncio.sleep(0.25)  # the calls of a wave are under way, none is about to be
    clock = asyncio.get_running_loop().time
    began, calls = clock(), len(world.api.calls)
    await world.stop()
    assert clock() - began < 2
    made = len(world.created())
    await asyncio.sleep(10)
    assert len(world.created()) == made, "nothing was cut off in the middle"
    late = [call for call in world.api.calls[calls:] if call.plural == "pods"]
    assert late == []
    lease = world.store.get("leases", "fiber-system", OWN_LEASE)
    assert lease["spec"]["holderIdentity"] == ""
    world.api.faults.clear()
    world.start(identity="operator-2")
    await world.ready(300)
    assert len(world.created()) == 300


@played
async def test_a_pool_recreated_halfway_gets_no_object_of_the_old_one(world: World) -> None:
    """Between the operator's read and its writes the pool is replaced by one of the same name."""

    def replace(call: Call) -> None:
        if (call.verb, call.plural) == ("get", "fiberpools"):
            world.api.after = lambda call: None
            world.store.delete("fiberpools", NAMESPACE, "es")
            world.make_pool(replicas=2)

    world.make_pool(replicas=5)
    await world.ready(5)
    world.api.after = replace
    world.edit(replicas=7)
    await world.until_settled(2)
    uid = world.store.get("fiberpools", NAMESPACE, "es")["metadata"]["uid"]
    assert {pod["metadata"]["labels"]["fiber.dev/pool-uid"] for pod in world.pods()} == {uid}
    assert world.status()["observedGeneration"] == 1


@played
async def test_a_master_that_comes_back_in_the_last_moment_keeps_its_pool(world: World) -> None:
    lost = {"leaseName": "es", "leaseDurationSeconds": 6, "lostGraceSeconds": 5}
    world.store.create("leases", NAMESPACE, {"metadata": {"name": "es"}})
    world.make_pool(replicas=3, master={**MASTER, **lost}, onLost="Delete")
    await world.ready(3)

    world.slow("delete", "fiberpools", 1.0)
    await world.until(lambda: world.api.count("delete", "fiberpools") == 1)
    world.edit(master={**MASTER, **lost, "epoch": 2})
    await world.settled(4)
    assert world.store.list("fiberpools") != []
    assert len(world.pods()) == 3
    assert "MasterLost" not in world.reasons()


def a_master_attaches_after(verb: str, plural: str, world: World, **spec: Any) -> None:
    """Act in the middle of the operator's reconcile: once the next such call is answered."""

    def attach(call: Call) -> None:
        if (call.verb, call.plural) == (verb, plural):
            world.api.after = lambda call: None
            world.edit(master=MASTER, **spec)

    world.api.after = attach


NEW_TEMPLATE = {"spec": {"containers": [{"name": "worker", "image": "registry/worker:2"}]}}


@pytest.mark.parametrize(
    ("edit", "call", "attachment"),
    [
        ({"template": NEW_TEMPLATE}, ("get", "fiberpools"), {}),
        ({"replicas": 10}, ("get", "fiberpools"), {"replicas": 40}),
        ({"replicas": 10}, ("patch", "fiberpools"), {"replicas": 40}),
        ({"replicas": 10}, ("get", "fiberpools"), {}),
    ],
    ids=["outdated", "fewer-wanted", "after-the-status", "fewer-wanted-still"],
)
def test_no_worker_of_a_master_that_attaches_during_a_look_is_deleted(
    edit: dict[str, Any], call: tuple[str, str], attachment: dict[str, Any]
) -> None:
    @played
    async def test(world: World) -> None:
        world.make_pool(replicas=40)
        await world.ready(40)
        await world.settled()
        a_master_attaches_after(*call, world, **attachment)
        world.edit(**edit)
        await world.settled(60)
        assert world.deleted() == []
        assert len(world.pods()) == 40
        assert world.status()["master"] == "10.0.3.7:41337"

    test()


@played
async def test_a_master_that_attaches_during_a_long_deletion_keeps_the_remaining_workers(
    world: World,
) -> None:
    """Each batch is begun only while the pool is the one that the plan was made for."""
    world.make_pool(replicas=200)
    await world.ready(200)
    await world.settled()
    world.slow("delete", "pods", 0.2)
    a_master_attaches_after("delete", "pods", world, replicas=200)
    world.edit(replicas=10)
    await world.settled(60)
    assert 0 < len(world.deleted()) <= controller.DELETIONS


@played
async def test_released_pods_go_although_the_pool_changes_all_the_time(world: World) -> None:
    world.make_pool(replicas=5, master=MASTER, update={"strategy": "Recreate"})
    await world.ready(5)
    released = world.names()[2]
    world.slow("get", "fiberpools", 0.1)

    def change(call: Call) -> None:
        if (call.verb, call.plural) == ("get", "fiberpools"):
            looks = world.api.count("get", "fiberpools")
            world.edit(failurePolicy={"backoffBaseSeconds": 1 + looks})

    world.api.after = change
    world.edit(template=NEW_TEMPLATE, scaleDown={"release": [released]})
    await world.settled(5)
    assert world.deleted() == [released]
    world.api.after = lambda call: None
    await world.until(lambda: len(world.deleted()) == 5)


@played
async def test_a_pool_that_is_gone_during_a_look_is_no_error(world: World) -> None:
    world.make_pool(replicas=5)
    await world.ready(5)
    world.store.collects_garbage = False

    def remove(call: Call) -> None:
        if (call.verb, call.plural) == ("patch", "fiberpools"):
            world.api.after = lambda call: None
            world.store.delete("fiberpools", NAMESPACE, "es")

    world.api.after = remove
    world.edit(replicas=2)
    await world.settled(30)
    assert world.deleted() == []
    assert world.program.queue.known() == []
