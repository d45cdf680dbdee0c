"""The life of a relay, from the request to its removal, with an operator in a fake cluster."""

from __future__ import annotations

from typing import Any

import pytest

from fakes import virtual_time
from fakes.kubernetes_api import Call, Fault
from fakes.store import Body, Failure
from fakes.world import NAMESPACE, TEMPLATE, World, a_world, played
from fiber_api import names
from fiber_api.names import Reason
from fiber_operator.dependents import CHECK_INTERVAL
from fiber_operator.planning import messages, relay
from unit.operator_objects import MASTER

RELAY = "es-fiber-relay"
LATER = CHECK_INTERVAL + 30
"""Seconds until the operator has checked the objects of a pool again."""
NEW = {"spec": {"containers": [{"name": "worker", "image": "registry/worker:2"}]}}
BROKEN = {"spec": {"containers": [{"name": "worker", "image": "registry/broken:1"}]}}


def relays(world: World) -> list[Body]:
    return world.store.list("deployments", NAMESPACE)


def images(world: World) -> list[str]:
    """Return the image of each relay."""
    specs = [body["spec"]["template"]["spec"] for body in relays(world)]
    return [spec["containers"][0]["image"] for spec in specs]


def selector(world: World) -> dict[str, str] | None:
    found: Body = world.store.get("services", NAMESPACE, "es-fiber")["spec"]
    return found.get("selector")


def led_to(world: World) -> list[str]:
    """Return the addresses in the pool's EndpointSlice."""
    (found,) = world.store.list("endpointslices", NAMESPACE)
    return [address for one in found["endpoints"] for address in one["addresses"]]


def uid(world: World) -> str:
    return str(world.store.get("fiberpools", NAMESPACE, "es")["metadata"]["uid"])


def leads_to_the_relay(world: World) -> bool:
    selects = selector(world) == {names.LABEL_RELAY: uid(world)}
    return selects and led_to(world) == [] and world.status().get("relay") == RELAY


def leads_to_the_master(world: World) -> bool:
    return relays(world) == [] and led_to(world) == ["10.0.3.7"] and "relay" not in world.status()


def events(world: World) -> list[str]:
    """Return the messages of events about relays."""
    reasons = ("RelayStarted", "RelayRemoved")
    return [e["message"] for e in world.store.list("events") if e["reason"] in reasons]


def calls(world: World) -> list[tuple[str, str]]:
    """Return the calls about objects beside workers that changed something."""
    plurals = ("deployments", "services", "endpointslices")
    found = [call for call in world.api.calls if call.plural in plurals]
    return [(call.verb, call.plural) for call in found if call.verb != "get"]


async def a_relayed_pool(world: World, **spec: Any) -> None:
    world.make_pool(replicas=2, master=MASTER, relay=True, **spec)
    await world.ready(2)


# -- From the request to the removal


@played
async def test_a_relay_comes_and_goes_with_its_field(world: World) -> None:
    world.make_pool(replicas=2, master=MASTER)
    await world.ready(2)
    assert leads_to_the_master(world)
    assert selector(world) is None
    world.edit(relay=True)
    await world.until(lambda: leads_to_the_relay(world), within=5)
    assert world.status()["master"] == "10.0.3.7:41337"
    started = "Workers dial the relay es-fiber-relay, since pods cannot reach the master"
    await world.until(lambda: events(world) == [started])
    world.edit(relay=False)
    await world.until(lambda: leads_to_the_master(world), within=5)
    removed = "The relay es-fiber-relay was removed"
    await world.until(lambda: sorted(events(world)) == [removed, started])
    await world.settled(3 * LATER)
    assert leads_to_the_master(world)
    assert len(events(world)) == 2
    assert selector(world) is not None, "else Kubernetes would not remove the address of the pod"
    world.edit(relay=True)
    await world.until(lambda: leads_to_the_relay(world), within=5)
    assert len(world.created()) == 2, "no worker was replaced"


