"""Pieces of apply that a whole operator shows too rarely: creation and events."""

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
from fiber_api.rest import Conflict, TooManyRequests, Transient
from fiber_operator import events
from fiber_operator.cluster import Cluster, Permit
from fiber_operator.creation import Created, Creation, CreationPace, Order, draw_suffix
from fiber_operator.events import EventRecorder
from fiber_operator.operator_leases import NotLeader
from fiber_operator.planning.plans import PoolEvent
from fiber_operator.planning.pods import PodView, observe
from fiber_operator.workqueue import Key

ES = Key("team", "es")


@contextlib.asynccontextmanager
async def a_cluster(permit: Permit) -> AsyncIterator[tuple[KubernetesApi, Cluster]]:
    api = KubernetesApi(Store(asyncio.get_running_loop().time))
    async with api.serving():
        door = Cluster(configuration(api), connections=16, permit=permit)
        try:
            yield api, door
        finally:
            await door.close()


Test = Callable[[KubernetesApi, Cluster], Coroutine[Any, Any, None]]


def played(test: Test, permit: Permit = lambda: 10.0) -> Callable[[], None]:
    async def main() -> None:
        async with a_cluster(permit) as (api, door):
            await test(api, door)

    return lambda: virtual_time.run(main())


def body(name: str) -> Body:
    return {"metadata": {"name": name}}


def order(limit: int = 100) -> Order:
    return Order("hash", body, limit)


async def create(door: Cluster, count: int, pace: CreationPace | None = None) -> Created:
    creation = Creation(door, ES, pace or CreationPace())
    creation.aim(count, order())
    await creation.wait()
    return creation.take()


def views(api: KubernetesApi) -> list[PodView]:
    """Return the current list."""
    return [observe(pod, "worker") for pod in api.store.list("pods")]


# -- Creation


def test_names_are_drawn_at_random() -> None:
    drawn = {draw_suffix() for _ in range(1000)}
    assert len(drawn) == 1000
    assert {len(suffix) for suffix in drawn} == {10}


@played
async def test_all_are_created(api: KubernetesApi, door: Cluster) -> None:
    pace = CreationPace()
    done = await create(door, 100, pace)
    assert sorted(done.names) == [pod["metadata"]["name"] for pod in api.store.list("pods")]
    assert len(done.names) == 100
    assert pace == CreationPace(batch=1)


@pytest.mark.parametrize(("status", "kind"), [(403, "refusal"), (422, "refusal"), (404, "failure")])
def test_a_refused_creation_ends_the_batch(status: int, kind: str) -> None:
    @played
    async def test(api: KubernetesApi, door: Cluster) -> None:
        api.faults.append(Fault("create", "pods", status=status, skip=5, times=100))
        pace = CreationPace()
        done = await create(door, 100, pace)
        assert len(api.calls) == 1 + 2 + 4
        assert len(done.names) == 5
        assert getattr(done, kind).status == status
        assert pace == CreationPace(batch=1)

    test()


@played
async def test_a_quota_that_is_counted_at_the_same_time_is_no_refusal(
    api: KubernetesApi, door: Cluster
) -> None:
    message = "Operation cannot be fulfilled on resourcequotas: the object has been modified"
    api.faults.append(Fault("create", "pods", status=409, reason="Conflict", message=message))
    pace = CreationPace()
    done = await create(door, 3, pace)
    assert isinstance(done.failure, Conflict)
    assert done.names == []
    assert pace.unsure == []


@played
async def test_names_whose_fate_is_unknown_are_used_first(
    api: KubernetesApi, door: Cluster
) -> None:
    api.faults += [Fault("create", "pods", carried_out=True), Fault("create", "pods")]
    pace = CreationPace(batch=2)
    done = await create(door, 4, pace)
    assert isinstance(done.failure, Transient)
    unsure = list(pace.unsure)
    assert len(unsure) == 2
    assert len(api.store.list("pods")) == 1
    again = await create(door, 4, pace)
    assert again.names[:2] == unsure
    assert len(api.store.list("pods")) == 4
    assert pace.unsure == []


