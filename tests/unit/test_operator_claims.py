"""Of several releases one serves a namespace, whatever else each of them watches."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Callable

import pytest

from fakes import virtual_time
from fakes.kubernetes_api import Fault
from fakes.store import Body
from fakes.world import NAMESPACE, Test, World, a_world
from fiber_operator.claims import LINGER, NAME, SECONDS
from fiber_operator.program import Program
from unit.operator_objects import MASTER

OURS, OTHER = "fiber-system/fiber-operator", "other-system/other"
EVERYWHERE: tuple[str, ...] = ()


def played(*namespaces: str) -> Callable[[Test], Callable[[], None]]:
    """With a first operator, which serves these namespaces, or all."""

    def decorate(test: Test) -> Callable[[], None]:
        async def main() -> None:
            async with a_world(namespaces=namespaces) as world:
                await test(world)

        return lambda: virtual_time.run(main())

    return decorate


@contextlib.asynccontextmanager
async def another(world: World, namespaces: tuple[str, ...]) -> AsyncIterator[Program]:
    """An operator of another release."""
    program = world.another(
        host="127.0.0.1",
        port=0,
        identity="other-1",
        namespace="other-system",
        lease="other",
        namespaces=namespaces,
    )
    stop = asyncio.Event()
    task = asyncio.ensure_future(program.run(stop))
    await world.until(lambda: acts(program))
    try:
        yield program
    finally:
        stop.set()
        await task


def acts(program: Program) -> bool:
    return hasattr(program, "elector") and program.elector.is_leader


def lease(world: World, namespace: str = NAMESPACE) -> Body:
    spec: Body = world.store.get("leases", namespace, NAME)["spec"]
    return spec


def created(world: World) -> int:
    return world.api.count("create", "pods")


@pytest.mark.parametrize("first", [EVERYWHERE, (NAMESPACE,), (NAMESPACE, "more")])
@pytest.mark.parametrize("second", [EVERYWHERE, (NAMESPACE,), ("less", NAMESPACE)])
def test_two_releases_never_act_on_one_pool(
    first: tuple[str, ...], second: tuple[str, ...], caplog: pytest.LogCaptureFixture
) -> None:
    @played(*first)
    async def test(world: World) -> None:
        await world.until(lambda: acts(world.program))
        await world.settled(1)
        world.slow("create", "pods", 0.2)
        world.make_pool(replicas=20, master=MASTER)
        await world.settled(1)
        async with another(world, second) as other:
            await world.settled(300)
            assert len(world.pods()) == 20
            assert created(world) == 21, "a dry run is one of them"
            assert world.status()["phase"] == "Ready"
            assert lease(world)["holderIdentity"] == OURS
            assert world.program.health.ready() == []
            (complaint, *_) = other.health.ready()
            assert f"namespace {NAMESPACE} is served by another operator" in complaint
            assert OURS in complaint
            assert complaint in caplog.messages

    test()


def test_they_are_told_apart_when_they_begin_at_once() -> None:
    @played()
    async def test(world: World) -> None:
        world.slow("create", "pods", 0.2)
        world.make_pool(replicas=20, master=MASTER)
        async with another(world, EVERYWHERE) as other:
            await world.settled(120)
            assert len(world.pods()) == 20
            claims = (world.program.claims, other.claims)
            assert sorted(claim.holds(NAMESPACE) for claim in claims) == [False, True]

    test()


@played()
async def test_the_one_that_serves_all_leaves_alone_what_another_serves(world: World) -> None:
    async with another(world, (NAMESPACE,)) as other:
        await world.until(lambda: other.claims.holds(NAMESPACE))
        world.make_pool(replicas=2)
        world.make_pool(replicas=3, namespace="elsewhere")
        await world.settled(60)
        assert lease(world)["holderIdentity"] == OTHER
        assert lease(world, "elsewhere")["holderIdentity"] == OURS
        assert (len(world.pods()), len(world.pods("elsewhere"))) == (2, 3)
        assert other.health.ready() == []
        assert world.program.health.ready() == [], "it serves what is left"


@played()
async def test_a_restart_goes_on_at_once_and_another_waits_for_it(world: World) -> None:
    world.make_pool(replicas=2)
    await world.ready(2)
    async with another(world, EVERYWHERE) as other:
        await world.settled(100)
        for end in (world.stop, world.kill):
            await end()
            await world.settled(LINGER / 2)
            world.start()
            await world.until(lambda: acts(world.program), within=20)
            assert await world.until(lambda: world.program.claims.holds(NAMESPACE)) < 1
        world.edit(replicas=3)
        await world.ready(3)
        assert not other.claims.holds(NAMESPACE)


@pytest.mark.parametrize(
    ("end", "least", "most"),
    [("stop", LINGER, LINGER + 60), ("kill", SECONDS * 2 / 3, SECONDS + 60)],
)
def test_one_that_is_gone_is_followed_by_another(end: str, least: float, most: float) -> None:
    @played()
    async def test(world: World) -> None:
        world.make_pool(replicas=2)
        await world.ready(2)
        async with another(world, (NAMESPACE,)) as other:
            await world.settled(100)
            await getattr(world, end)()
            ended = asyncio.get_running_loop().time()
            world.edit(replicas=5)
            while not other.claims.holds(NAMESPACE):
                assert len(world.pods()) == 2
                await world.settled(1)
            waited = asyncio.get_running_loop().time() - ended
            assert least <= waited <= most + 5
            await world.until_settled(5)
            assert other.health.ready() == []

    test()


@played()
async def test_many_namespaces_cost_little(world: World) -> None:
    for number in range(12):
        world.make_pool(namespace=f"team-{number}", replicas=0)
    await world.until(lambda: len(world.store.list("leases")) == 13)
    await world.settled(5)
    before = sum(call.name == NAME for call in world.api.calls)
    await world.settled(900)
    asked = sum(call.name == NAME for call in world.api.calls) - before
    assert asked / 12 / 900 < 1 / 250, "requests a second and namespace"


@played()
async def test_a_namespace_without_pools_is_given_up(world: World) -> None:
    world.make_pool(replicas=1)
    await world.ready(1)
    world.store.delete("fiberpools", NAMESPACE, "es")
    await world.until(lambda: lease(world)["leaseDurationSeconds"] == LINGER, within=SECONDS)
    renewed = lease(world)["renewTime"]
    await world.settled(2 * SECONDS)
    assert lease(world)["renewTime"] == renewed
    world.make_pool(replicas=1)
    await world.ready(1)
    assert lease(world)["leaseDurationSeconds"] == SECONDS


@played(NAMESPACE)
async def test_one_that_is_named_is_claimed_before_it_has_a_pool(world: World) -> None:
    await world.until(lambda: bool(world.store.list("leases", NAMESPACE)))
    await world.settled(2 * SECONDS)
    assert world.program.claims.holds(NAMESPACE)


@pytest.mark.parametrize("verb", ["create", "get"])
def test_without_the_right_to_claim_nothing_is_done_and_that_is_told(
    verb: str, caplog: pytest.LogCaptureFixture
) -> None:
    @played()
    async def test(world: World) -> None:
        await world.until(lambda: acts(world.program))
        fault = Fault(verb, "leases", status=403, reason="Forbidden", times=10**6)
        world.api.faults.append(fault)
        world.make_pool(replicas=2)
        await world.settled(300)
        assert world.pods() == []
        (complaint,) = world.program.health.ready()
        assert complaint.startswith(f"the namespace {NAMESPACE} is not served: {verb} leases")
        assert complaint in caplog.messages
        fault.times = 0
        await world.ready(2, within=120)
        assert world.program.health.ready() == []

    test()


@played()
async def test_an_outage_at_first_costs_seconds(world: World) -> None:
    await world.until(lambda: acts(world.program))
    world.api.faults.append(Fault("create", "leases", status=503, times=3))
    world.make_pool(replicas=2)
    assert await world.ready(2) < 15


@played()
async def test_a_lease_that_another_took_is_lost(world: World) -> None:
    """By force: somebody writes it."""
    world.make_pool(replicas=2)
    await world.ready(2)
    stolen = lease(world) | {"holderIdentity": OTHER, "leaseDurationSeconds": 60}
    world.store.merge("leases", NAMESPACE, NAME, {"spec": stolen})
    await world.until(lambda: not world.program.claims.holds(NAMESPACE), within=SECONDS)
    world.edit(replicas=5)
    await world.settled(30)
    assert len(world.pods()) == 2
    await world.ready(5)


@played()
async def test_a_pool_that_went_meanwhile_is_forgotten(world: World) -> None:
    async with another(world, (NAMESPACE,)) as other:
        await world.until(lambda: other.claims.holds(NAMESPACE))
        world.make_pool(replicas=1)
        await world.settled(60)
        assert list(world.program.queue.known()) != []
        world.store.delete("fiberpools", NAMESPACE, "es")
        await world.settled(SECONDS)
        assert list(world.program.queue.known()) == []
        assert world.program.claims.wrong() == []


@played()
async def test_a_pool_that_went_while_its_namespace_was_claimed_is_forgotten(world: World) -> None:
    """As with a namespace that is being deleted: no Lease can be made in it any more."""
    await world.until(lambda: acts(world.program))
    refusal = Fault("create", "leases", status=403, reason="Forbidden", times=10**6, late=5)
    world.api.faults.append(refusal)
    world.make_pool()
    await world.until(lambda: list(world.program.queue.known()) != [])
    world.store.delete("fiberpools", NAMESPACE, "es")
    await world.settled(10)
    assert list(world.program.queue.known()) == []
    assert world.program.health.ready() == []


@played()
async def test_many_complaints_are_short(world: World) -> None:
    logging.getLogger("fiber_operator.claims").setLevel(logging.ERROR)
    await world.until(lambda: acts(world.program))
    world.api.faults.append(Fault("create", "leases", status=403, times=10**6))
    for number in range(9):
        world.make_pool(namespace=f"team-{number}")
    await world.settled(60)
    assert len(world.program.health.ready()) == 4
    assert world.program.health.ready()[-1] == "so are 6 more namespaces"
