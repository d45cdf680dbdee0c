"""Each failed call of the operator can be read where people look: in the pool's status."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from fakes.kubernetes_api import Fault
from fakes.store import Body
from fakes.world import NAMESPACE, World, played
from fiber_operator.planning.problems import SECOND_LOOK
from unit.operator_objects import MASTER

LOST = {**MASTER, "leaseName": "es", "leaseDurationSeconds": 6, "lostGraceSeconds": 5}
FOR_EVER = 10**6
RULES = (
    Path(__file__).parents[2] / "charts" / "fiber-operator" / "templates" / "_rules.tpl"
).read_text()

Right = tuple[str, str]


def rights() -> list[Right]:
    """Return the rights of the operator's chart in the namespaces of pools."""
    text = RULES[RULES.index("\npools:") : RULES.index("\nown:")]
    rules = yaml.safe_load(text)["pools"]
    return [(v, plural) for rule in rules for plural in rule["resources"] for v in rule["verbs"]]


def fault(right: Right, **what: Any) -> Fault:
    verb, plural = right
    return Fault(verb, plural.partition("/")[0], times=FOR_EVER, **what)


def denied(right: Right) -> Fault:
    verb, plural = right
    message = f'User "operator" cannot {verb} resource "{plural}"'
    return fault(right, status=403, reason="Forbidden", message=message)


# -- Rights: a pool's events that need each right


async def is_new(world: World) -> None:
    world.make_pool(replicas=2)


async def releases(world: World) -> None:
    world.edit(replicas=1, scaleDown={"release": world.names()[:1]})


async def has_its_service_changed(world: World) -> None:
    world.store.merge("services", NAMESPACE, "es-fiber", {"spec": {"selector": {"app": "x"}}})


async def gets_another_master(world: World) -> None:
    world.edit(master={**MASTER, "epoch": 2, "port": 2})


async def gets_a_master_of_another_family(world: World) -> None:
    world.edit(master={**MASTER, "epoch": 2, "host": "fd00::7"})


async def loses_its_master(world: World) -> None:
    world.store.create(
        "leases", NAMESPACE, {"metadata": {"name": "es"}}
    )  # the Lease is not renewed
    world.edit(master=LOST, onLost="Delete")


async def gets_a_budget(world: World) -> None:
    world.edit(minReplicas=3, minAvailable=1)


async def changes_its_budget(world: World) -> None:
    await gets_a_budget(world)
    await world.until(lambda: world.store.list("poddisruptionbudgets") != [], within=60)
    world.edit(minAvailable=2)


async def gives_up_its_budget(world: World) -> None:
    await gets_a_budget(world)
    await world.until(lambda: world.store.list("poddisruptionbudgets") != [], within=60)
    world.edit(minAvailable=None)


async def gets_a_relay(world: World) -> None:
    world.edit(relay=True)


async def gives_up_its_relay(world: World) -> None:
    await gets_a_relay(world)
    await world.until(lambda: "relay" in world.status(), within=60)
    world.edit(relay=False)


async def is_made_anew(world: World) -> None:
    world.store.delete("fiberpools", NAMESPACE, "es")
    world.make_pool(replicas=2)


LIVES: dict[Right, Callable[[World], Awaitable[None]]] = {
    ("create", "pods"): is_made_anew,
    ("delete", "pods"): releases,
    ("create", "services"): is_made_anew,
    ("get", "services"): is_made_anew,
    ("patch", "services"): has_its_service_changed,
    ("create", "secrets"): is_made_anew,
    ("get", "secrets"): is_made_anew,
    ("create", "endpointslices"): is_made_anew,
    ("get", "endpointslices"): gets_another_master,
    ("patch", "endpointslices"): gets_another_master,
    ("delete", "endpointslices"): gets_a_master_of_another_family,
    ("create", "poddisruptionbudgets"): gets_a_budget,
    ("get", "poddisruptionbudgets"): gets_a_budget,
    ("patch", "poddisruptionbudgets"): changes_its_budget,
    ("delete", "poddisruptionbudgets"): gives_up_its_budget,
    ("create", "deployments"): gets_a_relay,
    ("get", "deployments"): gets_a_relay,
    ("delete", "deployments"): gives_up_its_relay,
    ("get", "leases"): loses_its_master,
    ("delete", "fiberpools"): loses_its_master,
}
"""Problems that the status shows, by missing right."""

BY_EVENT = [("patch", "fiberpools/status")]
BY_READINESS = [
    ("list", "fiberpools"),
    ("watch", "fiberpools"),
    ("list", "leases"),
    ("watch", "leases"),
]
AT_START = [("list", "pods"), ("watch", "pods")]
"""Rights whose lack from the start the status of each pool shows."""
BY_LOG = [("get", "fiberpools")]
EVENTS = [("create", "events"), ("list", "events"), ("patch", "events")]
"""Only an explanation is missing without these."""