@played
async def test_the_longest_wait_that_was_asked_for_counts(
    api: KubernetesApi, door: Cluster
) -> None:
    api.faults += [Fault("create", "pods", status=429, retry_after=n) for n in (3, 20, 5)]
    done = await create(door, 10, CreationPace(batch=4))
    assert isinstance(done.failure, TooManyRequests)
    assert done.wait == 20.0
    assert len(done.names) == 1


@played
async def test_a_creation_that_is_stopped_ends_with_its_batch(
    api: KubernetesApi, door: Cluster
) -> None:
    api.faults.append(Fault("create", "pods", late=0.4, times=10**6))
    creation = Creation(door, ES, CreationPace())
    creation.aim(100, order(limit=16))
    assert not await creation.wait(1.0)
    assert len(creation.take().names) == 1 + 2
    creation.stop()
    assert await creation.wait()
    assert len(creation.take().names) == 4
    creation.see(views(api))
    creation.aim(2, order())
    assert await creation.wait()
    assert len(api.store.list("pods")) == 7 + 2


@played
async def test_no_pod_is_created_twice_however_late_the_list_is(
    api: KubernetesApi, door: Cluster
) -> None:
    """Pods are looked at at any time; ten are always wanted."""
    api.faults.append(Fault("create", "pods", late=0.4, times=10**6))
    for pause in (0.0, 0.3, 0.5, 0.9, 1.3):
        for pod in api.store.list("pods"):
            api.store.remove("pods", "team", pod["metadata"]["name"])
        known: list[PodView] = []

        def expect(document: Body, known: list[PodView] = known) -> None:
            known.append(observe(document, "worker"))

        creation = Creation(door, ES, CreationPace(), created=expect)
        creation.aim(10, order(limit=4))
        for _ in range(3):
            await asyncio.sleep(pause)
            creation.see(known)
            creation.aim(10 - len(known), order(limit=4))
        await creation.wait()
        assert len(api.store.list("pods")) == len(known) == 10


@played
async def test_a_cancelled_creation_marks_its_open_calls_as_unsure(
    api: KubernetesApi, door: Cluster
) -> None:
    api.faults.append(Fault("create", "pods", late=0.4, times=10**6, skip=1))
    pace = CreationPace()
    creation = Creation(door, ES, pace)
    creation.aim(10, order())
    await asyncio.sleep(0.2)
    await creation.cancel()
    assert len(pace.unsure) == 2
    await asyncio.sleep(1)
    again = Creation(door, ES, pace)
    pods = views(api)
    again.see(pods)
    again.aim(10 - len(pods), order())
    await again.wait()
    assert len(api.store.list("pods")) == 10


def test_without_the_lease_no_pod_is_created() -> None:
    def refuse() -> float:
        raise NotLeader

    async def test(api: KubernetesApi, door: Cluster) -> None:
        with pytest.raises(NotLeader):
            await create(door, 10)
        assert api.calls == []

    played(test, refuse)()


# -- Events


def recorder(api: KubernetesApi, door: Cluster) -> EventRecorder:
    return EventRecorder(door, api.store.unix_now, "operator-1")


@played
async def test_an_event_that_repeats_is_counted(api: KubernetesApi, door: Cluster) -> None:
    record, event = recorder(api, door), PoolEvent("Warning", "Because", "words")
    for _ in range(100):
        await record.record(ES, "uid", event)
        await asyncio.sleep(1)
    (found,) = api.store.list("events")
    assert 60 < found["count"] <= 100
    assert len(api.calls) <= 1 + 100 / events.PAUSE
    assert found["lastTimestamp"] > found["firstTimestamp"]
    await asyncio.sleep(events.WINDOW)
    await record.record(ES, "uid", event)
    assert len(api.store.list("events")) == 2


@played
async def test_events_are_posted_in_order_without_waiting(
    api: KubernetesApi, door: Cluster
) -> None:
    record, clock = recorder(api, door), asyncio.get_running_loop().time
    running = asyncio.ensure_future(record.run())
    slow = Fault("create", "events", late=4.5, times=10**6)
    api.faults.append(slow)
    for number in range(events.WAITING + 10):
        record.tell(ES, "uid", PoolEvent("Normal", "A", str(number)))
    assert clock() == 0.0
    await asyncio.sleep(20)
    assert [event["message"] for event in api.store.list("events")] != []
    slow.late = 0.001
    await asyncio.sleep(30)
    told = [change.object["message"] for change in api.store.changes]
    assert told == [str(number) for number in range(10, events.WAITING + 10)]
    running.cancel()


