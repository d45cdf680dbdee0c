"""Nodes that only pretend to run pods (KWOK), for tests at thousands of pods.

They carry the label and taint kwok.x-k8s.io/node=fake: only pods that tolerate it land there.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from cluster import build, diagnosis, places
from cluster.control_plane import NODE_LOST_AFTER
from cluster.daemons import Daemon
from cluster.kubectl import answer_of, kubectl, ready_nodes
from cluster.shell import wait_for

KEY, VALUE = "kwok.x-k8s.io/node", "fake"
_SIZE = {"cpu": "64", "memory": "256Gi", "pods": "500"}
_LEASE = NODE_LOST_AFTER  # renewed four times as often
# The actions of the simulated world, from the stages that KWOK ships.
_STAGES = ("node/fast", "node/heartbeat-with-lease", "pod/fast")


def set_count(count: int) -> None:
    """See to it that there are exactly this many of them, Ready."""
    _remove_above(count)
    if count:
        _add(count)


def _remove_above(count: int) -> None:
    names = kubectl("get", "nodes", "--selector", f"{KEY}={VALUE}", "--output", "name").split()
    surplus = [name for name in names if int(name.rpartition("-")[2]) > count]
    if surplus:
        kubectl("delete", *surplus)


def _add(count: int) -> None:
    build.build(["kwok"])
    kwok = Daemon("kwok")
    kwok.start(
        places.program("kwok"),
        f"--kubeconfig={places.KUBECONFIG}",
        f"--config={_stages()}",
        "--manage-all-nodes=false",
        f"--manage-nodes-with-label-selector={KEY}={VALUE}",
        f"--node-lease-duration-seconds={_LEASE}",
    )
    manifest = places.STATE / "conf" / "fake-nodes.json"
    nodes = [node(index) for index in range(1, count + 1)]
    manifest.write_text(json.dumps({"apiVersion": "v1", "kind": "List", "items": nodes}))
    kubectl("apply", "-f", str(manifest))
    wait_for(
        f"{count} pretended nodes",
        lambda: ready_nodes(f"{KEY}={VALUE}") == count,
        complaint=lambda: diagnosis.end_of([kwok]),
        account=lambda: diagnosis.silence_of([kwok], answer_of("get", "nodes")),
    )


def node(index: int) -> dict[str, Any]:
    """The manifest of one of them."""
    return {
        "apiVersion": "v1",
        "kind": "Node",
        "metadata": {"name": f"fake-{index}", "labels": {KEY: VALUE}},
        "spec": {"taints": [{"key": KEY, "value": VALUE, "effect": "NoSchedule"}]},
        "status": {"allocatable": _SIZE, "capacity": _SIZE},
    }


def _stages() -> Path:
    folder = build.module_sources("kwok") / "kustomize" / "stage"
    files = [file for name in _STAGES for file in sorted((folder / name).glob("*.yaml"))]
    texts = [file.read_text() for file in files if file.name != "kustomization.yaml"]
    config = places.STATE / "conf" / "kwok.yaml"
    config.write_text("\n---\n".join(texts))
    return config
