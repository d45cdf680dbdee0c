"""Why pods ended: documents as Kubernetes writes them, and the words for people."""

from __future__ import annotations

from typing import Any

import pytest

from fiber._backends.kubernetes.problems import PodEnd, node_of, pod_end


def pod(
    *,
    terminated: dict[str, Any] | None = None,
    disruption: tuple[str, str] | None = None,
    deleted: bool = False,
    limit: str | None = "512Mi",
    **status: Any,
) -> dict[str, Any]:
    state = {"terminated": terminated} if terminated else {"running": {}}
    conditions = [{"type": "Ready", "status": "False", "reason": "PodFailed"}]
    if disruption:
        reason, message = disruption
        told = {"type": "DisruptionTarget", "status": "True", "reason": reason, "message": message}
        conditions.append(told)
    return {
        "metadata": {"name": "es-1", **({"deletionTimestamp": "2026-11-21"} if deleted else {})},
        "spec": {
            "nodeName": "node-2",
            "containers": [
                {"name": "proxy", "resources": {"limits": {"memory": "1Mi"}}},
                {"name": "worker", "resources": {"limits": {"memory": limit}} if limit else {}},
            ],
        },
        "status": {
            "phase": "Failed",
            "conditions": conditions,
            "containerStatuses": [
                {"name": "proxy", "state": {"terminated": {"exitCode": 3, "reason": "Error"}}},
                {"name": "worker", "state": state},
            ],
            **status,
        },
    }


KILLED = {"exitCode": 137, "reason": "OOMKilled"}


@pytest.mark.parametrize(
    ("document", "reason", "exitcode"),
    [
        (pod(terminated=KILLED), "OOMKilled: its memory limit is 512Mi", -9),
        (pod(terminated=KILLED, limit=None), "OOMKilled: it has no limit", -9),
        (pod(terminated=KILLED, deleted=True), "OOMKilled: its memory limit is 512Mi", -9),
        (
            pod(
                terminated={"exitCode": 137, "reason": "Error"},
                disruption=("TerminationByKubelet", "The node was low on resource: memory."),
                reason="Evicted",
                message="The node was low on resource: memory. Threshold quantity: 100Mi.",
            ),
            "Evicted: The node was low on resource: memory. Threshold quantity: 100Mi",
            -9,
        ),
        (
            pod(disruption=("EvictionByEvictionAPI", "Eviction API: evicting"), deleted=True),
            "Evicted: Eviction API: evicting",
            None,
        ),
        (
            pod(disruption=("PreemptionByScheduler", "default-scheduler: preempting")),
            "Preempted: default-scheduler: preempting",
            None,
        ),
        (pod(disruption=("DeletionByTaintManager", "")), "NodeLost", None),
        (
            pod(disruption=("DeletionByPodGC", "PodGC: node no longer exists"), deleted=True),
            "NodeLost: PodGC: node no longer exists",
            None,
        ),
        (
            pod(terminated={"exitCode": 137, "reason": "ContainerStatusUnknown"}),
            "NodeLost: its node has no record of the container",
            None,
        ),
        (pod(deleted=True), "Deleted: the pod was deleted", None),
        (
            pod(deleted=True, terminated={"exitCode": 0, "reason": "Completed"}),
            "Deleted: the pod was deleted",
            0,
        ),
        (
            pod(terminated={"exitCode": 3, "reason": "Error"}),
            "Error: its agent ended with exit status 3",
            3,
        ),
        (
            pod(terminated={"exitCode": 139, "reason": "Error"}),
            "Error: its agent was killed by SIGSEGV",
            -11,
        ),
        (
            pod(terminated={"exitCode": 255, "reason": "Error"}),
            "Error: its agent was killed by signal 127",
            -127,
        ),
        (
            pod(reason="OutOfcpu", message="Node didn't have enough resource: cpu"),
            "OutOfcpu: Node didn't have enough resource: cpu",
            None,
        ),
        (pod(phase="Succeeded"), "Succeeded", None),
    ],
)
def test_a_pod_that_ended_says_why(
    document: dict[str, Any], reason: str, exitcode: int | None
) -> None:
    word = reason.partition(":")[0]
    disrupted = word in ("Deleted", "Evicted", "NodeLost", "Preempted")
    assert pod_end(document) == PodEnd(reason, "node-2", exitcode, disrupted)


@pytest.mark.parametrize(
    "document",
    [
        {},
        {"metadata": {"name": "es-1"}, "spec": {"containers": []}, "status": {}},
        pod(phase="Running"),
        pod(phase="Pending", containerStatuses=None, conditions=None),
    ],
)
def test_a_healthy_pod_has_no_reason(document: dict[str, Any]) -> None:
    assert pod_end(document) is None


def test_an_eviction_for_the_pods_own_excess_is_no_disruption() -> None:
    message = "Pod ephemeral local storage usage exceeds the total limit of containers 1Gi. "
    ended = pod_end(pod(reason="Evicted", message=message))
    assert ended is not None
    assert (ended.reason, ended.disrupted) == (f"Evicted: {message.rstrip('. ')}", False)


def test_a_false_disruption_condition_is_ignored() -> None:
    document = pod(phase="Running", disruption=("PreemptionByScheduler", "preempting"))
    document["status"]["conditions"][-1]["status"] = "False"
    assert pod_end(document) is None


def test_a_pod_without_a_node() -> None:
    assert node_of({"spec": {}}) == ""
    assert node_of(pod()) == "node-2"
