"""Events of a pod that still explain why it does not start."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fakes import virtual_time
from fakes.kubernetes_api import KubernetesApi
from fakes.store import Body, Store
from fakes.world import NAMESPACE, World, a_world, configuration
from fiber_api.times import format_time
from fiber_operator.cluster import Cluster
from fiber_operator.events import pod_warnings
from fiber_operator.planning.pods import PodState, PodView
from fiber_operator.workqueue import Key
from unit.operator_cluster_model import view
from unit.operator_objects import NOW
from unit.test_operator_pods import ANYTHING

MOUNT = ("Warning", "FailedMount")
POD = view(1, PodState.PENDING)


def event(said: tuple[str, str], second: float = 0.0, **fields: Any) -> Body:
    """An event of ``POD``; its message is its reason in lower case."""
    type_, reason = said
    return {
        "involvedObject": {"uid": POD.uid},
        "type": type_,
        "reason": reason,
        "message": reason.lower(),
        "lastTimestamp": format_time(NOW + second),
        **fields,
    }


def warning_of(*events: Body, pod: PodView = POD) -> str:
    """Return the result for ``pod`` if these events were written in this order."""

    async def main() -> dict[str, str]:
        api = KubernetesApi(Store(asyncio.get_running_loop().time))
        for number, body in enumerate(events):
            # The first written comes last in a list.
            named = {"metadata": {"name": f"event-{99 - number}"}}
            api.store.create("events", "team", {**body, **named})
        async with api.serving():
            door = Cluster(configuration(api), connections=1)
            try:
                return await pod_warnings(door, Key("team", "es"), [pod.name], [pod])
            finally:
                await door.close()

    return virtual_time.run(main())[pod.name]


def test_a_pod_without_events_has_no_warning() -> None:
    assert warning_of() == ""


def test_the_newest_warning_is_reported() -> None:
    sandbox = ("Warning", "FailedCreatePodSandBox")
    assert warning_of(event(MOUNT, 1), event(sandbox, 9)) == (
        "FailedCreatePodSandBox: failedcreatepodsandbox"
    )
    assert warning_of(event(sandbox, 9), event(MOUNT, 1)).startswith("FailedCreatePodSandBox")


@pytest.mark.parametrize("reason", ["Pulling", "Pulled", "Created", "Started", "Anything"])
def test_a_warning_that_something_newer_follows_is_over(reason: str) -> None:
    assert warning_of(event(MOUNT, 1), event(("Normal", reason), 2)) == ""
    assert warning_of(event(("Normal", reason), 1), event(MOUNT, 2)) == "FailedMount: failedmount"


def test_the_last_written_event_of_one_second_is_the_newest() -> None:
    pulling = ("Normal", "Pulling")
    assert warning_of(event(MOUNT), event(pulling)) == ""
    assert warning_of(event(pulling), event(MOUNT)) != ""


@pytest.mark.parametrize(
    "reason", ["Scheduled", "TriggeredScaleUp", "SandboxChanged", "BackOff", "Killing"]
)
def test_an_event_that_ends_no_trouble_keeps_the_warning(reason: str) -> None:
    assert warning_of(event(MOUNT, 1), event(("Normal", reason), 2)) != ""


@pytest.mark.parametrize("reason", ["FailedScheduling", "MissingClusterDNS"])
def test_a_warning_that_delays_no_start_is_ignored(reason: str) -> None:
    assert warning_of(event(("Warning", reason), 5)) == ""


def test_a_repeated_event_is_as_new_as_its_last_time() -> None:
    pulling = event(("Normal", "Pulling"), 5)
    series: Body = {"lastTimestamp": None, "eventTime": format_time(NOW)}
    again: Body = {"series": {"count": 9, "lastObservedTime": format_time(NOW + 9)}}
    assert warning_of(pulling, event(MOUNT, **series)) == ""
    assert warning_of(pulling, event(MOUNT, **series, **again)) != ""


def test_events_of_other_pods_are_ignored() -> None:
    assert warning_of(event(MOUNT, involvedObject={"uid": "another"})) == ""


FIELDS = ["type", "reason", "message", "lastTimestamp", "eventTime", "series"]


@settings(max_examples=30, deadline=None)
@given(st.dictionaries(st.sampled_from(FIELDS), ANYTHING))
def test_events_may_hold_anything(junk: Body) -> None:
    said = warning_of({**event(MOUNT, -5), **junk}, event(("Warning", "FailedCreate"), -9))
    assert isinstance(said, str)


def test_a_long_image_pull_after_a_late_secret_is_no_problem() -> None:
    """The Secret came after some seconds; the image takes minutes."""

    async def main() -> None:
        async with a_world() as world:
            name = await starting(world)
            tell(world, name, "Warning", "FailedMount")
            await world.until(lambda: world.reasons() == ["FailedMount"], 30)
            tell(world, name, "Normal", "Pulling")
            await world.until(lambda: world.reasons() == [], 30)
            await world.settled(600)
            assert world.reasons() == []
            assert "FailedMount" not in str(world.status())

    virtual_time.run(main())


def test_a_warning_of_one_pod_ends_although_another_pod_is_asked_now() -> None:
    """A warning of the second pod is not looked at again once the first one is the silent one."""

    async def main() -> None:
        async with a_world() as world:
            world.kubelet.auto = False
            world.make_pool(replicas=2)
            await world.until(lambda: len(world.pods()) == 2)
            first, second = world.names()
            world.kubelet.waiting(NAMESPACE, first, "ErrImagePull", "too many requests")
            world.kubelet.waiting(NAMESPACE, second, "ContainerCreating")
            tell(world, second, "Warning", "FailedMount")
            await world.until(lambda: "FailedMount" in world.reasons(), 60)
            world.kubelet.waiting(NAMESPACE, first, "ContainerCreating")
            tell(world, first, "Normal", "Pulling")
            tell(world, second, "Normal", "Pulling")
            await world.until(lambda: world.reasons() == [], 60)

    virtual_time.run(main())


async def starting(world: World) -> str:
    """The name of a pod whose status does not say why it does not start."""
    world.kubelet.auto = False
    world.make_pool(replicas=1)
    await world.until(lambda: len(world.pods()) == 1)
    (name,) = world.names()
    world.kubelet.waiting(NAMESPACE, name, "ContainerCreating")
    return name


def tell(world: World, pod: str, type_: str, reason: str) -> None:
    """The kubelet posts an event of the pod."""
    body = {
        "metadata": {"name": f"{pod}.{reason}"},
        "involvedObject": {"uid": world.store.get("pods", NAMESPACE, pod)["metadata"]["uid"]},
        "type": type_,
        "reason": reason,
        "message": "as the kubelet says",
        "lastTimestamp": world.store.now(),
    }
    world.store.create("events", NAMESPACE, body)
