"""A master is alive while its Lease changes, by this process's clock alone."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any

import pytest

from fakes import virtual_time
from fakes.kubernetes_api import Fault, KubernetesApi
from fakes.store import Store
from fakes.world import configuration
from fiber_operator.cluster import Cluster
from fiber_operator.masters import Masters, Term
from fiber_operator.planning.plans import LeaseVerdict
from fiber_operator.workqueue import Key

ES = Key("team", "es")
TERM = Term("lease", 1, 30.0)


class Watch:
    """``Masters`` at work, and a master that renews its Lease."""

    def __init__(self, api: KubernetesApi, door: Cluster) -> None:
        self.api, self.store = api, api.store
        self.told: list[tuple[float, LeaseVerdict]] = []
        self.masters = Masters(door, self._tell)
        self.task = asyncio.ensure_future(self.masters.run())
        self._renewals: asyncio.Task[None] | None = None
        self._count = 0

    def _tell(self, key: Key) -> None:
        now = round(asyncio.get_running_loop().time(), 1)
        self.told.append((now, self.masters.follow(key, TERM)))

    def alive(self) -> bool | None:
        return self.masters.follow(ES, TERM).alive

    def write(self, holder: str | None = "es-1", stamp: str = "") -> None:
        self._count += 1
        spec = {"holderIdentity": holder, "renewTime": stamp or f"time {self._count}"}
        if self.store.list("leases", "team"):
            self.store.merge("leases", "team", "lease", {"spec": spec})
        else:
            self.store.create("leases", "team", {"metadata": {"name": "lease"}, "spec": spec})

    def renew(self, every: float = 10.0) -> None:
        async def renewing() -> None:
            while True:
                self.write()
                await asyncio.sleep(every)

        self._renewals = asyncio.ensure_future(renewing())

    def die(self) -> None:
        if self._renewals is not None:
            self._renewals.cancel()


@contextlib.asynccontextmanager
async def watching() -> AsyncIterator[Watch]:
    api = KubernetesApi(Store(asyncio.get_running_loop().time))
    async with api.serving():
        door = Cluster(configuration(api), connections=4)
        watch = Watch(api, door)
        try:
            yield watch
        finally:
            watch.die()
            watch.task.cancel()
            await asyncio.wait([watch.task])
            await door.close()


def played(test: Callable[[Watch], Coroutine[Any, Any, None]]) -> Callable[[], None]:
    async def main() -> None:
        async with watching() as watch:
            await test(watch)

    return lambda: virtual_time.run(main())


@played
async def test_one_that_renews_is_alive(watch: Watch) -> None:
    watch.renew()
    assert watch.alive() is None
    await asyncio.sleep(15)
    for _ in range(100):
        assert watch.alive() is True
        await asyncio.sleep(5)
    assert watch.told[-1] == (10.0, LeaseVerdict(alive=True, holder="es-1"))


@played
async def test_one_that_stops_is_lost_after_the_duration(watch: Watch) -> None:
    watch.renew()
    watch.masters.follow(ES, TERM)
    await asyncio.sleep(41)
    watch.die()
    await asyncio.sleep(27)
    assert watch.alive() is True
    await asyncio.sleep(15)
    assert watch.alive() is False
    assert len(watch.told) == 3


@played
async def test_one_that_comes_back_is_alive_again(watch: Watch) -> None:
    watch.renew()
    watch.masters.follow(ES, TERM)
    await asyncio.sleep(21)
    watch.die()
    await asyncio.sleep(60)
    assert watch.alive() is False
    watch.renew()
    await asyncio.sleep(11)
    assert watch.alive() is True


@played
async def test_a_lease_that_is_never_made_does_not_change(watch: Watch) -> None:
    watch.masters.follow(ES, TERM)
    await asyncio.sleep(25)
    assert watch.alive() is None
    await asyncio.sleep(16)
    assert watch.masters.follow(ES, TERM) == LeaseVerdict(alive=False, missing=True)


@pytest.mark.parametrize("holder", ["", None])
def test_a_lease_that_is_let_go_may_be_taken_up(holder: str | None) -> None:
    @played
    async def test(watch: Watch) -> None:
        watch.renew()
        watch.masters.follow(ES, TERM)
        await asyncio.sleep(21)
        watch.die()
        watch.write(holder)
        await asyncio.sleep(25)
        assert watch.alive() is True
        watch.renew()
        await asyncio.sleep(60)
        assert watch.alive() is True
        watch.die()
        watch.store.remove("leases", "team", "lease")
        await asyncio.sleep(25)
        assert watch.alive() is True
        await asyncio.sleep(20)
        assert watch.alive() is False

    test()


@played
async def test_an_outage_of_the_api_server_is_not_the_masters(watch: Watch) -> None:
    watch.renew()
    watch.masters.follow(ES, TERM)
    await asyncio.sleep(21)
    watch.api.down = True
    watch.die()  # it cannot renew it either
    await asyncio.sleep(300)
    assert watch.alive() is True
    watch.api.down = False
    await asyncio.sleep(25)
    assert watch.alive() is True
    watch.renew()
    await asyncio.sleep(100)
    assert watch.alive() is True
    assert [master.alive for _, master in watch.told] == [None, True]


@played
async def test_an_outage_puts_the_loss_off_and_does_not_hide_it(watch: Watch) -> None:
    watch.renew()
    watch.masters.follow(ES, TERM)
    await asyncio.sleep(21)
    watch.die()
    watch.api.faults.append(Fault("get", "leases", status=500, times=3))
    await asyncio.sleep(100)
    assert watch.alive() is False


@played
async def test_time_in_which_nobody_looked_does_not_count(watch: Watch) -> None:
    """The operator's process was stopped, or its loop was busy."""
    watch.renew()
    watch.masters.follow(ES, TERM)
    await asyncio.sleep(21)
    watch.die()
    loop = asyncio.get_running_loop()
    loop._virtual.now += 1000  # type: ignore[attr-defined]
    await asyncio.sleep(25)
    assert watch.alive() is True


