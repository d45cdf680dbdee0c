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
from fiber_api.names import ANNOTATION_CONNECTED
from fiber_operator.cluster import Cluster
from fiber_operator.lease_monitor import MISSING_AFTER, LeaseMonitor, MasterLease, connected_in
from fiber_operator.planning.plans import LeaseVerdict
from fiber_operator.workqueue import Key

ES = Key("team", "es")
LEASE = MasterLease("lease", 1, 30.0)


class Watch:
    """``LeaseMonitor`` at work, what tells it of changes, and a master that renews its Lease."""

    def __init__(self, api: KubernetesApi, door: Cluster) -> None:
        self.api, self.store = api, api.store
        self.told: list[tuple[float, LeaseVerdict]] = []
        self.leases: dict[Key, MasterLease] = {}
        """Leases of other pools than ``ES``."""
        self.deaf = False
        """No change is heard of."""
        self.monitor = LeaseMonitor(door, self._tell)
        self.tasks = [asyncio.ensure_future(part) for part in (self.monitor.run(), self._feed())]
        self._renewals: asyncio.Task[None] | None = None
        self._count = 0

    async def _feed(self) -> None:
        seen = 0
        while True:
            changes = self.store.changes
            for change in changes[seen:]:
                _, namespace, name = change.place
                gone = change.type == "DELETED"
                if not self.deaf and not self.api.down:
                    version = "" if gone else change.object["metadata"]["resourceVersion"]
                    self.monitor.lease_changed(
                        namespace, name, version, connected_in(change.object)
                    )
            seen = len(changes)
            await self.store.changed()

    def _tell(self, key: Key) -> None:
        now = round(asyncio.get_running_loop().time(), 1)
        self.told.append((now, self.monitor.follow(key, self.leases.get(key, LEASE))))

    def alive(self) -> bool | None:
        return self.monitor.follow(ES, LEASE).alive

    def write(self, name: str = "lease", connected: str | None = None) -> None:
        self._count += 1
        said = {} if connected is None else {ANNOTATION_CONNECTED: connected}
        spec = {"holderIdentity": "es-1", "renewTime": f"time {self._count}"}
        if any(lease["metadata"]["name"] == name for lease in self.store.list("leases", "team")):
            body = {"metadata": {"annotations": said}, "spec": spec}
            self.store.merge("leases", "team", name, body)
        else:
            body = {"metadata": {"name": name, "annotations": said}, "spec": spec}
            self.store.create("leases", "team", body)

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
            for task in watch.tasks:
                task.cancel()
            await asyncio.wait(watch.tasks)
            await door.close()


def played(test: Callable[[Watch], Coroutine[Any, Any, None]]) -> Callable[[], None]:
    async def main() -> None:
        async with watching() as watch:
            await test(watch)

    return lambda: virtual_time.run(main())


@played
async def test_a_master_that_renews_is_alive(watch: Watch) -> None:
    watch.renew()
    await asyncio.sleep(1)
    assert watch.alive() is None
    await asyncio.sleep(14)
    for _ in range(100):
        assert watch.alive() is True
        await asyncio.sleep(5)
    assert [verdict for _, verdict in watch.told] == [LeaseVerdict(alive=True)]


@played
async def test_the_number_of_agents_in_a_lease_counts_from_its_first_renewal(watch: Watch) -> None:
    """Before that it may be the word of the last master."""
    watch.write(connected="7")
    watch.monitor.follow(ES, LEASE)
    for said, heard in (("2", 2), ("3", 3), ("some", None), ("-1", None)):
        await asyncio.sleep(5)
        if said == "2":
            assert watch.monitor.follow(ES, LEASE) == LeaseVerdict()
        watch.write(connected=said)
        await asyncio.sleep(1)
        assert watch.monitor.follow(ES, LEASE) == LeaseVerdict(alive=True, connected=heard)
    assert watch.api.count("get", "leases") == 1


@played
async def test_however_long_they_renew_masters_cost_one_read_each(watch: Watch) -> None:
    """Beside the one watch."""
    for number in range(50):
        key, lease = Key("team", f"pool-{number}"), LEASE._replace(name=f"lease-{number}")
        watch.leases[key] = lease
        watch.write(lease.name)
        watch.monitor.follow(key, lease)
    for _ in range(20):
        await asyncio.sleep(20)
        for lease in watch.leases.values():
            watch.write(lease.name)
    assert watch.api.count("get", "leases") == 50
    assert [verdict.alive for _, verdict in watch.told] == 50 * [True]


@played
async def test_a_lease_that_was_made_after_its_master_was_seen_is_alive_at_once(
    watch: Watch,
) -> None:
    watch.monitor.follow(ES, LEASE)
    await asyncio.sleep(6)
    assert watch.monitor.follow(ES, LEASE) == LeaseVerdict(missing=True)
    watch.write()
    await asyncio.sleep(1)
    assert watch.monitor.follow(ES, LEASE) == LeaseVerdict(alive=True)


@played
async def test_a_lease_that_comes_soon_after_its_pool_is_not_missed(watch: Watch) -> None:
    """Simulate the start of a program, whose Lease belongs to its pool."""
    watch.monitor.follow(ES, LEASE)
    await asyncio.sleep(MISSING_AFTER / 2)
    watch.renew()
    await asyncio.sleep(20)
    assert [verdict for _, verdict in watch.told] == [LeaseVerdict(alive=True)]