@played
async def test_a_pool_that_is_made_with_a_relay_costs_one_object_more(world: World) -> None:
    await a_relayed_pool(world)
    assert leads_to_the_relay(world)
    made = ["deployments", "endpointslices", "services"]
    assert sorted(calls(world)) == [("create", plural) for plural in made]
    # Its pod may be refused, so it is read once soon after it was made.
    assert world.api.count("get", "deployments") == 1
    world.api.calls.clear()
    await world.settled(3 * LATER)
    assert calls(world) == []
    assert world.api.count("get", "deployments") == world.api.count("get", "services")


@played
async def test_a_pool_without_a_relay_costs_no_call_for_one(world: World) -> None:
    world.make_pool(replicas=2, master=MASTER)
    await world.ready(2)
    world.edit(master={**MASTER, "epoch": 2, "port": 2})
    await world.settled(3 * LATER)
    await world.stop()
    world.start()
    await world.settled(3 * LATER)
    assert [call for call in world.api.calls if call.plural == "deployments"] == []


@played
async def test_a_new_master_behind_the_relay_changes_the_slice_alone(world: World) -> None:
    await a_relayed_pool(world)
    world.api.calls.clear()
    world.edit(master={**MASTER, "epoch": 2, "port": 2})
    await world.until(lambda: world.status().get("masterEpoch") == 2)
    assert led_to(world) == []
    assert {plural for _, plural in calls(world)} <= {"endpointslices"}
    assert world.api.count("get", "deployments") == 0
    told = "Workers dial the master at 10.0.3.7:2, epoch 2 through a relay"
    await world.until(lambda: told in [e["message"] for e in world.store.list("events")])


@played
async def test_a_master_without_a_relay_takes_over(world: World) -> None:
    await a_relayed_pool(world)
    world.edit(master={**MASTER, "epoch": 2}, relay=False)
    await world.until(lambda: leads_to_the_master(world), within=5)


@played
async def test_a_master_of_another_family_than_the_service_uses_a_relay(world: World) -> None:
    await a_relayed_pool(world)
    world.edit(master={**MASTER, "epoch": 2, "host": "fd00::7"})
    await world.until(lambda: world.status().get("masterEpoch") == 2)
    await world.settled(LATER)
    assert world.reasons() == []
    before = world.store.get("services", NAMESPACE, "es-fiber")["spec"]["clusterIP"]
    world.store.remove("services", NAMESPACE, "es-fiber")
    await world.settled(LATER)
    assert world.store.get("services", NAMESPACE, "es-fiber")["spec"]["clusterIP"] == before


# -- The relay and the workers


@played
async def test_the_pod_of_a_relay_is_no_worker(world: World) -> None:
    await a_relayed_pool(world)
    (body,) = relays(world)
    made = body["spec"]["template"]
    pod = {**made, "metadata": {**made["metadata"], "name": f"{RELAY}-5f-x7"}}
    world.api.calls.clear()
    world.store.create("pods", NAMESPACE, pod)
    await world.settled(LATER)
    status = world.status()
    assert (status["replicas"], status["readyReplicas"]) == (2, 2)
    assert world.api.count("delete", "pods") == world.api.count("create", "pods") == 0
    world.edit(replicas=0, master=None)
    await world.ready(0)
    assert world.names() == [f"{RELAY}-5f-x7"]


def test_a_suspended_pool_has_a_relay_until_its_workers_have_ended() -> None:
    async def main() -> None:
        async with a_world() as world:
            world.let_pods_linger(20)
            await a_relayed_pool(world)
            world.edit(suspend=True)
            await world.until(lambda: world.status().get("terminatingReplicas") == 2)
            assert relays(world) != []
            await world.until(lambda: relays(world) == [], within=200)
            assert world.pods() == []
            await world.until(lambda: "relay" not in world.status())
            world.edit(suspend=False)
            await world.ready(2)
            assert leads_to_the_relay(world)

    virtual_time.run(main())


@played
async def test_a_deleted_pool_takes_its_relay_along(world: World) -> None:
    await a_relayed_pool(world)
    world.store.delete("fiberpools", NAMESPACE, "es")
    assert relays(world) == []
    await world.settled(LATER)
    assert relays(world) == []


