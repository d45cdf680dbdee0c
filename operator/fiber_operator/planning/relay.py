"""Body of the relay's Deployment, and the selector by which the pool's Service finds its pod.

A relay passes the connections of the pool's agents to a master that pods cannot reach.  It has no
credentials and no account.  It runs the worker's command on the worker's image, so it needs no
image, no pull secret and no node that the workers do not have already.  A Deployment replaces its
pod when the pod or its node is lost.
"""

from __future__ import annotations

import copy
import hashlib
import json
from typing import Any

from fiber_api import names
from fiber_api.v1alpha1 import FiberPool
from fiber_operator.planning.documents import items, mapping
from fiber_operator.planning.manifests import owner_reference
from fiber_operator.planning.podspec import command_of, mounts_of_the_interpreter, secure

_OF_THE_POD = (
    "hostAliases",
    "imagePullSecrets",
    "nodeSelector",
    "priorityClassName",
    "runtimeClassName",
    "schedulerName",
    "securityContext",
    "tolerations",
)
"""Fields of the template's pod that decide where a pod may run, and as which user."""

_REQUESTS = {"cpu": "50m", "memory": "64Mi"}
_LIMITS = {"memory": "512Mi"}
"""A relay of 200 agents takes less than 150 MiB; the rest is for a thousand agents."""

_NODE_LOST_SECONDS = 10
"""Seconds for which the pod stays bound to a silent node: all agents wait for it."""

_HASH_LENGTH = 16


def selector(pool: FiberPool) -> dict[str, str]:
    """Return the labels of the relay's pod, and of no other pod."""
    return {names.LABEL_RELAY: pool.metadata.uid}


def deployment(pool: FiberPool) -> dict[str, Any]:
    """Return the Deployment of the pool's relay."""
    labels = {
        **selector(pool),
        names.LABEL_POOL: pool.metadata.name,
        names.LABEL_MANAGED_BY: names.OPERATOR_MANAGER,
    }
    spec = {
        "replicas": 1,
        # Never two: the master is connected to one of them, and the Service leads to both.
        "strategy": {"type": "Recreate"},
        "selector": {"matchLabels": selector(pool)},
        "template": {"metadata": {"labels": labels}, "spec": _pod_spec(pool)},
    }
    digest = hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest()
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {
            "name": names.relay_name(pool.metadata.name),
            "namespace": pool.metadata.namespace,
            "labels": labels,
            "annotations": {names.ANNOTATION_RELAY_HASH: digest[:_HASH_LENGTH]},
            "ownerReferences": [owner_reference(pool)],
        },
        "spec": spec,
    }


def is_current(existing: dict[str, Any], wanted: dict[str, Any]) -> bool:
    """Return True if an existing Deployment was written with the ``wanted`` body."""
    key = names.ANNOTATION_RELAY_HASH
    there = mapping(existing, "metadata", "annotations").get(key)
    return bool(there == wanted["metadata"]["annotations"][key])


def _pod_spec(pool: FiberPool) -> dict[str, Any]:
    template = mapping(pool.spec.template, "spec")
    worker = next(
        (
            c
            for c in items(template.get("containers"))
            if c.get("name") == pool.spec.worker_container
        ),
        {},
    )
    container = command_of(worker)
    container["name"] = names.RELAY_CONTAINER
    container["env"] = [
        {"name": names.ENV_RELAY_AGENTS_PORT, "value": str(names.MASTER_PORT)},
        {"name": names.ENV_RELAY_MASTER_PORT, "value": str(names.RELAY_PORT)},
    ]
    container["ports"] = [{"name": names.MASTER_PORT_NAME, "containerPort": names.MASTER_PORT}]
    container["resources"] = {"requests": dict(_REQUESTS), "limits": dict(_LIMITS)}
    mounts = list(mounts_of_the_interpreter(worker, container))
    container["volumeMounts"] = mounts
    mounted = {mount.get("name") for mount in mounts}
    spec: dict[str, Any] = {
        **{key: copy.deepcopy(template[key]) for key in _OF_THE_POD if template.get(key)},
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "terminationGracePeriodSeconds": 5,
        "containers": [container],
        "volumes": [
            copy.deepcopy(dict(volume))
            for volume in items(template.get("volumes"))
            if volume.get("name") in mounted
        ],
    }
    spec["tolerations"] = [
        *items(spec.get("tolerations")),
        *(
            {
                "key": f"node.kubernetes.io/{taint}",
                "operator": "Exists",
                "effect": "NoExecute",
                "tolerationSeconds": _NODE_LOST_SECONDS,
            }
            for taint in ("not-ready", "unreachable")
        ),
    ]
    secure(spec)
    return spec
