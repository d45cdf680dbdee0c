"""Parsing of a pod's JSON by the operator."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber_operator.planning.pods import LONGEST_MESSAGE, PodState, PodView, Trouble, observe
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


def look(document: dict[str, Any]) -> PodView:
    return observe(document, "worker")


def test_a_new_pod_is_pending() -> None:
    pod = look(pod_document(3, age=2))
    assert pod.state is PodState.PENDING
    assert pod.trouble is None
    assert (pod.owner, pod.created, pod.since) == (UID, NOW - 2, NOW - 2)
    assert pod.live
    assert not pod.scheduled


def test_a_pod_is_starting_until_it_is_ready() -> None:
    assert look(running(ready=False)).state is PodState.STARTING
    ready = look(running(age=50))
    assert (ready.state, ready.since, ready.was_ready) == (PodState.READY, NOW - 49, True)


def test_a_pod_that_was_ready_is_not_one_that_never_was() -> None:
    document = running(age=100)
    document["status"]["conditions"] = [condition("Ready", "False", ago=5, message="node silent")]
    pod = look(document)
    assert (pod.state, pod.was_ready, pod.since) == (PodState.NOT_READY, True, NOW - 5)
    assert pod.message == "node silent"


def test_a_deleted_pod_is_terminating_in_every_other_state() -> None:
    for document in (running(), ended(), waiting(1, "ErrImagePull"), pod_document()):
        pod = look(terminating(document))
        assert pod.state is PodState.TERMINATING
        assert not pod.live


@pytest.mark.parametrize(
    "reason",
    ["ErrImagePull", "ImagePullBackOff", "InvalidImageName", "CreateContainerConfigError"],
)
def test_a_pod_that_the_kubelet_retries_cannot_start(reason: str) -> None:
    pod = look(waiting(1, reason, "why"))
    assert (pod.state, pod.trouble) == (PodState.PENDING, Trouble.CANNOT_START)
    assert (pod.reason, pod.message) == (reason, "why")


@pytest.mark.parametrize("reason", ["ContainerCreating", "PodInitializing", ""])
def test_a_pod_that_is_starting_has_no_trouble(reason: str) -> None:
    assert look(waiting(1, reason)).trouble is None


@pytest.mark.parametrize("kind", ["initContainerStatuses", "containerStatuses"])
def test_another_container_can_keep_a_pod_from_starting(kind: str) -> None:
    document = waiting(1, "PodInitializing")
    other = {"name": "x", "state": {"waiting": {"reason": "ErrImagePull", "message": "no x"}}}
    document["status"].setdefault(kind, []).append(other)
    assert look(document).message == "no x"


def test_unschedulable_has_the_schedulers_reason() -> None:
    pod = look(unschedulable(1, "0/2 nodes are available: 2 Insufficient cpu."))
    assert pod.trouble is Trouble.UNSCHEDULABLE
    assert pod.message == "0/2 nodes are available: 2 Insufficient cpu."


def test_a_failed_worker_is_the_applications() -> None:
    pod = look(ended(code=3, ran=30, ago=4, message="Traceback\nKeyError: 1\n"))
    assert (pod.state, pod.trouble) == (PodState.ENDED, Trouble.APPLICATION)
    assert (pod.exit_code, pod.ran, pod.since) == (3, 30, NOW - 4)
    assert pod.message == "Traceback\nKeyError: 1"
    assert not pod.lingers


def test_out_of_memory_is_the_applications() -> None:
    pod = look(ended(code=137, reason="OOMKilled"))
    assert (pod.trouble, pod.reason) == (Trouble.APPLICATION, "OOMKilled")


def test_exit_code_0_is_well_unless_it_comes_at_once() -> None:
    assert look(ended(code=0, ran=10, reason="Completed")).trouble is Trouble.COMPLETED
    assert look(ended(code=0, ran=9, reason="Completed")).trouble is Trouble.APPLICATION


def test_a_deadline_of_the_template_is_kept_without_blame() -> None:
    deadline = {"reason": "DeadlineExceeded", "message": "Pod was active too long"}
    assert look(ended(code=137, ran=600)).trouble is Trouble.APPLICATION
    document = ended(code=137, ran=600)
    document["status"] |= deadline
    assert look(document).trouble is Trouble.COMPLETED
    document = ended(code=137, ran=2)
    document["status"] |= deadline
    assert look(document).trouble is Trouble.APPLICATION


@pytest.mark.parametrize(
    "status",
    [
        {"reason": "Evicted", "message": "The node was low on resource: memory."},
        {"reason": "Preempting", "message": "Preempted in order to admit critical pod"},
        {"reason": "Terminated", "message": "Pod was terminated in response to node shutdown."},
        {"reason": "NodeLost"},
        {"conditions": [condition("DisruptionTarget", "True", reason="PreemptionByScheduler")]},
        {"conditions": [condition("DisruptionTarget", "True", reason="DeletionByPodGC")]},
    ],
)
def test_pods_that_the_cluster_ends_are_disrupted(status: dict[str, Any]) -> None:
    document = ended(code=137)
    document["status"] |= status
    pod = look(document)
    assert pod.trouble is Trouble.DISRUPTED
    assert pod.reason in (status.get("reason"), "PreemptionByScheduler", "DeletionByPodGC")


@pytest.mark.parametrize("reason", ["ContainerStatusUnknown", "Unknown"])
def test_a_container_that_a_node_lost_is_disrupted(reason: str) -> None:
    assert look(ended(code=255, reason=reason)).trouble is Trouble.DISRUPTED


def test_eviction_for_its_own_excess_is_the_applications() -> None:
    document = ended(code=137)
    document["status"] |= {
        "reason": "Evicted",
        "message": 'Usage of EmptyDir volume "x" exceeds the limit "1Gi".',
    }
    assert look(document).trouble is Trouble.APPLICATION


def test_a_pod_that_its_node_turned_away_is_replaced_with_back_off() -> None:
    pod = look(
        pod_document(1, phase="Failed", reason="OutOfcpu", message="Node didn't have enough")
    )
    assert (pod.trouble, pod.reason, pod.exit_code) == (Trouble.APPLICATION, "OutOfcpu", None)


def test_a_failed_init_container_is_the_applications() -> None:
    document = pod_document(1, phase="Failed")
    end = {"exitCode": 2, "reason": "Error", "message": "no data"}
    document["status"]["initContainerStatuses"] = [{"name": "i", "state": {"terminated": end}}]
    pod = look(document)
    assert (pod.trouble, pod.exit_code, pod.message) == (Trouble.APPLICATION, 2, "no data")


def test_a_worker_has_ended_even_if_its_sidecar_goes_on() -> None:
    document = ended(code=1, phase="Running")
    document["status"]["containerStatuses"].append({"name": "x", "state": {"running": {}}})
    pod = look(document)
    assert pod.state is PodState.ENDED
    assert pod.lingers


def test_a_pod_does_not_linger_because_its_phase_is_late() -> None:
    # Kubernetes reports a container's end up to a second before the pod's phase is Failed.
    document = ended(code=1, phase="Running")
    assert not look(document).lingers
    end = {"exitCode": 0, "reason": "Completed"}
    document["status"]["containerStatuses"].append({"name": "x", "state": {"terminated": end}})
    assert not look(document).lingers
    state = {"waiting": {"reason": "ImagePullBackOff"}}
    document["status"]["containerStatuses"].append({"name": "y", "state": state})
    assert look(document).lingers


def test_the_judged_container_is_the_one_that_is_named() -> None:
    document = running()
    end = {"exitCode": 1, "reason": "Error"}
    document["status"]["containerStatuses"].append({"name": "x", "state": {"terminated": end}})
    assert look(document).state is PodState.READY
    assert observe(document, "x").state is PodState.ENDED


def test_a_long_message_keeps_its_end() -> None:
    pod = look(ended(message="a" * 5000 + "KeyError"))
    assert pod.message.endswith("KeyError")
    assert len(pod.message) <= LONGEST_MESSAGE + 3


def test_deletion_cost_is_kubernetes_annotation() -> None:
    document = running()
    document["metadata"]["annotations"] = {"controller.kubernetes.io/pod-deletion-cost": "-7"}
    assert look(document).deletion_cost == -7
    document["metadata"]["annotations"] = {"controller.kubernetes.io/pod-deletion-cost": "cheap"}
    assert look(document).deletion_cost == 0


@pytest.mark.parametrize("code", [None, "1", True, 2**31, 1.0])
def test_an_end_with_an_invalid_exit_code_is_ignored(code: Any) -> None:
    document = running()
    end = {"terminated": {"exitCode": code, "reason": "Error"}}
    document["status"]["containerStatuses"][0]["state"] = end
    pod = look(document)
    assert (pod.state, pod.exit_code) == (PodState.READY, None)


@pytest.mark.parametrize("conditions", [None, [], "x", [{"type": "Ready", "status": "Unknown"}]])
def test_a_running_worker_without_valid_conditions_may_have_been_ready(
    conditions: Any,
) -> None:
    pod = look({**running(), "status": {**running()["status"], "conditions": conditions}})
    assert (pod.state, pod.was_ready) == (PodState.NOT_READY, True)


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
