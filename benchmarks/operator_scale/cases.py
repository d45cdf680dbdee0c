"""Cases: pools and ReplicaSets of the same pods, in the same numbers.

Plain data and decisions on it; this module talks to no cluster.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from fiber_api import names

Body = dict[str, Any]

FAKE_KEY, FAKE_VALUE = "kwok.x-k8s.io/node", "fake"
_LABEL = f"{names.GROUP}/benchmark-set"


@dataclass(frozen=True)
class Case:
    """Case of so many objects with so many pods each, done `rounds` times by default.

    `limit`: seconds that each step of a trial may take. `by_default`: also measure ReplicaSets as
    Kubernetes' defaults make them.
    """

    name: str
    title: str
    objects: int
    size: int
    rounds: int
    limit: float
    by_default: bool = False

    @property
    def pods(self) -> int:
        """Pods of all objects."""
        return self.objects * self.size


CASES = {
    case.name: case
    for case in (
        Case("1000", "1,000 pods", 1, 1000, rounds=3, limit=120, by_default=True),
        Case("100x10", "100 times 10 pods", 100, 10, rounds=2, limit=120, by_default=True),
        # The last, because the operator's memory does not shrink after it has grown.
        Case("5000", "5,000 pods", 1, 5000, rounds=1, limit=400),
    )
}

WARM_UP = Case("warm-up", "50 pods to warm up", 1, 50, rounds=1, limit=60)
"""Case that runs first and is not kept: it opens connections and loads code."""


@dataclass(frozen=True)
class Subject:
    """Kind of object that makes pods. `group` is the API's path before the namespace."""

    name: str
    label: str
    colour: str
    group: str
    resource: str
    manifest: Callable[[str, int], Body]

    def collection(self, namespace: str) -> str:
        """Return the path of all of them in a namespace."""
        return f"{self.group}/namespaces/{namespace}/{self.resource}"


def pod_template() -> Body:
    """Return a pod that lands on a pretended node, where its image is never pulled."""
    return {
        "metadata": {"labels": {_LABEL: "pods"}},
        "spec": {
            "nodeSelector": {FAKE_KEY: FAKE_VALUE},
            "tolerations": [{"key": FAKE_KEY, "value": FAKE_VALUE, "effect": "NoSchedule"}],
            "containers": [
                {
                    "name": names.WORKER_CONTAINER,
                    "image": "pretended.invalid/worker:1",
                    "resources": {"requests": {"cpu": "10m", "memory": "16Mi"}},
                }
            ],
        },
    }


def _pool(name: str, replicas: int) -> Body:
    return {
        "apiVersion": names.API_VERSION,
        "kind": names.KIND,
        "metadata": {"name": name},
        "spec": {
            "replicas": replicas,
            "maxReplicas": replicas,
            "scaleDown": {"policy": "Any"},
            "template": pod_template(),
        },
    }


def _replica_set(name: str, replicas: int) -> Body:
    template = pod_template()
    template["metadata"]["labels"] = {_LABEL: name}
    return {
        "apiVersion": "apps/v1",
        "kind": "ReplicaSet",
        "metadata": {"name": name},
        "spec": {
            "replicas": replicas,
            "selector": {"matchLabels": {_LABEL: name}},
            "template": template,
        },
    }


FIBER = Subject(
    "fiber",
    "FiberPool",
    "#d62728",
    f"/apis/{names.API_VERSION}",
    names.PLURAL,
    _pool,
)
REPLICA_SET = Subject(
    "replicaset", "ReplicaSet", "#1f77b4", "/apis/apps/v1", "replicasets", _replica_set
)
SUBJECTS = (FIBER, REPLICA_SET)

DEFAULT_RATE = 20
"""Calls a second that a controller of Kubernetes makes by default."""
BY_DEFAULT = replace(REPLICA_SET, name="replicaset-20", label=f"ReplicaSet at {DEFAULT_RATE}")
"""ReplicaSets at that rate, once for each case, however long it takes."""


def in_turn(turn: int) -> tuple[Subject, ...]:
    """Return both subjects in an alternating order, so that neither always has the fresher
    cluster."""
    return SUBJECTS if turn % 2 == 0 else SUBJECTS[::-1]


def ready(body: Body) -> int:
    """Return the number of ready pods by the object's own status."""
    return int(body.get("status", {}).get("readyReplicas") or 0)


def is_settled(body: Body, replicas: int) -> bool:
    """Tell whether the object's own status has so many pods, all ready, and no others."""
    status = body.get("status", {})
    counts = {int(status.get(name) or 0) for name in ("replicas", "readyReplicas")}
    seen = status.get("observedGeneration") == body["metadata"]["generation"]
    return seen and counts == {replicas}