@played
async def test_a_pool_whose_master_is_lost_takes_its_relay_along(world: World) -> None:
    world.store.create("leases", NAMESPACE, {"metadata": {"name": "es"}})
    lost = {**MASTER, "leaseName": "es", "leaseDurationSeconds": 6, "lostGraceSeconds": 5}
    world.make_pool(replicas=2, master=lost, relay=True, onLost="Delete")
    await world.until(lambda: len(relays(world)) == 1)
    await world.until(lambda: world.store.list("fiberpools") == [])
    assert relays(world) == []


# -- A changed template


@played
async def test_the_relay_follows_a_template_that_works(world: World) -> None:
    await a_relayed_pool(world)
    world.edit(template=NEW, update={"strategy": "Recreate"})
    await world.until(lambda: world.status().get("updatedReplicas") == 2)
    await world.until(lambda: images(world) == ["registry/worker:2"], within=LATER)
    assert world.status()["relay"] == RELAY
    assert len(events(world)) == 1


@played
async def test_a_template_that_fails_does_not_cut_off_the_workers(world: World) -> None:
    await a_relayed_pool(world)
    (before,) = relays(world)
    world.kubelet.auto = False
    world.edit(template=BROKEN)
    await world.settled(3 * LATER)
    (after,) = relays(world)
    assert after["metadata"]["uid"] == before["metadata"]["uid"]


@played
async def test_a_relay_that_never_worked_follows_each_template(world: World) -> None:
    world.kubelet.auto = False
    world.make_pool(replicas=2, master=MASTER, relay=True, template=BROKEN)
    await world.until(lambda: images(world) == ["registry/broken:1"])
    world.edit(template=TEMPLATE)
    await world.until(lambda: images(world) == ["registry/worker:1"], within=LATER)


@played
async def test_a_refused_template_is_named_as_the_cause(world: World) -> None:
    def admit(plural: str, body: Body) -> None:
        if plural == "deployments" and "broken" in str(body["spec"]):
            raise Failure(422, "Invalid", "spec.template.spec.x: Invalid value")

    world.store.admit = admit
    world.make_pool(replicas=2, master=MASTER, relay=True, template=BROKEN)
    await world.until(lambda: "InvalidTemplate" in world.reasons())
    message = world.status()["problems"][0]["message"]
    assert "refuses the Deployment es-fiber-relay of the pool's relay" in message
    assert "spec.template.spec.x: Invalid value" in message
    assert "relay" not in world.status()
    world.edit(template=TEMPLATE)
    await world.ready(2)
    assert leads_to_the_relay(world)
    assert world.reasons() == []


# -- Others' hands


@pytest.mark.parametrize("replicas", [0, 2])
def test_a_relay_that_somebody_scaled_is_made_anew(replicas: int) -> None:
    @played
    async def test(world: World) -> None:
        await a_relayed_pool(world)
        world.store.merge("deployments", NAMESPACE, RELAY, {"spec": {"replicas": replicas}})
        await world.until(
            lambda: [body["spec"]["replicas"] for body in relays(world)] == [1], within=LATER
        )

    test()


@played
async def test_a_deleted_relay_comes_back(world: World) -> None:
    await a_relayed_pool(world)
    world.store.remove("deployments", NAMESPACE, RELAY)
    await world.until(lambda: len(relays(world)) == 1, within=LATER)
    assert len(events(world)) == 1


@played
async def test_a_deleted_service_comes_back_with_its_address_and_selector(world: World) -> None:
    await a_relayed_pool(world)
    before = world.store.get("services", NAMESPACE, "es-fiber")["spec"]
    world.store.remove("services", NAMESPACE, "es-fiber")
    await world.settled(LATER)
    assert (
        world.store.get("services", NAMESPACE, "es-fiber")["spec"]["clusterIP"]
        == (before["clusterIP"])
    )
    assert leads_to_the_relay(world)
    assert len(world.created()) == 2


@pytest.mark.parametrize("relay", [False, True])
def test_a_foreign_selector_is_replaced_as_a_whole(relay: bool) -> None:
    @played
    async def test(world: World) -> None:
        world.make_pool(replicas=1, master=MASTER, relay=relay)
        await world.ready(1)
        foreign = {"spec": {"selector": {"app": "x"}}}
        world.store.merge("services", NAMESPACE, "es-fiber", foreign)
        wanted = {names.LABEL_RELAY: uid(world)} if relay else None
        await world.until(lambda: selector(world) == wanted, within=LATER)
        world.api.calls.clear()
        await world.settled(2 * LATER)
        assert world.api.count("patch", "services") == 0

    test()