def test_every_right_is_in_one_of_these_tests() -> None:
    assert sorted(rights()) == sorted(
        [*LIVES, *BY_EVENT, *BY_READINESS, *AT_START, *BY_LOG, *EVENTS]
    )


@pytest.mark.parametrize("right", LIVES, ids=" ".join)
def test_a_missing_right_is_reported_in_the_status(right: Right) -> None:
    @played
    async def test(world: World) -> None:
        world.make_pool(replicas=2, master=MASTER)
        await world.ready(2)
        without = denied(right)
        world.api.faults.append(without)
        await LIVES[right](world)
        await world.until(lambda: "Forbidden" in world.reasons(), within=60)
        (problem,) = (p for p in world.status()["problems"] if p["reason"] == "Forbidden")
        assert f"cannot {right[0]} resource" in problem["message"]
        assert "operator" in problem["message"].replace('User "operator"', "")
        await world.settled(60)
        assert "Forbidden" in world.reasons(), "as long as it is missing"
        assert world.api.count(*right) < 40
        without.times = 0
        await world.until(
            lambda: not world.store.list("fiberpools") or "Forbidden" not in world.reasons(), 60
        )

    test()


@pytest.mark.parametrize("right", AT_START, ids=" ".join)
def test_without_a_right_to_pods_the_operator_is_not_ready_and_pools_say_why(right: Right) -> None:
    @played
    async def test(world: World) -> None:
        without = denied(right)
        world.api.faults.append(without)
        world.make_pool(replicas=2)
        await world.until(lambda: "Forbidden" in world.reasons(), within=60)
        (problem,) = (p for p in world.status()["problems"] if p["reason"] == "Forbidden")
        assert f"cannot {right[0]} resource" in problem["message"]
        assert f"{' '.join(right)}" in str(world.program.health.ready())
        assert world.pods() == []
        without.times = 0
        await world.ready(2)
        assert world.reasons() == []

    test()


@pytest.mark.parametrize("right", BY_EVENT, ids=" ".join)
def test_a_status_that_may_not_be_written_is_reported_by_an_event(right: Right) -> None:
    @played
    async def test(world: World) -> None:
        world.api.faults.append(denied(right))
        await is_new(world)
        await world.until(lambda: world.store.list("events") != [], within=5)
        await world.settled(120)
        (event,) = world.store.list("events")
        assert event["reason"] == "Forbidden"
        assert "cannot patch resource" in event["message"]
        assert world.pods() == []

    test()


@pytest.mark.parametrize("right", BY_LOG, ids=" ".join)
def test_a_pool_that_may_not_be_read_is_reported_in_the_log(
    right: Right, caplog: pytest.LogCaptureFixture
) -> None:
    @played
    async def test(world: World) -> None:
        world.api.faults.append(denied(right))
        await is_new(world)
        await world.settled(10)

    test()
    assert "get fiberpools es in team" in caplog.text


@pytest.mark.parametrize("right", EVENTS, ids=" ".join)
def test_without_events_a_pool_works(right: Right) -> None:
    @played
    async def test(world: World) -> None:
        world.api.faults.append(denied(right))
        await is_new(world)
        await world.ready(2)
        assert world.reasons() == []

    test()


def test_without_the_right_to_list_pools_the_operator_is_not_ready() -> None:
    @played
    async def test(world: World) -> None:
        world.api.faults.append(denied(("list", "fiberpools")))
        await world.settled(1)
        await world.until(lambda: "list fiberpools" in str(world.program.health.ready()), 120)

    test()


# -- A refusal only stops what depends on it


@played
async def test_the_status_names_a_new_master_only_when_the_endpoint_slice_leads_to_it(
    world: World,
) -> None:
    world.make_pool(replicas=3, master=MASTER)
    await world.ready(3)
    world.api.faults.append(denied(("patch", "endpointslices")))
    released = world.names()[0]
    another = {**MASTER, "epoch": 2, "port": 2}
    world.edit(replicas=2, master=another, scaleDown={"release": [released]})
    await world.until(lambda: world.status().get("observedGeneration") == 2, within=5)
    assert world.status()["phase"] == "Degraded"
    assert world.status()["master"] == "10.0.3.7:41337"
    assert "the EndpointSlice es-fiber" in world.status()["problems"][0]["message"]
    await world.until(lambda: released not in world.names())
    world.api.faults.clear()
    await world.until(lambda: world.status()["master"] == "10.0.3.7:2", within=10)
    await world.ready(2)


@played
async def test_a_lease_that_may_not_be_read_is_a_warning(world: World) -> None:
    without = denied(("get", "leases"))
    without.name = "es"
    world.api.faults.append(without)
    world.make_pool(replicas=2, master=LOST)
    await world.until(lambda: "Forbidden" in world.reasons())
    await world.settled(60)
    conditions = {c["type"]: c for c in world.status()["conditions"]}
    assert conditions["MasterAlive"]["status"] == "Unknown"
    assert "lacks the right to read the Lease es" in conditions["MasterAlive"]["message"]
    assert conditions["Accepted"]["status"] == "True"
    assert world.status()["phase"] == "Ready"
    assert "onLost (ScaleToMin) is not applied" in world.status()["problems"][0]["message"]


