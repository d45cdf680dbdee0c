"""Parsing of a pod's JSON by the operator."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber_operator.planning.pods import LONGEST_MESSAGE, PodState, PodView, observe
from unit.operator_objects import (
    NOW,
    UID,
    condition,
    ended,
    pod_document,
    running,
    terminating,
    unschedulable,
    waiting,
)

Json = dict[str, Any]


def look(document: Json) -> PodView:
    return observe(document, "worker")


def with_containers(document: Json, **states: Json) -> Json:
    """Return the pod with further containers in these states."""
    statuses = document["status"].setdefault("containerStatuses", [])
    statuses += [{"name": name, "state": state} for name, state in states.items()]
    return document


def with_status(document: Json, **status: Any) -> Json:
    document["status"] |= status
    return document


def init_failed(**end: Any) -> Json:
    state = {"name": "i", "state": {"terminated": end}}
    return pod_document(1, phase="Failed", initContainerStatuses=[state])


def silent(conditions: Any) -> Json:
    return with_status(running(), conditions=conditions)


def evicted(**status: Any) -> Json:
    return with_status(ended(code=137), **status)


def disrupted(reason: str) -> Json:
    return evicted(conditions=[condition("DisruptionTarget", "True", reason=reason)])


READY_SINCE_50 = {"state": "Ready", "since": NOW - 49, "was_ready": True, "joining": False}
UNREADY = [condition("Ready", "False", ago=5, message="node silent")]
CPU = "0/2 nodes are available: 2 Insufficient cpu."
PULL = {"waiting": {"reason": "ErrImagePull", "message": "no x"}}
DEADLINE = {"reason": "DeadlineExceeded", "message": "Pod was active too long"}
DISK = 'Usage of EmptyDir volume "x" exceeds the limit "1Gi".'
EXITED = {"terminated": {"exitCode": 1, "reason": "Error"}}
COMPLETED = {"terminated": {"exitCode": 0, "reason": "Completed"}}

LIVE = [
    (
        pod_document(3, age=2),
        {"state": "Pending", "trouble": None, "owner": UID, "created": NOW - 2, "since": NOW - 2},
    ),
    (pod_document(3), {"live": True, "scheduled": False}),
    (running(ready=False), {"state": "Starting"}),
    (running(age=50), READY_SINCE_50),
    (
        silent(UNREADY),
        {"state": "NotReady", "was_ready": True, "since": NOW - 5, "message": "node silent"},
    ),
    # It may have been Ready, if the conditions do not tell.
    *(
        (silent(conditions), {"state": "NotReady", "was_ready": True})
        for conditions in (None, [], "x", [{"type": "Ready", "status": "Unknown"}])
    ),
    *(
        (terminating(document), {"state": "Terminating", "live": False})
        for document in (running(), ended(), waiting(1, "ErrImagePull"), pod_document())
    ),
    *(
        (
            waiting(1, reason, "why"),
            {"state": "Pending", "trouble": "CannotStart", "reason": reason, "message": "why"},
        )
        for reason in (
            "ErrImagePull",
            "ImagePullBackOff",
            "InvalidImageName",
            "CreateContainerConfigError",
        )
    ),
    *(
        (waiting(1, reason), {"trouble": None})
        for reason in ("ContainerCreating", "PodInitializing", "")
    ),
    (with_containers(waiting(1, "PodInitializing"), x=PULL), {"message": "no x"}),
    (
        with_status(
            waiting(1, "PodInitializing"), initContainerStatuses=[{"name": "x", "state": PULL}]
        ),
        {"message": "no x"},
    ),
    (unschedulable(1, CPU), {"trouble": "Unschedulable", "message": CPU}),
    (with_containers(running(), x=EXITED), {"state": "Ready"}),
]

ENDED = [
    (
        ended(code=3, ran=30, ago=4, message="Traceback\nKeyError: 1\n"),
        {
            "state": "Ended",
            "trouble": "Application",
            "exit_code": 3,
            "ran": 30,
            "since": NOW - 4,
            "message": "Traceback\nKeyError: 1",
            "lingers": False,
        },
    ),
    (ended(code=137, reason="OOMKilled"), {"trouble": "Application", "reason": "OOMKilled"}),
    # Exit code 0 is well, unless it comes at once.
    (ended(code=0, ran=10, reason="Completed"), {"trouble": "Completed"}),
    (ended(code=0, ran=9, reason="Completed"), {"trouble": "Application"}),
    # The template's deadline has passed.
    (ended(code=137, ran=600), {"trouble": "Application"}),
    (with_status(ended(code=137, ran=600), **DEADLINE), {"trouble": "Completed"}),
    (with_status(ended(code=137, ran=2), **DEADLINE), {"trouble": "Application"}),
    *(
        (evicted(reason=reason, message=message), {"trouble": "Disrupted", "reason": reason})
        for reason, message in [
            ("Evicted", "The node was low on resource: memory."),
            ("Preempting", "Preempted in order to admit critical pod"),
            ("Terminated", "Pod was terminated in response to node shutdown."),
            ("NodeLost", ""),
        ]
    ),
    *(
        (disrupted(reason), {"trouble": "Disrupted", "reason": reason})
        for reason in ("PreemptionByScheduler", "DeletionByPodGC")
    ),
    *(
        (ended(code=255, reason=reason), {"trouble": "Disrupted"})
        for reason in ("ContainerStatusUnknown", "Unknown")
    ),
    (evicted(reason="Evicted", message=DISK), {"trouble": "Application"}),
    (
        pod_document(1, phase="Failed", reason="OutOfcpu", message="Node didn't have enough"),
        {"trouble": "Application", "reason": "OutOfcpu", "exit_code": None},
    ),
    (
        init_failed(exitCode=2, reason="Error", message="no data"),
        {"trouble": "Application", "exit_code": 2, "message": "no data"},
    ),
    (
        with_containers(ended(code=1, phase="Running"), x={"running": {}}),
        {"state": "Ended", "lingers": True},
    ),
    # The pod's phase is up to a second late.
    (ended(code=1, phase="Running"), {"lingers": False}),
    (with_containers(ended(code=1, phase="Running"), x=COMPLETED), {"lingers": False}),
    (with_containers(ended(code=1, phase="Running"), x=COMPLETED, y=PULL), {"lingers": True}),
]


@pytest.mark.parametrize(("document", "fields"), [*LIVE, *ENDED])
def test_a_pod_is_read(document: Json, fields: Json) -> None:
    pod = look(document)
    assert {name: getattr(pod, name) for name in fields} == fields


def test_the_named_container_is_the_worker() -> None:
    document = with_containers(running(), x=EXITED)
    assert observe(document, "x").state is PodState.ENDED


def test_a_long_message_keeps_its_end() -> None:
    pod = look(ended(message="a" * 5000 + "KeyError"))
    assert pod.message.endswith("KeyError")
    assert len(pod.message) <= LONGEST_MESSAGE + 3


@pytest.mark.parametrize(("said", "cost"), [("-7", -7), ("cheap", 0)])
def test_the_deletion_cost_is_an_annotation_of_kubernetes(said: str, cost: int) -> None:
    document = running()
    document["metadata"]["annotations"] = {"controller.kubernetes.io/pod-deletion-cost": said}
    assert look(document).deletion_cost == cost


@pytest.mark.parametrize("code", [None, "1", True, 2**31, 1.0])
def test_an_end_without_an_exit_code_is_none(code: Any) -> None:
    document = running()
    end = {"terminated": {"exitCode": code, "reason": "Error"}}
    document["status"]["containerStatuses"][0]["state"] = end
    pod = look(document)
    assert (pod.state, pod.exit_code) == (PodState.READY, None)


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=6,
)
PATHS = [
    (),
    ("metadata",),
    ("metadata", "creationTimestamp"),
    ("metadata", "deletionTimestamp"),
    ("metadata", "labels"),
    ("metadata", "annotations"),
    ("metadata", "ownerReferences"),
    ("spec",),
    ("status",),
    ("status", "phase"),
    ("status", "reason"),
    ("status", "message"),
    ("status", "conditions"),
    ("status", "containerStatuses"),
    ("status", "initContainerStatuses"),
    ("status", "containerStatuses", 0, "state"),
    ("status", "containerStatuses", 0, "state", "terminated"),
    ("status", "containerStatuses", 0, "state", "terminated", "exitCode"),
    ("status", "containerStatuses", 0, "state", "terminated", "startedAt"),
]


@given(path=st.sampled_from(PATHS), junk=ANYTHING)
def test_junk_anywhere_is_still_a_pod(path: tuple[str | int, ...], junk: Any) -> None:
    document: Any = ended()
    if not path:
        document = junk
    else:
        place = document
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = junk
    pod = look(document)
    assert isinstance(pod.state, PodState)
    assert isinstance(pod.name, str)
    assert isinstance(pod.message, str)
    assert isinstance(pod.since, float)