@played
async def test_a_deployment_of_another_owner_is_left_alone(world: World) -> None:
    foreign = {"metadata": {"name": RELAY}, "spec": {"replicas": 7}}
    world.store.create("deployments", NAMESPACE, foreign)
    world.make_pool(replicas=2, master=MASTER, relay=True)
    await world.until(lambda: "NameTaken" in world.reasons())
    assert "there is a Deployment es-fiber-relay that" in world.status()["problems"][0]["message"]
    assert world.pods() == []
    assert "relay" not in world.status()
    assert events(world) == []
    world.edit(relay=False)
    await world.ready(2)
    assert world.reasons() == []
    assert [body["spec"]["replicas"] for body in relays(world)] == [7]


# -- Failures and restarts


@played
async def test_a_relay_of_unknown_state_is_checked_again(world: World) -> None:
    world.make_pool(replicas=2, master=MASTER)
    await world.ready(2)
    failing = Fault("create", "deployments", status=500, times=10**6)
    world.api.faults.append(failing)
    world.edit(relay=True)
    await world.until(lambda: world.reasons() == ["ApiUnavailable"])
    assert "relay" not in world.status()
    failing.times = 0
    await world.until(lambda: leads_to_the_relay(world), within=60)
    await world.until(lambda: world.reasons() == [])
    failing.verb, failing.times = "delete", 10**6
    world.edit(relay=False)
    await world.until(lambda: world.reasons() == ["ApiUnavailable"])
    assert world.status()["relay"] == RELAY, "it is still there"
    failing.times = 0
    await world.until(lambda: leads_to_the_master(world), within=60)
    await world.until(lambda: len(events(world)) == 2)


@played
async def test_a_relay_that_may_not_be_read_is_not_taken_for_removed(world: World) -> None:
    await a_relayed_pool(world)
    without = Fault("get", "deployments", status=403, reason="Forbidden", times=10**6)
    world.api.faults.append(without)
    world.edit(relay=False)
    await world.until(lambda: world.reasons() == ["Forbidden"])
    assert world.status()["relay"] == RELAY
    without.times = 0
    await world.until(lambda: leads_to_the_master(world), within=60)


@played
async def test_a_relay_that_was_made_without_an_answer_is_taken(world: World) -> None:
    world.make_pool(replicas=2, master=MASTER)
    await world.ready(2)
    world.api.faults.append(Fault("create", "deployments", carried_out=True))
    world.edit(relay=True)
    await world.until(lambda: leads_to_the_relay(world), within=60)
    assert len(relays(world)) == 1


@played
async def test_an_operator_removes_the_relay_that_an_earlier_one_made(world: World) -> None:
    await a_relayed_pool(world)
    await world.stop()
    world.edit(relay=False)
    world.start()
    await world.until(lambda: leads_to_the_master(world), within=30)


def test_an_operator_finds_a_relay_that_no_status_names() -> None:
    """The earlier one ended between the relay's making and its note in the status."""

    async def main() -> None:
        async with a_world() as world:
            world.make_pool(replicas=2, master=MASTER)
            await world.ready(2)

            def end(call: Call) -> None:
                both = relays(world) and selector(world)
                if both and not world.dead:
                    world.api.down = True
                    world.crash()

            world.api.after = end
            world.edit(relay=True)
            await world.run_out_or(lambda: world.api.down, lambda w: w.settled(60))
            await world.kill()
            world.api.after = lambda call: None
            world.api.down = False
            assert "relay" not in world.status()
            world.edit(relay=False)
            world.start()
            await world.until(lambda: leads_to_the_master(world), within=30)

    virtual_time.run(main())


# -- Pods that the API server refuses

QUOTA = (
    f'pods "{RELAY}-7c9f-x2" is forbidden: exceeded quota: team, requested: pods=1, used: pods=9, '
    "limited: pods=9"
)


