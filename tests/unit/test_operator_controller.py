"""The operator at work on a cluster where nothing goes wrong that is not the users' doing."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable
from typing import Any

import pytest

from fakes import virtual_time
from fakes.kubernetes_api import Call
from fakes.store import Body, Failure
from fakes.world import NAMESPACE, TEMPLATE, Test, World, a_world
from fiber_operator import responses
from unit.operator_objects import MASTER


def played(**settings: Any) -> Callable[[Test], Callable[[], None]]:
    def decorate(test: Test) -> Callable[[], None]:
        async def main() -> None:
            async with a_world(**settings) as world:
                await test(world)

        return lambda: virtual_time.run(main())

    return decorate


@played()
async def test_a_pool_gets_its_workers(world: World) -> None:
    world.make_pool(replicas=5)
    assert await world.ready(5) < 3
    assert world.status()["phase"] == "Ready"
    assert world.reasons() == []
    for pod in world.pods():
        assert pod["metadata"]["ownerReferences"][0]["kind"] == "FiberPool"
        assert "finalizers" not in pod["metadata"]


@played()
async def test_agents_know_where_to_dial(world: World) -> None:
    world.make_pool(replicas=1, master=MASTER)
    await world.ready(1)
    (service,) = world.store.list("services")
    address = f"{service['spec']['clusterIP']}:7070"
    assert world.status()["endpoint"] == f"tls+tcp://{address}"
    environment = world.pods()[0]["spec"]["containers"][0]["env"]
    assert {"name": "FIBER_AGENT_ADDRESS", "value": address} in environment


@played()
async def test_bad_news_is_in_the_status_within_a_second(world: World) -> None:
    world.make_pool(replicas=5)
    await world.ready(5)
    for number, name in enumerate(world.names()):
        await asyncio.sleep(0.3 * number)
        world.kubelet.exit(NAMESPACE, name, 3)
        total = number + 1
        told = await world.until(lambda n=total: world.status()["failures"]["total"] == n)  # type: ignore[misc]
        assert told <= 1.0


@played()
async def test_a_new_pool_skips_reads_of_later_objects(world: World) -> None:
    world.make_pool(replicas=1)
    await world.ready(1)
    for plural in ("services", "secrets", "endpointslices"):
        assert (world.api.count("create", plural), world.api.count("get", plural)) == (1, 0)


@played()
async def test_a_quiet_pool_costs_a_look_a_minute(world: World) -> None:
    world.make_pool(replicas=5)
    await world.ready(5)
    await world.settled(90)
    world.api.calls.clear()
    await world.settled(600)
    ours = [call for call in world.api.calls if call.plural != "leases"]
    assert {call.verb for call in ours} == {"get", "list", "watch"}
    # The list of pools, the pool and the three objects beside it; a watch lasts four minutes.
    assert len(ours) <= 11 * 5 + 3


@played()
async def test_many_pods_cost_little_more_than_their_creation(world: World) -> None:
    world.make_pool(replicas=200)
    await world.ready(200)
    ours = [call for call in world.api.calls if call.plural != "leases"]
    assert world.api.count("create", "pods") == 200 + 1
    assert len(ours) <= 1.2 * 200


@played()
async def test_creation_begins_with_one_and_doubles(world: World) -> None:
    world.make_pool(replicas=1)
    await world.ready(1)
    at: list[float] = []
    clock = asyncio.get_running_loop().time

    def note(call: Call) -> None:
        if call.verb == "create" and call.plural == "pods":
            at.append(clock())

    world.api.after = note
    fault = world.slow("create", "pods", 0.1)
    world.edit(replicas=1 + 31)
    await world.ready(32)
    fault.times = 0
    batches = [at.count(moment) for moment in dict.fromkeys(at)]
    assert batches == [1, 2, 4, 8, 16]


@played()
async def test_a_change_of_a_pool_lists_no_pods(world: World) -> None:
    world.make_pool(replicas=1)
    await world.ready(1)
    lists = world.api.count("list", "pods")
    world.edit(replicas=50)
    await world.ready(50)
    world.edit(replicas=20)
    await world.ready(20)
    assert world.api.count("list", "pods") == lists


@played()
async def test_creation_goes_on_while_the_status_is_written(world: World) -> None:
    world.make_pool(replicas=1)
    await world.ready(1)
    at: list[float] = []
    clock = asyncio.get_running_loop().time

    def note(call: Call) -> None:
        if (call.verb, call.plural) == ("create", "pods"):
            at.append(clock())

    world.api.after = note
    statuses = world.api.count("patch", "fiberpools")
    world.slow("patch", "fiberpools", 2.0)
    world.slow("create", "pods", 0.25)
    world.edit(replicas=1 + 100, scaleUp={"maxInFlight": 4})
    await world.ready(101)
    assert max(late - early for early, late in itertools.pairwise(at)) < 0.3
    assert world.api.count("patch", "fiberpools") > statuses + 2
    assert len(world.created()) == 101


@played()
async def test_no_more_at_once_than_asked_for(world: World) -> None:
    world.make_pool(replicas=20, scaleUp={"maxInFlight": 3})
    await world.ready(20)
    under_way = most = 0

    def begin(plural: str, body: Body) -> None:
        nonlocal under_way, most
        under_way += plural == "pods"
        most = max(most, under_way)

    def end(call: Call) -> None:
        nonlocal under_way
        under_way -= call.verb == "create" and call.plural == "pods"

    world.store.admit, world.api.after = begin, end
    world.edit(replicas=40)
    await world.ready(40)
    assert most <= 3


@played()
async def test_a_full_quota_is_reported_without_a_storm_of_calls(world: World) -> None:
    def quota(plural: str, body: Body) -> None:
        if plural == "pods" and len(world.pods()) >= 3:
            message = 'pods "es" is forbidden: exceeded quota: pods, requested: pods=1'
            raise Failure(403, "Forbidden", message)

    world.store.admit = quota
    world.make_pool(replicas=50)
    told = await world.until(lambda: "QuotaExceeded" in world.reasons())
    assert told < 2
    await world.settled(60)
    assert len(world.pods()) == 3
    assert world.api.count("create", "pods") < 20
    world.store.admit = lambda plural, body: None
    await world.ready(50)
    assert world.reasons() == []


@played()
async def test_an_invalid_template_makes_no_pod(world: World) -> None:
    def validate(plural: str, body: Body) -> None:
        if plural == "pods" and "image" not in body["spec"]["containers"][0]:
            message = "Pod is invalid: spec.containers[0].image: Required value"
            raise Failure(422, "Invalid", message)

    world.store.admit = validate
    world.make_pool(replicas=50, template={"spec": {"containers": [{"name": "worker"}]}})
    assert await world.until(lambda: "InvalidTemplate" in world.reasons()) < 2
    await world.settled(60)
    assert {
        call.dry_run for call in world.api.calls if call.plural == "pods" and call.verb == "create"
    } == {True}
    world.edit(template=TEMPLATE)
    await world.ready(50)


@played()
async def test_a_template_gets_one_dry_run(world: World) -> None:
    world.make_pool(replicas=3)
    await world.ready(3)
    world.edit(replicas=9)
    await world.ready(9)
    assert sum(call.dry_run for call in world.api.calls) == 1


@played()
async def test_the_status_keeps_up_with_a_long_deletion(world: World) -> None:
    world.make_pool(replicas=400)
    await world.ready(400)
    world.slow("delete", "pods", 0.2)
    world.edit(suspend=True)
    told = set()
    while world.pods():
        await asyncio.sleep(0.5)
        told.add(world.status()["replicas"])
    assert len(told) > 2
    await world.ready(0)
    assert world.api.count("delete", "pods") == 400


@played()
async def test_a_pod_that_became_ready_meanwhile_stays(world: World) -> None:
    """Keep a pod that the watch still shows as Pending, and that the master has now."""
    world.make_pool(replicas=3, master=MASTER)
    await world.ready(3)
    world.kubelet.auto = False
    world.edit(replicas=4)
    await world.until(lambda: len(world.pods()) == 4)
    (pending,) = [
        pod["metadata"]["name"] for pod in world.pods() if pod["status"]["phase"] == "Pending"
    ]
    await world.settled()
    world.api.watch_delay = 5.0
    world.kubelet.ready(NAMESPACE, pending)
    world.edit(replicas=3)
    await world.settled(60)
    assert pending in world.names()
    assert world.api.count("delete", "pods") < 20, "one in half a second, until the watch shows it"
    assert world.status()["readyReplicas"] == 4


@played()
async def test_a_new_master_is_dialled_within_a_second(world: World) -> None:
    def leads_to() -> tuple[Any, ...]:
        (slice_,) = world.store.list("endpointslices")
        return slice_["addressType"], slice_["endpoints"], slice_["ports"]

    world.make_pool(replicas=3)
    await world.ready(3)
    assert leads_to()[1:] == ([], [])
    for epoch, (family, host, port) in enumerate(
        [
            ("IPv4", "10.0.3.7", 1),
            ("IPv4", "10.0.3.8", 2),
            ("IPv6", "fd00::7", 3),
            ("IPv4", "10.0.3.7", 4),
        ],
        1,
    ):
        await world.settled(3)
        world.edit(master={**MASTER, "host": host, "port": port, "epoch": epoch})
        took = await world.until(
            lambda f=family, h=host, p=port: (
                len(world.store.list("endpointslices")) == 1  # type: ignore[misc]
                and leads_to()[0] == f
                and [e["addresses"] for e in leads_to()[1]] == [[h]]
                and [entry["port"] for entry in leads_to()[2]] == [p]
            )
        )
        assert took < 1.0
    assert len(world.created()) == 3


@played()
async def test_deleted_dependents_are_created_again(world: World) -> None:
    world.make_pool(replicas=2, master=MASTER)
    await world.ready(2)
    for plural in ("services", "secrets", "endpointslices"):
        name = world.store.list(plural)[0]["metadata"]["name"]
        world.store.delete(plural, NAMESPACE, name)
        await world.until(lambda p=plural: len(world.store.list(p)) == 1, within=125)  # type: ignore[misc]
    assert len(world.created()) == 2


@played()
async def test_a_service_that_was_changed_is_mended(world: World) -> None:
    world.make_pool(replicas=1)
    await world.ready(1)
    spec = {"selector": {"app": "mine"}, "ports": [{"port": 1}]}
    world.store.merge("services", NAMESPACE, "es-fiber", {"spec": spec})
    await world.until(
        lambda: "selector" not in world.store.get("services", NAMESPACE, "es-fiber")["spec"], 125
    )
    assert world.store.get("services", NAMESPACE, "es-fiber")["spec"]["ports"][0]["port"] == 7070


@pytest.mark.parametrize("plural", ["services", "secrets", "endpointslices"])
def test_an_object_of_another_owner_is_not_touched(plural: str) -> None:
    @played()
    async def test(world: World) -> None:
        name = "es-fiber-key" if plural == "secrets" else "es-fiber"
        theirs = world.store.create(plural, NAMESPACE, {"metadata": {"name": name}, "data": {}})
        world.make_pool(replicas=2)
        assert await world.until(lambda: "NameTaken" in world.reasons()) < 2
        problem = world.status()["problems"][0]
        assert problem["terminal"]
        assert name in problem["message"]
        secret = None if plural == "secrets" else "es-fiber-key"
        assert world.status().get("credentialsSecret") == secret
        await world.settled(120)
        assert world.store.get(plural, NAMESPACE, name) == theirs
        assert world.pods() == []
        world.store.delete(plural, NAMESPACE, name)
        await world.ready(2)
        assert world.reasons() == []

    test()


@played()
async def test_a_recreated_pool_waits_for_the_remains_of_the_old_one(world: World) -> None:
    world.make_pool(replicas=2)
    await world.ready(2)
    old = world.store.get("fiberpools", NAMESPACE, "es")["metadata"]["uid"]
    world.store.collects_garbage = False
    world.store.delete("fiberpools", NAMESPACE, "es")
    world.make_pool(replicas=2)
    await world.until(lambda: "NameTaken" in world.reasons())
    assert not world.status()["problems"][0]["terminal"]
    await world.settled(20)
    assert len(world.created()) == 2
    world.store.collect_garbage(old)
    await world.ready(2)
    assert len(world.created()) == 4


@played()
async def test_damaged_credentials_are_reported(world: World) -> None:
    world.make_pool(replicas=1)
    await world.ready(1)
    world.store.merge("secrets", NAMESPACE, "es-fiber-key", {"data": {"key": "bm9uc2Vuc2U="}})
    await world.until(lambda: "InvalidCredentials" in world.reasons(), 125)
    assert "Delete it" in world.status()["problems"][0]["message"]
    assert world.status().get("credentialsSecret") is None
    world.store.delete("secrets", NAMESPACE, "es-fiber-key")
    await world.until(lambda: world.reasons() == [], 125)


@pytest.mark.parametrize(
    "spec",
    [
        {},
        {"template": "text"},
        {"template": TEMPLATE, "replicas": "three"},
        {"template": TEMPLATE, "minReplicas": 9, "maxReplicas": 3},
        {"template": {"spec": {"containers": []}}},
    ],
)
def test_an_invalid_spec_deletes_no_pod(spec: Body) -> None:
    """Use a pool of an older or newer schema, as this one refuses it."""

    @played()
    async def test(world: World) -> None:
        world.make_pool(replicas=3)
        await world.ready(3)
        nothing = dict.fromkeys(("template", "replicas"))
        world.edit(**{**nothing, **spec})
        assert await world.until(lambda: world.reasons() == ["InvalidSpec"]) < 2
        await world.settled(300)
        assert world.api.count("delete", "pods") == 0
        assert world.status()["readyReplicas"] == 3
        world.edit(template=TEMPLATE, replicas=4, minReplicas=0, maxReplicas=9)
        await world.ready(4)

    test()


@played()
async def test_changes_without_an_event_are_found_within_a_minute(world: World) -> None:
    world.make_pool(replicas=3)
    await world.ready(3)
    world.deaf = True
    world.kubelet.evict(NAMESPACE, world.names()[0])
    assert await world.until(lambda: world.status()["failures"]["disrupted"] == 1) < 65
    world.make_pool("second", replicas=2)
    assert await world.until(lambda: len(world.created()) == 4 + 2) < 65
    assert await world.ready(2, "second") < 65
    world.store.delete("fiberpools", NAMESPACE, "second")
    await world.settled(65)
    assert [key.name for key in world.program.queue.known()] == ["es"]


@played()
async def test_a_spec_of_too_many_values_is_not_read_and_the_pool_says_so(world: World) -> None:
    """A million empty objects fit into a FiberPool and take gigabytes."""
    world.make_pool(replicas=2)
    await world.ready(2)
    spec = {**TEMPLATE["spec"], "x": [{}] * (responses.MOST_VALUES + 1)}
    world.edit(template={"spec": spec}, replicas=5)
    await world.until(lambda: "InvalidSpec" in world.reasons())
    (problem,) = world.status()["problems"]
    assert f"more than {responses.MOST_VALUES} values" in problem["message"]
    assert len(world.pods()) == 2
    await world.settled(600)
    statuses = world.api.count("patch", "fiberpools")
    await world.settled(600)
    assert world.api.count("patch", "fiberpools") == statuses, "it is said once"
    world.edit(template={"spec": {**TEMPLATE["spec"], "x": None}})
    await world.ready(5)
    assert world.reasons() == []


@played()
async def test_a_long_text_of_comma_separated_values_is_one_value(world: World) -> None:
    world.make_pool(replicas=1)
    await world.ready(1)
    (container,) = TEMPLATE["spec"]["containers"]
    other: Body = {**container, "args": ['a,b\\"[{' * responses.MOST_VALUES]}
    world.edit(template={"spec": {"containers": [other]}}, replicas=3)
    await world.ready(3)
    assert world.reasons() == []


@played()
async def test_deletions_that_are_refused_are_tried_again_ever_later(world: World) -> None:
    """The watch is behind, so the operator knows older versions of the pods."""
    world.kubelet.auto = False
    world.make_pool(replicas=2, master=MASTER)
    await world.until(lambda: len(world.names()) == 2)
    await world.settled(10)
    world.api.watch_delay = 200
    for name in world.names():
        world.store.merge("pods", NAMESPACE, name, {"metadata": {"annotations": {"a": "b"}}})
    world.edit(replicas=0)
    assert await world.until(lambda: world.api.count("delete", "pods") > 0) < 65
    await asyncio.sleep(60)
    assert world.api.count("delete", "pods") <= 2 * 8
    await world.until(lambda: not world.names())


@played()
async def test_a_deleted_pool_leaves_no_object(world: World) -> None:
    world.make_pool(replicas=3, master={**MASTER, "leaseName": "es"})
    await world.ready(3)
    world.store.delete("fiberpools", NAMESPACE, "es")
    await world.settled()
    assert world.pods() == []
    assert world.program.queue.known() == []
    assert world.program.metrics.pools == {}
    world.api.calls.clear()
    await world.settled(50)
    assert [call for call in world.api.calls if call.namespace == NAMESPACE] == []


@played()
async def test_a_pool_that_is_being_deleted_gets_no_pods(world: World) -> None:
    world.make_pool(replicas=3)
    await world.ready(3)
    stamp = {"deletionTimestamp": world.store.now(), "finalizers": ["someone/else"]}
    world.store.merge("fiberpools", NAMESPACE, "es", {"metadata": stamp})
    for name in world.names():
        world.store.remove("pods", NAMESPACE, name)
    await world.settled(120)
    assert world.pods() == []


@played(namespaces=("one", "two"))
async def test_other_namespaces_are_not_looked_at(world: World) -> None:
    for namespace in ("one", "two", "three"):
        world.make_pool(namespace=namespace, replicas=1)
    await world.until(lambda: len(world.created()) == 2)
    await world.settled(120)
    asked = {call.namespace for call in world.api.calls}
    assert asked == {"one", "two", "fiber-system"}


@played()
async def test_many_pools_are_served_side_by_side(world: World) -> None:
    for number in range(20):
        world.make_pool(f"pool-{number}", replicas=3)
    for number in range(20):
        await world.ready(3, f"pool-{number}", within=30)
    assert len(world.created()) == 60


@played()
async def test_the_status_has_the_warning_event_of_a_pod_that_does_not_start(world: World) -> None:
    world.kubelet.auto = False
    world.make_pool(replicas=1)
    await world.until(lambda: len(world.pods()) == 1)
    (pod,) = world.pods()
    world.kubelet.waiting(NAMESPACE, pod["metadata"]["name"], "ContainerCreating")
    about = {"involvedObject": {"uid": pod["metadata"]["uid"]}, "type": "Warning"}
    for second, secret in enumerate(("first", "last")):
        said = {"reason": "FailedMount", "message": f'secret "{secret}" not found'}
        stamp = {"lastTimestamp": f"2026-01-01T00:00:0{second}Z"}
        event = {"metadata": {"name": secret}, **about, **said, **stamp}
        world.store.create("events", NAMESPACE, event)
    await world.until(lambda: 'secret "last" not found' in str(world.status()), 60)
    await world.settled(60)
    assert world.api.count("list", "events") < 20


@played()
async def test_events_show_the_operators_actions(world: World) -> None:
    world.make_pool(replicas=3)
    await world.ready(3)
    world.kubelet.exit(NAMESPACE, world.names()[0], 3)
    await world.until(lambda: len(world.created()) == 4)
    found = {(event["type"], event["reason"]) for event in world.store.list("events")}
    assert ("Normal", "ScaledUp") in found
    assert ("Warning", "ContainerFailed") in found
    for event in world.store.list("events"):
        assert event["involvedObject"]["kind"] == "FiberPool"
        assert event["involvedObject"]["name"] == "es"
        assert event["message"]


def test_output_of_workers_is_not_in_the_operators_log(caplog: pytest.LogCaptureFixture) -> None:
    @played()
    async def test(world: World) -> None:
        world.make_pool(replicas=3)
        await world.ready(3)
        world.kubelet.exit(NAMESPACE, world.names()[0], 3)
        await world.until(lambda: "last words" in str(world.status()))
        await world.settled()

    with caplog.at_level("DEBUG", "fiber_operator"):
        test()
    assert "exited with code 3" in caplog.text
    assert "last words" not in caplog.text