@played
async def test_a_master_that_stops_renewing_is_lost_after_the_duration(watch: Watch) -> None:
    watch.renew()
    watch.monitor.follow(ES, LEASE)
    await asyncio.sleep(41)
    watch.die()
    await asyncio.sleep(27)
    assert watch.alive() is True
    await asyncio.sleep(15)
    assert watch.alive() is False
    assert [verdict.alive for _, verdict in watch.told] == [True, False]


@played
async def test_a_master_that_renews_again_is_alive_again(watch: Watch) -> None:
    watch.renew()
    watch.monitor.follow(ES, LEASE)
    await asyncio.sleep(21)
    watch.die()
    await asyncio.sleep(60)
    assert watch.alive() is False
    watch.renew()
    await asyncio.sleep(11)
    assert watch.alive() is True


@played
async def test_a_lease_that_is_never_made_does_not_change(watch: Watch) -> None:
    watch.monitor.follow(ES, LEASE)
    await asyncio.sleep(25)
    assert watch.alive() is None
    await asyncio.sleep(16)
    assert watch.monitor.follow(ES, LEASE) == LeaseVerdict(alive=False, missing=True)


@played
async def test_a_lease_that_is_deleted_may_be_made_anew(watch: Watch) -> None:
    watch.renew()
    watch.monitor.follow(ES, LEASE)
    await asyncio.sleep(21)
    watch.die()
    watch.store.remove("leases", "team", "lease")
    await asyncio.sleep(25)
    assert watch.monitor.follow(ES, LEASE) == LeaseVerdict(alive=True, missing=True)
    watch.renew()
    await asyncio.sleep(60)
    assert watch.monitor.follow(ES, LEASE) == LeaseVerdict(alive=True)
    watch.die()
    watch.store.remove("leases", "team", "lease")
    await asyncio.sleep(45)
    assert watch.monitor.follow(ES, LEASE) == LeaseVerdict(alive=False, missing=True)


@played
async def test_a_watch_that_is_deaf_costs_no_master_its_pool(watch: Watch) -> None:
    watch.renew()
    watch.deaf = True
    watch.monitor.follow(ES, LEASE)
    for _ in range(100):
        await asyncio.sleep(5)
        assert watch.alive() is not False
    assert watch.alive() is True
    watch.die()
    await asyncio.sleep(75)
    assert watch.alive() is False
    watch.renew()
    await asyncio.sleep(70)
    assert watch.alive() is True


@played
async def test_an_outage_of_the_api_server_is_not_the_masters(watch: Watch) -> None:
    watch.renew()
    watch.monitor.follow(ES, LEASE)
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
    assert [master.alive for _, master in watch.told] == [True]


@played
async def test_an_outage_that_ends_just_before_the_time_is_over_is_not_the_masters_either(
    watch: Watch,
) -> None:
    watch.renew()
    watch.monitor.follow(ES, LEASE)
    await asyncio.sleep(21)
    watch.die()
    await asyncio.sleep(29)  # no reader was available, and none has asked
    await asyncio.sleep(5)
    watch.renew()
    await asyncio.sleep(100)
    assert [master.alive for _, master in watch.told] == [True]


@played
async def test_an_outage_puts_the_loss_off_and_does_not_hide_it(watch: Watch) -> None:
    watch.renew()
    watch.monitor.follow(ES, LEASE)
    await asyncio.sleep(21)
    watch.die()
    watch.api.faults.append(Fault("get", "leases", status=500, times=2))
    await asyncio.sleep(90)
    assert watch.alive() is True
    await asyncio.sleep(45)
    assert watch.alive() is False


@played
async def test_time_without_a_running_monitor_does_not_count(watch: Watch) -> None:
    """The operator's process was stopped, or its loop was busy."""
    watch.renew()
    watch.monitor.follow(ES, LEASE)
    await asyncio.sleep(21)
    watch.die()
    loop = asyncio.get_running_loop()
    loop._virtual.now += 1000  # type: ignore[attr-defined]
    await asyncio.sleep(25)
    assert watch.alive() is True
    await asyncio.sleep(25)
    assert watch.alive() is False


@played
async def test_an_unreadable_lease_is_not_judged(watch: Watch) -> None:
    watch.api.faults.append(Fault("get", "leases", status=403, times=5))
    watch.monitor.follow(ES, LEASE)
    await asyncio.sleep(100)
    assert watch.monitor.follow(ES, LEASE) == LeaseVerdict(alive=None, unreadable="this is a test")
    assert len(watch.told) == 1
    await asyncio.sleep(100)
    assert watch.monitor.follow(ES, LEASE).unreadable == ""


@played
async def test_another_epoch_is_another_master(watch: Watch) -> None:
    watch.renew()
    watch.monitor.follow(ES, LEASE)
    await asyncio.sleep(21)
    assert watch.alive() is True
    assert watch.monitor.follow(ES, LEASE._replace(epoch=2)) == LeaseVerdict()


@played
async def test_a_pool_without_a_lease_causes_no_reads(watch: Watch) -> None:
    watch.monitor.follow(ES, LEASE)
    await asyncio.sleep(21)
    assert watch.monitor.follow(ES, None) == LeaseVerdict()
    watch.api.calls.clear()
    watch.write()
    await asyncio.sleep(300)
    assert watch.api.calls == []


@pytest.mark.parametrize("spec", ["text", 7, [], {"holderIdentity": 3, "renewTime": {}}])
def test_nonsense_in_a_lease_does_not_count_as_a_renewal(spec: object) -> None:
    @played
    async def test(watch: Watch) -> None:
        watch.store.create("leases", "team", {"metadata": {"name": "lease"}, "spec": spec})
        watch.monitor.follow(ES, LEASE)
        await asyncio.sleep(45)
        assert watch.alive() is False

    test()