# -- Calls that fail


WEBHOOK = 'Internal error occurred: failed calling webhook "v.example": connection refused'
WAYS: dict[str, tuple[Body, float]] = {
    "down": ({"status": 500, "message": WEBHOOK}, 0.0),
    "slow": ({"late": 12.0}, 10.0),
    "hangs": ({"late": 60.0}, 10.0),
    "no-answer": ({}, 0.0),
    "busy": ({"status": 429, "retry_after": 3, "message": "too many requests"}, 0.0),
}
"""Ways in which pods cannot be made, and the first failed call."""


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("replicas", [0, 5])
def test_a_new_pool_whose_pods_cannot_be_made_says_so(way: str, replicas: int) -> None:
    what, fails = WAYS[way]

    @played
    async def test(world: World) -> None:
        world.api.faults.append(fault(("create", "pods"), **what))
        world.make_pool(replicas=replicas)
        assert await world.until(lambda: "ApiUnavailable" in world.reasons()) <= fails + 1.0
        (problem,) = world.status()["problems"]
        assert (problem["severity"], problem["terminal"]) == ("Warning", False)
        assert str(what.get("message", "")) in problem["message"]
        assert "admission webhook" in problem["message"]
        await world.settled(SECOND_LOOK + 60)
        assert world.status()["problems"][0]["severity"] == "Error"
        assert world.status()["phase"] == "Degraded"
        assert world.api.count("create", "pods") < 12
        world.api.faults.clear()
        await world.ready(replicas)
        await world.until(lambda: world.reasons() == [])

    test()


@pytest.mark.parametrize("way", WAYS)
def test_a_pool_that_worked_and_whose_pods_cannot_be_made_says_so(way: str) -> None:
    what, fails = WAYS[way]

    @played
    async def test(world: World) -> None:
        world.make_pool(replicas=2)
        await world.ready(2)
        world.api.faults.append(fault(("create", "pods"), **what))
        world.edit(replicas=5)
        assert await world.until(lambda: "ApiUnavailable" in world.reasons()) <= fails + 4.0
        world.edit(replicas=2)
        await world.until(lambda: world.reasons() == [], within=40)
        world.api.faults.clear()
        world.edit(replicas=5)
        await world.ready(5)
        assert world.reasons() == []

    test()


@pytest.mark.parametrize(
    "right",
    [right for right in LIVES if right not in [("create", "pods"), ("get", "leases")]],
    ids=" ".join,
)
def test_a_failed_call_is_reported_in_the_status(right: Right) -> None:
    @played
    async def test(world: World) -> None:
        world.make_pool(replicas=2, master=MASTER)
        await world.ready(2)
        world.api.faults.append(fault(right, status=500, message="etcdserver: no leader"))
        await LIVES[right](world)
        await world.until(lambda: "ApiUnavailable" in world.reasons(), within=60)
        (problem,) = (p for p in world.status()["problems"] if p["reason"] == "ApiUnavailable")
        assert "etcdserver: no leader" in problem["message"]
        await world.settled(SECOND_LOOK + 40)
        assert world.status()["phase"] == "Degraded"
        assert world.api.count(*right) < 40
        world.api.faults.clear()
        await world.until(
            lambda: not world.store.list("fiberpools") or "ApiUnavailable" not in world.reasons(),
            within=60,
        )

    test()


# -- The list of pods is unknown


@played
async def test_no_plan_is_made_on_an_unknown_list_of_pods(world: World) -> None:
    world.make_pool(replicas=3)
    await world.ready(3)
    world.api.faults.append(fault(("list", "pods"), status=500))
    world.program.informer.refresh()
    world.edit(replicas=1)
    await world.until(lambda: "ApiUnavailable" in world.reasons(), within=2)
    status = world.status()
    assert (status["observedGeneration"], status["readyReplicas"]) == (1, 3)
    assert status["phase"] == "Ready", "it may pass at once"
    await world.settled(120)
    conditions = {c["type"]: c["status"] for c in world.status()["conditions"]}
    assert (conditions["Ready"], conditions["Degraded"]) == ("Unknown", "True")
    assert len(world.pods()) == 3
    world.api.faults.clear()
    await world.ready(1)
    assert world.status()["phase"] == "Ready"


@played
async def test_a_new_pool_whose_pods_cannot_be_listed_says_so(world: World) -> None:
    world.api.faults.append(fault(("list", "pods"), status=500))
    world.make_pool(replicas=3)
    await world.until(lambda: "ApiUnavailable" in world.reasons(), within=2)
    assert world.status()["phase"] == "Pending"
    await world.settled(60)
    assert world.status()["phase"] == "Degraded"
    assert world.pods() == []
    assert [event["reason"] for event in world.store.list("events")] == ["ApiUnavailable"]