@played
async def test_what_cannot_be_read_is_not_judged(watch: Watch) -> None:
    watch.api.faults.append(Fault("get", "leases", status=403, times=10**6))
    watch.masters.follow(ES, TERM)
    await asyncio.sleep(300)
    assert watch.masters.follow(ES, TERM) == LeaseVerdict(alive=None, unreadable="this is a test")
    assert len(watch.told) == 1


@played
async def test_another_epoch_is_another_master(watch: Watch) -> None:
    watch.renew()
    watch.masters.follow(ES, TERM)
    await asyncio.sleep(21)
    assert watch.alive() is True
    assert watch.masters.follow(ES, TERM._replace(epoch=2)) == LeaseVerdict()


@played
async def test_nobody_is_watched_for_nothing(watch: Watch) -> None:
    watch.masters.follow(ES, TERM)
    await asyncio.sleep(21)
    assert watch.masters.follow(ES, None) == LeaseVerdict()
    watch.api.calls.clear()
    await asyncio.sleep(300)
    assert watch.api.calls == []


@pytest.mark.parametrize("spec", ["text", 7, [], {"holderIdentity": 3, "renewTime": {}}])
def test_nonsense_in_a_lease_is_no_sign_of_life(spec: object) -> None:
    @played
    async def test(watch: Watch) -> None:
        watch.store.create("leases", "team", {"metadata": {"name": "lease"}, "spec": spec})
        watch.masters.follow(ES, TERM)
        await asyncio.sleep(45)
        assert watch.alive() is False

    test()


@played
async def test_many_are_looked_at(watch: Watch) -> None:
    for number in range(50):
        watch.masters.follow(Key("team", f"pool-{number}"), TERM)
    await asyncio.sleep(5)
    assert watch.api.count("get", "leases") == 50
    await asyncio.sleep(29)
    assert watch.api.count("get", "leases") == 4 * 50
