"""The operator is ended after each call that it makes, and started again.

The call is carried out and its answer is lost, which is the worst moment.  At any of these
points the next operator brings the pool where it should be: no pod twice, none forgotten, each
failure counted once, and what the operator itself deleted not taken for somebody else's doing.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import pytest

from fakes import virtual_time
from fakes.kubernetes_api import Call
from fakes.store import Store
from fakes.world import NAMESPACE, World, a_world
from unit.operator_objects import MASTER

pytestmark = pytest.mark.slow

ENDING_TAKES = 3.0
"""Seconds that a deleted pod is still there."""

Step = Callable[[World], Awaitable[None]]


async def make(world: World) -> None:
    world.make_pool(replicas=5, master=MASTER)


async def is_made(world: World) -> None:
    await world.ready(5)
    assert sorted(world.created()) == sorted(world.names())


async def release(world: World) -> None:
    world.edit(replicas=3, scaleDown={"release": world.names()[:2]})


async def is_released(world: World) -> None:
    await world.ready(3)
    assert len(world.created()) == 5


async def fail(world: World) -> None:
    world.kubelet.exit(NAMESPACE, world.names()[0], 3)


async def is_counted(world: World) -> None:
    def replaced() -> bool:
        return world.status().get("readyReplicas") == 5

    await world.until(lambda: world.status().get("failures", {}).get("total", 0) > 0)
    await world.until(replaced)
    await world.settled()
    assert world.status()["failures"]["total"] == 1
    assert len(world.created()) == 6


async def disrupt(world: World) -> None:
    world.kubelet.evict(NAMESPACE, world.names()[0])


async def is_replaced(world: World) -> None:
    await world.until(lambda: len(world.created()) == 6)
    await world.ready(5)
    assert world.status()["failures"]["disrupted"] == 1
    assert world.status()["failures"]["total"] == 0
    assert len(world.created()) == 6


async def change_template(world: World) -> None:
    template = {"spec": {"containers": [{"name": "worker", "image": "registry/worker:2"}]}}
    world.edit(template=template, update={"strategy": "Recreate"})


async def is_changed(world: World) -> None:
    def all_new() -> bool:
        images = [pod["spec"]["containers"][0]["image"] for pod in world.pods()]
        return images == ["registry/worker:2"] * 5

    await world.until(all_new)
    await world.ready(5)
    assert len(world.created()) == 10


async def suspend(world: World) -> None:
    world.edit(suspend=True)


async def is_suspended(world: World) -> None:
    await world.ready(0)
    await world.until(lambda: world.names() == [])
    assert len(world.created()) == 5


async def attach(world: World) -> None:
    world.edit(master={**MASTER, "host": "10.0.3.8", "port": 41338, "epoch": 2})


async def is_attached(world: World) -> None:
    await world.until(lambda: world.status().get("masterEpoch") == 2)
    (slice_,) = world.store.list("endpointslices")
    assert slice_["endpoints"][0]["addresses"] == ["10.0.3.8"]
    assert slice_["ports"][0]["port"] == 41338


async def relay(world: World) -> None:
    world.edit(relay=True)


async def is_relayed(world: World) -> None:
    await world.until(lambda: "relay" in world.status())
    assert len(world.store.list("deployments", NAMESPACE)) == 1
    assert "selector" in world.store.get("services", NAMESPACE, "es-fiber")["spec"]
    (slice_,) = world.store.list("endpointslices")
    assert slice_["endpoints"] == []


async def abandon(world: World) -> None:
    world.store.create("leases", NAMESPACE, {"metadata": {"name": "es"}})
    lost = {"leaseName": "es", "leaseDurationSeconds": 6, "lostGraceSeconds": 5}
    world.edit(master={**MASTER, **lost}, onLost="Delete")


async def is_deleted(world: World) -> None:
    await world.until(lambda: world.store.list("fiberpools") == [])
    for plural in ("pods", "services", "secrets", "endpointslices"):
        assert world.store.list(plural, NAMESPACE) == []


def disruptions(world: World) -> tuple[int, int]:
    """Return how many were counted, and how many events report one."""
    counted = sum(p["status"]["failures"]["disrupted"] for p in world.store.list("fiberpools"))
    return counted, sum(e["reason"] == "Disrupted" for e in world.store.list("events"))


def belongings(world: World) -> list[int]:
    return [len(world.store.list(p)) for p in ("services", "secrets", "endpointslices")]


async def _five_workers() -> Store:
    async with a_world() as world:
        await make(world)
        await world.ready(5)
        await world.stop()
        return world.store


async def _crash_after(
    calls: int, story: tuple[Step, Step], past: Store | None, disrupted: int
) -> bool:
    """Play the story with an operator that ends at its ``calls``-th call; whether it did."""
    async with a_world(past=past) as world:
        world.let_pods_linger(ENDING_TAKES)
        crashed, left = False, calls

        def crash(call: Call) -> None:
            nonlocal crashed, left
            # The Lease is renewed all the time, and has separate tests.
            left -= call.namespace != "fiber-system"
            if left == 0 and not crashed:
                crashed = world.api.down = True
                world.crash()

        world.api.after = crash
        await story[0](world)
        await world.run_out_or(lambda: crashed, story[1])
        if not crashed:
            return False
        await world.kill()
        world.api.down = False
        world.start()
        await story[1](world)
        assert belongings(world) in ([1, 1, 1], [0, 0, 0])
        assert world.live_at_most <= 5
        await world.settled()
        # The operator may end before it has posted an event.
        counted, told = disruptions(world)
        assert counted == disrupted
        assert told <= disrupted
        return True


STORIES: dict[str, tuple[bool, tuple[Step, Step]]] = {
    "scale-up": (False, (make, is_made)),
    "release": (True, (release, is_released)),
    "failure": (True, (fail, is_counted)),
    "eviction": (True, (disrupt, is_replaced)),
    "template": (True, (change_template, is_changed)),
    "suspend": (True, (suspend, is_suspended)),
    "new-master": (True, (attach, is_attached)),
    "relay": (True, (relay, is_relayed)),
    "lost-master": (True, (abandon, is_deleted)),
}


@pytest.fixture(scope="module")
def five_workers() -> Store:
    return virtual_time.run(_five_workers())


@pytest.mark.parametrize("name", STORIES)
def test_a_crash_after_any_call_does_not_change_the_final_state(
    name: str, five_workers: Store
) -> None:
    has_past, story = STORIES[name]
    past = five_workers if has_past else None
    calls, disrupted = 1, int(name == "eviction")
    while virtual_time.run(_crash_after(calls, story, past, disrupted)):
        calls += 1
    assert calls > 5, "the operator made fewer calls than the story needs"
