"""Pretended GPUs: a node says that it has some, and the scheduler counts them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from e2e.kube import Body, Kube

RESOURCE = "nvidia.com/gpu"
_PLACE = "/status/capacity/nvidia.com~1gpu"


@contextmanager
def gpus(kube: Kube, counts: Mapping[str, int]) -> Iterator[None]:
    """Let nodes advertise so many GPUs meanwhile, as cluster administrators do for any resource."""
    for node, count in counts.items():
        _patch(kube, node, [{"op": "add", "path": _PLACE, "value": str(count)}])
    try:
        yield
    finally:
        for node in counts:
            _patch(kube, node, [{"op": "remove", "path": _PLACE}])


def wanted(pod: Body) -> int:
    """Return the number of GPUs that a pod has."""
    limits = (
        container.get("resources", {}).get("limits", {}) for container in pod["spec"]["containers"]
    )
    return sum(int(each.get(RESOURCE, 0)) for each in limits)


def _patch(kube: Kube, node: str, operations: list[Body]) -> None:
    words = ("patch", "node", node, "--subresource=status", "--type=json")
    kube.kubectl(*words, "--patch", json.dumps(operations))