def refuse(world: World, words: str = "") -> None:
    """Give the Deployment the status that the cluster writes; without words its pod is made."""
    generation = relays(world)[0]["metadata"]["generation"]
    failure = {"type": "ReplicaFailure", "status": "True", "reason": "FailedCreate"}
    conditions = [{**failure, "message": words}] if words else []
    status = {"observedGeneration": generation, "conditions": conditions}
    world.store.set_status("deployments", NAMESPACE, RELAY, status)


def warnings(world: World) -> list[str]:
    return [e["reason"] for e in world.store.list("events") if e["type"] == "Warning"]


@played
async def test_a_relay_whose_pod_is_refused_is_a_problem_soon(world: World) -> None:
    world.make_pool(replicas=2, master=MASTER)
    await world.ready(2)
    world.edit(relay=True, replicas=3)
    await world.until(lambda: len(relays(world)) == 1)
    refuse(world, QUOTA)
    await world.until(lambda: world.reasons() == ["QuotaExceeded"], within=10)
    (problem,) = world.status()["problems"]
    assert problem["message"] == (
        f"A quota of the namespace leaves no room for the pod of the relay {RELAY}: exceeded "
        "quota: team, requested: pods=1, used: pods=9, limited: pods=9. Delete objects that are "
        "not needed, lower replicas, or raise the ResourceQuota. Kubernetes tries again by "
        "itself. Running workers go on; no new ones are created until the relay has its pod."
    )
    assert (problem["severity"], problem["terminal"]) == ("Error", False)
    await world.until(lambda: warnings(world) == ["QuotaExceeded"])
    refuse(world)
    await world.until(lambda: world.reasons() == [], within=10)
    assert leads_to_the_relay(world)


@played
async def test_a_relay_that_loses_its_pod_and_gets_no_other_is_a_problem(world: World) -> None:
    await a_relayed_pool(world)
    refuse(world)
    await world.settled(LATER)
    assert world.reasons() == []
    refuse(world, QUOTA)
    await world.until(lambda: world.reasons() == ["QuotaExceeded"], within=LATER)
    assert world.status()["relay"] == RELAY
    world.edit(replicas=3)
    await world.settled(LATER)
    assert len(world.created()) == 2
    refuse(world)
    await world.ready(3)
    assert world.reasons() == []


@pytest.mark.parametrize(
    ("words", "reason", "message", "terminal"),
    [
        (
            'pods "a" is forbidden: failed quota: team: must specify limits.cpu for: relay',
            Reason.REQUESTS_MISSING,
            "counts resources that the pod of the relay r does not request: failed quota: team",
            True,
        ),
        (
            'pods "a" is forbidden: violates PodSecurity "restricted:latest": runAsNonRoot',
            Reason.FORBIDDEN,
            'forbids the pod of the relay r: violates PodSecurity "restricted:latest"',
            True,
        ),
        (
            'admission webhook "no.example" denied the request: not here',
            Reason.FORBIDDEN,
            "not here. Correct the cause that it names",
            True,
        ),
        (
            'pods "a" is forbidden: error looking up service account team/x: serviceaccount "x" '
            "not found",
            Reason.FORBIDDEN,
            "error looking up service account",
            False,
        ),
        (
            'Pod "a" is invalid: spec.x: Invalid value',
            Reason.INVALID_TEMPLATE,
            "refuses the pod of the relay r: spec.x: Invalid value. The pod is made from",
            True,
        ),
        (
            'Internal error occurred: failed calling webhook "w"',
            Reason.API_UNAVAILABLE,
            "does not create the pod of the relay r: Internal error occurred: failed calling",
            False,
        ),
    ],
)
def test_the_refusal_of_a_relays_pod_has_the_reason_of_a_workers(
    words: str, reason: Reason, message: str, terminal: bool
) -> None:
    found = messages.refused_relay_pod(words, "r")
    assert (found.reason, found.terminal) == (reason, terminal)
    assert message in found.message
    assert found.message.endswith(".")


@pytest.mark.parametrize("value", [None, True, 1, "x", [None], [{}], [{"type": []}], {"a": 1}])
def test_a_malformed_status_of_a_relay_does_not_raise(value: object) -> None:
    for status in (value, {"conditions": value, "observedGeneration": value}):
        assert relay.refusal({"status": status}) == ""
        assert not relay.is_observed({"status": status, "metadata": {"generation": 3}})