def test_events_without_the_lease_are_given_up() -> None:
    held = False

    def require() -> float:
        if not held:
            raise NotLeader
        return 10.0

    async def test(api: KubernetesApi, door: Cluster) -> None:
        nonlocal held
        record = recorder(api, door)
        running = asyncio.ensure_future(record.run())
        record.tell(ES, "uid", PoolEvent("Normal", "A", "before"))
        await asyncio.sleep(1)
        held = True
        record.tell(ES, "uid", PoolEvent("Normal", "A", "after"))
        await asyncio.sleep(1)
        assert [event["message"] for event in api.store.list("events")] == ["after"]
        running.cancel()

    played(test, require)()


@played
async def test_events_differ_by_pool_reason_and_words(api: KubernetesApi, door: Cluster) -> None:
    record = recorder(api, door)
    for uid, reason, message in [
        ("1", "A", "a"),
        ("2", "A", "a"),
        ("1", "B", "a"),
        ("1", "A", "b"),
    ]:
        await record.record(ES, uid, PoolEvent("Normal", reason, message))
    assert len(api.store.list("events")) == 4


@pytest.mark.parametrize(
    "fault", [Fault(status=403), Fault(status=500), Fault(), Fault(text="{}"), Fault(late=60)]
)
def test_an_event_that_cannot_be_posted_is_forgotten(fault: Fault) -> None:
    @played
    async def test(api: KubernetesApi, door: Cluster) -> None:
        record = recorder(api, door)
        fault.times = 1
        api.faults.append(fault)
        await record.record(ES, "uid", PoolEvent("Normal", "A", "a"))
        assert asyncio.get_running_loop().time() <= 5.1
        await record.record(ES, "uid", PoolEvent("Normal", "A", "a"))
        assert api.store.list("events") != []

    test()


@played
async def test_a_long_message_is_cut(api: KubernetesApi, door: Cluster) -> None:
    await recorder(api, door).record(ES, "uid", PoolEvent("Normal", "A", "a" * 5000))
    (found,) = api.store.list("events")
    assert len(found["message"]) == events.MESSAGE_LIMIT


@played
async def test_memory_of_events_is_bounded(api: KubernetesApi, door: Cluster) -> None:
    record = recorder(api, door)
    for number in range(events.REMEMBERED + 10):
        await record.record(ES, "uid", PoolEvent("Normal", "A", str(number)))
    assert len(record._namespaces[ES.namespace].posted) == events.REMEMBERED


@played
async def test_a_namespace_without_recent_events_is_forgotten(
    api: KubernetesApi, door: Cluster
) -> None:
    record = recorder(api, door)
    running = asyncio.ensure_future(record.run())
    for number in range(100):
        record.tell(Key(f"team-{number}", "es"), "uid", PoolEvent("Normal", "A", "a"))
    await asyncio.sleep(2 * events.WINDOW)
    for number in range(100):
        record.tell(ES, "uid", PoolEvent("Normal", "A", str(number % 2)))
        await asyncio.sleep(1)
    assert set(record._namespaces) == {ES.namespace}
    running.cancel()


@played
async def test_the_events_of_one_namespace_neither_delay_nor_displace_anothers(
    api: KubernetesApi, door: Cluster
) -> None:
    record = recorder(api, door)
    running = asyncio.ensure_future(record.run())
    api.faults.append(Fault("create", "events", late=1.0, times=10**6))
    record.tell(Key("well", "es"), "uid", PoolEvent("Normal", "A", "first"))
    for number in range(10_000):
        record.tell(ES, "uid", PoolEvent("Warning", "Broken", str(number)))
    record.tell(Key("well", "es"), "uid", PoolEvent("Normal", "A", "second"))
    await asyncio.sleep(2.5)
    told = [event["message"] for event in api.store.list("events", "well")]
    assert sorted(told) == ["first", "second"]
    running.cancel()
