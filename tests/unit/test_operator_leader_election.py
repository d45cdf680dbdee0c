"""Leader election: one operator acts, through all faults of operators and API server."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any

import pytest

from fakes import virtual_time
from fakes.kubernetes_api import Fault, KubernetesApi
from fakes.store import Body, Store
from fakes.world import configuration
from fiber_api.rest import PODS, Transient
from fiber_operator import operator_leases
from fiber_operator.cluster import Cluster
from fiber_operator.operator_leases import LeaderElector, NotLeader

NAMESPACE, NAME, SECONDS = "fiber-system", "fiber-operator", 15


class Operators:
    """Electors of operators that share one Lease."""

    def __init__(self, api: KubernetesApi) -> None:
        self.api = api
        self.store = api.store
        self.told: list[tuple[str, bool]] = []
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._doors: list[Cluster] = []

    def start(
        self, identity: str, api: KubernetesApi | None = None, seconds: float = SECONDS
    ) -> LeaderElector:
        door = Cluster(configuration(api or self.api), connections=2)
        self._doors.append(door)
        elector = LeaderElector(
            door,
            namespace=NAMESPACE,
            name=NAME,
            identity=identity,
            seconds=seconds,
            on_change=lambda held: self.told.append((identity, held)),
            wall_clock=self.store.unix_now,
        )
        self._tasks[identity] = asyncio.ensure_future(elector.run())
        return elector

    async def kill(self, identity: str) -> None:
        task = self._tasks.pop(identity)
        task.cancel()
        await asyncio.wait([task])

    async def close(self) -> None:
        for identity in list(self._tasks):
            await self.kill(identity)
        for door in self._doors:
            await door.close()

    def lease(self) -> Body:
        spec: Body = self.store.get("leases", NAMESPACE, NAME)["spec"]
        return spec


@contextlib.asynccontextmanager
async def operators() -> AsyncIterator[Operators]:
    api = KubernetesApi(Store(asyncio.get_running_loop().time))
    async with api.serving():
        found = Operators(api)
        try:
            yield found
        finally:
            await found.close()


def played(test: Callable[[Operators], Coroutine[Any, Any, None]]) -> Callable[[], None]:
    async def main() -> None:
        async with operators() as found:
            await test(found)

    return lambda: virtual_time.run(main())


def now() -> float:
    return asyncio.get_running_loop().time()


async def until(condition: Callable[[], bool], within: float = 120) -> float:
    started = now()
    while not condition():
        assert now() - started < within, "it did not come to that"
        await asyncio.sleep(0.25)
    return now() - started


@played
async def test_the_first_one_acts_at_once_and_goes_on(found: Operators) -> None:
    elector = found.start("a")
    await until(lambda: elector.is_leader, 1)
    elector.require()
    assert found.lease()["holderIdentity"] == "a"
    for _ in range(100):
        await asyncio.sleep(1)
        assert elector.is_leader
    assert found.told == [("a", True)]
    assert found.lease()["leaseTransitions"] == 0


@played
async def test_no_operator_acts_before_the_election(found: Operators) -> None:
    found.api.down = True
    elector = found.start("a")
    await asyncio.sleep(60)
    assert not elector.is_leader
    with pytest.raises(NotLeader, match="does not hold the Lease fiber-operator"):
        elector.require()


@played
async def test_a_second_operator_waits_while_the_leader_renews(found: Operators) -> None:
    first = found.start("a")
    await until(lambda: first.is_leader)
    second = found.start("b")
    for _ in range(100):
        await asyncio.sleep(1)
        assert (first.is_leader, second.is_leader) == (True, False)
    assert second.why == "a holds the Lease"


@played
async def test_a_lease_that_is_given_up_is_taken_at_once(found: Operators) -> None:
    first = found.start("a")
    await until(lambda: first.is_leader)
    second = found.start("b")
    await asyncio.sleep(5)
    first.resign()
    assert not first.is_leader
    await found.kill("a")
    await first.release()
    assert await until(lambda: second.is_leader) < 3
    assert found.lease()["leaseTransitions"] == 1


@played
async def test_the_lease_of_one_that_died_is_taken_when_it_has_run_out(found: Operators) -> None:
    first = found.start("a")
    await until(lambda: first.is_leader)
    second = found.start("b")
    await asyncio.sleep(7)
    await found.kill("a")
    died = now()
    await until(lambda: second.is_leader)
    assert SECONDS - 5 <= now() - died <= SECONDS + 3
    assert not first.is_leader


@played
async def test_a_restarted_container_becomes_the_leader_at_once(found: Operators) -> None:
    first = found.start("pod-1")
    await until(lambda: first.is_leader)
    await found.kill("pod-1")
    again = found.start("pod-1")
    assert await until(lambda: again.is_leader) < 1


@played
async def test_an_isolated_operator_stops_before_another_begins(found: Operators) -> None:
    """The first one reaches no API server any more; the second one does."""
    way = KubernetesApi(found.store)
    async with way.serving():
        first = found.start("a", way)
        await until(lambda: first.is_leader)
        second = found.start("b")
        await asyncio.sleep(20)
        way.down = True
        while not second.is_leader:
            assert now() < 100
            await asyncio.sleep(0.25)
            assert not (first.is_leader and second.is_leader)
        way.down = False
        await asyncio.sleep(30)
        assert (first.is_leader, second.is_leader) == (False, True)
        assert found.told == [("a", True), ("a", False), ("b", True)]
        await found.kill("a")


@played
async def test_an_outage_of_the_api_server_stops_it_for_as_long(found: Operators) -> None:
    elector = found.start("a")
    await until(lambda: elector.is_leader)
    found.api.down = True
    assert SECONDS / 3 < await until(lambda: not elector.is_leader) <= SECONDS * 2 / 3 + 0.5
    await asyncio.sleep(60)
    found.api.down = False
    assert await until(lambda: elector.is_leader) < 5
    assert found.told == [("a", True), ("a", False), ("a", True)]


@played
async def test_a_short_outage_goes_unnoticed(found: Operators) -> None:
    elector = found.start("a")
    await until(lambda: elector.is_leader)
    found.api.faults.append(Fault("update", "leases", status=503, times=2))
    for _ in range(60):
        await asyncio.sleep(0.5)
        assert elector.is_leader
    assert found.told == [("a", True)]


@played
async def test_a_lease_that_another_took_is_lost_at_once(found: Operators) -> None:
    elector = found.start("a")
    await until(lambda: elector.is_leader)
    stolen = found.lease() | {"holderIdentity": "thief", "leaseTransitions": 7}
    found.store.merge("leases", NAMESPACE, NAME, {"spec": stolen})
    assert await until(lambda: not elector.is_leader) <= SECONDS / 3 + 0.5
    assert await until(lambda: elector.is_leader) <= SECONDS + 3, "the thief never renews it"
    assert found.lease()["leaseTransitions"] == 8


@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize("way", [{}, {"status": 500}], ids=str)
def test_a_leader_whose_renewal_loses_its_answer_stays_the_leader(way: Body, times: int) -> None:
    @played
    async def test(found: Operators) -> None:
        elector = found.start("a")
        await until(lambda: elector.is_leader)
        found.api.faults.append(Fault("update", "leases", carried_out=True, times=times, **way))
        for _ in range(400):
            await asyncio.sleep(0.1)
            assert elector.is_leader
        assert found.told == [("a", True)]

    test()


@played
async def test_two_that_ask_at_once_do_not_both_get_it(found: Operators) -> None:
    electors = [found.start(name) for name in "abcd"]
    for _ in range(200):
        await asyncio.sleep(0.25)
        assert sum(elector.is_leader for elector in electors) <= 1
    assert sum(elector.is_leader for elector in electors) == 1


@played
async def test_a_lease_that_is_deleted_is_made_again(found: Operators) -> None:
    elector = found.start("a")
    await until(lambda: elector.is_leader)
    found.store.remove("leases", NAMESPACE, NAME)
    await asyncio.sleep(30)
    assert elector.is_leader
    assert found.lease()["holderIdentity"] == "a"


@pytest.mark.parametrize(
    "spec",
    [None, {}, {"holderIdentity": None}, {"holderIdentity": "", "leaseTransitions": "many"}],
)
def test_a_lease_without_a_holder_is_taken(spec: Body | None) -> None:
    @played
    async def test(found: Operators) -> None:
        found.store.create("leases", NAMESPACE, {"metadata": {"name": NAME}, "spec": spec})
        elector = found.start("a")
        assert await until(lambda: elector.is_leader) < 1

    test()


@pytest.mark.parametrize("duration", [None, "long", 0, -3])
def test_a_lease_with_an_invalid_duration_gets_this_operators_duration(duration: object) -> None:
    @played
    async def test(found: Operators) -> None:
        spec = {"holderIdentity": "other", "leaseDurationSeconds": duration}
        found.store.create("leases", NAMESPACE, {"metadata": {"name": NAME}, "spec": spec})
        elector = found.start("a")
        assert SECONDS <= await until(lambda: elector.is_leader) <= SECONDS + 3

    test()


@played
async def test_a_holder_that_asks_for_years_is_waited_for_some_minutes(found: Operators) -> None:
    spec = {"holderIdentity": "other", "leaseDurationSeconds": 2**31 - 1}
    found.store.create("leases", NAMESPACE, {"metadata": {"name": NAME}, "spec": spec})
    elector = found.start("a")
    longest = operator_leases.LONGEST_DURATION * SECONDS
    assert longest <= await until(lambda: elector.is_leader, longest + 3)


@played
async def test_repeated_writes_of_the_lease_stop_the_operator_for_as_long(found: Operators) -> None:
    """A known limit: such a writer looks like another process of the release."""
    elector = found.start("a")
    await until(lambda: elector.is_leader)
    for turn in range(100):
        forged = found.lease() | {"holderIdentity": "writer", "leaseTransitions": turn}
        found.store.merge("leases", NAMESPACE, NAME, {"spec": forged})
        await asyncio.sleep(SECONDS / 2)
        assert not elector.is_leader
    assert await until(lambda: elector.is_leader) <= SECONDS + 3


@played
async def test_the_clocks_of_others_do_not_count(found: Operators) -> None:
    """A renewTime that is an hour old, or in the future, says nothing."""
    for stamp in ("2020-01-01T00:00:00.000000Z", "2099-01-01T00:00:00.000000Z"):
        spec = {"holderIdentity": "other", "leaseDurationSeconds": 10, "renewTime": stamp}
        found.store.create("leases", NAMESPACE, {"metadata": {"name": NAME}, "spec": spec})
        found.start("a")
        assert 10 <= await until(lambda: found.told == [("a", True)]) <= 13
        await found.kill("a")
        found.told.clear()
        found.store.remove("leases", NAMESPACE, NAME)


@played
async def test_giving_up_an_unreachable_lease_is_no_error(found: Operators) -> None:
    elector = found.start("a")
    await until(lambda: elector.is_leader)
    elector.resign()
    await found.kill("a")
    found.api.down = True
    await elector.release()
    found.api.down = False
    assert found.lease()["holderIdentity"] == "a"


@played
async def test_a_resigned_operator_never_acts_again(found: Operators) -> None:
    elector = found.start("a")
    await until(lambda: elector.is_leader)
    elector.resign()
    for _ in range(60):
        await asyncio.sleep(1)
        assert not elector.is_leader


# -- Calls that were begun under a Lease end before another operator may begin


@pytest.mark.parametrize("seconds", [6, 15, 60, 3600])
def test_a_write_has_ended_when_another_may_begin(seconds: int) -> None:
    """Whenever it begins, counted from when the Lease was asked for."""

    @played
    async def test(found: Operators) -> None:
        asked = now()
        elector = found.start("a", seconds=seconds)
        await until(lambda: elector.is_leader, 1)
        await found.kill("a")
        while elector.is_leader:
            assert now() < now() + elector.require() < asked + seconds
            await asyncio.sleep(seconds / 500)
        assert seconds / 2 < now() - asked < seconds

    test()


@played
async def test_no_write_is_under_way_when_another_begins(found: Operators) -> None:
    """The holder is cut off, and all that it asks for takes long."""
    way = KubernetesApi(found.store)
    async with way.serving():
        first = found.start("a", way)
        await until(lambda: first.is_leader)
        door = Cluster(configuration(way), connections=4, permit=first.require)
        second = found.start("b")
        way.faults += [
            Fault("update", "leases", late=600, times=10**6),
            Fault("create", "pods", late=600, times=10**6),
        ]
        while first.is_leader:
            with pytest.raises(Transient):
                await door.create(PODS, NAMESPACE, {"metadata": {"name": "x"}})
        last = now()
        assert not second.is_leader
        await until(lambda: second.is_leader)
        assert now() - last > 1
        await found.kill("a")
        await door.close()


@played
async def test_an_answer_that_is_lost_is_no_other_operator(found: Operators) -> None:
    elector = found.start("a")
    await until(lambda: elector.is_leader)
    found.api.faults.append(Fault("update", "leases", carried_out=True, times=3))
    for _ in range(120):
        await asyncio.sleep(0.5)
        assert elector.is_leader
    assert found.told == [("a", True)]
