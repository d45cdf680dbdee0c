"""Body of the relay's Deployment, and when there is one.

A relay passes the connections of the pool's agents to a master that pods cannot reach.  It has no
credentials, no account and no privilege.  It runs the worker's command on the worker's image, so it
needs no image, no pull secret and no node that the workers do not have already.  A Deployment
replaces its pod when the pod or its node is lost.

All workers depend on the relay.  So a relay of a template that works stays until the pool's present
template has proven to work, too.
"""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from fiber_api import names
from fiber_api.v1alpha1 import FiberPool
from fiber_operator.planning.documents import items, mapping, text
from fiber_operator.planning.manifests import owner_reference, relay_selector, template_hash
from fiber_operator.planning.podspec import command_of, mounts_of_the_interpreter, secure

_OF_THE_POD = (
    "imagePullSecrets",
    "nodeSelector",
    "priorityClassName",
    "runtimeClassName",
    "schedulerName",
    "serviceAccountName",
)
"""Fields of the template's pod that decide where a pod may run.  The account is there for its pull
secrets: the pod gets no token."""

_OF_THE_SECURITY_CONTEXT = (
    "fsGroup",
    "fsGroupChangePolicy",
    "readOnlyRootFilesystem",
    "runAsGroup",
    "runAsNonRoot",
    "runAsUser",
    "seLinuxOptions",
    "supplementalGroups",
)
"""Fields of a security context that say as which user a container runs.  The others give rights
over the node or the network, and a relay needs none."""

_REQUESTS = {"cpu": "50m", "memory": "64Mi"}
_LIMITS = {"memory": "512Mi"}
"""A relay of 200 agents takes less than 150 MiB; the rest is for a thousand agents."""

_LIMITS_LIKE_THE_WORKERS = {"cpu": "1", "ephemeral-storage": "64Mi"}
"""Limits that the relay has if the worker has them, since a quota may demand them of each pod."""

_NODE_LOST_SECONDS = 10
"""Seconds for which the pod stays bound to a silent node: all agents wait for it."""

_REPLICAS = 1
"""Never two: the master is connected to one of them, and the Service leads to both."""

_HASH_LENGTH = 16


def is_wanted(pool: FiberPool) -> bool:
    """Return True if the pool is to have a relay.  A suspended one keeps it for its last pods."""
    pods = (pool.status.replicas or 0) + (pool.status.terminating_replicas or 0)
    return pool.spec.relay and (not pool.spec.suspend or pods > 0)


def deployment(pool: FiberPool) -> dict[str, Any]:
    """Return the Deployment of the pool's relay."""
    # Without the label of the pool, by which people and commands of messages select workers.
    labels = {**relay_selector(pool), names.LABEL_MANAGED_BY: names.OPERATOR_MANAGER}
    spec = {
        "replicas": _REPLICAS,
        "strategy": {"type": "Recreate"},
        "selector": {"matchLabels": relay_selector(pool)},
        "template": {"metadata": {"labels": labels}, "spec": _pod_spec(pool)},
    }
    digest = hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest()
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {
            "name": names.relay_name(pool.metadata.name),
            "namespace": pool.metadata.namespace,
            "labels": {
                **labels,
                names.LABEL_POOL: pool.metadata.name,
                names.LABEL_TEMPLATE_HASH: template_hash(pool),
            },
            "annotations": {names.ANNOTATION_RELAY_HASH: digest[:_HASH_LENGTH]},
            "ownerReferences": [owner_reference(pool)],
        },
        "spec": spec,
    }


def may_stay(pool: FiberPool, existing: Mapping[str, Any], wanted: Mapping[str, Any]) -> bool:
    """Return True if the existing Deployment is as ``wanted``, or the new one could be worse."""
    revision = _revision(existing)
    proven = pool.status.proven_template_hash
    if proven is not None and revision == proven != _revision(wanted):
        return True
    same = revision == _revision(wanted) and _digest(existing) == _digest(wanted)
    return same and mapping(existing, "spec").get("replicas") == _REPLICAS


def is_observed(existing: Mapping[str, Any]) -> bool:
    """Return True if the cluster has acted on the Deployment as it is."""
    generation = mapping(existing, "metadata").get("generation")
    return mapping(existing, "status").get("observedGeneration", 0) == generation


def refusal(existing: Mapping[str, Any]) -> str:
    """Return why the pod of the Deployment is not created; empty if nothing prevents that."""
    for condition in items(mapping(existing, "status").get("conditions")):
        if condition.get("type") == "ReplicaFailure" and condition.get("status") == "True":
            return text(condition.get("message")) or "its Deployment does not say why"
    return ""


def _revision(document: Mapping[str, Any]) -> str:
    return text(mapping(document, "metadata", "labels").get(names.LABEL_TEMPLATE_HASH))


def _digest(document: Mapping[str, Any]) -> str:
    annotations = mapping(document, "metadata", "annotations")
    return text(annotations.get(names.ANNOTATION_RELAY_HASH))


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
    container["resources"] = _resources(worker)
    container["securityContext"] = _context(worker)
    mounts = list(mounts_of_the_interpreter(worker, container))
    container["volumeMounts"] = mounts
    mounted = [mount.get("name") for mount in mounts]
    volumes = items(template.get("volumes"))
    spec: dict[str, Any] = {
        **{key: copy.deepcopy(template[key]) for key in _OF_THE_POD if template.get(key)},
        "securityContext": _context(template),
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "terminationGracePeriodSeconds": 5,
        "containers": [container],
        "tolerations": [*_leaves_lost_nodes(), *_copied(items(template.get("tolerations")))],
        "volumes": _copied(volume for volume in volumes if volume.get("name") in mounted),
    }
    # The image may be for some processors only.  Affinity to other pods is the workers' own.
    if nodes := mapping(template, "affinity", "nodeAffinity"):
        spec["affinity"] = {"nodeAffinity": copy.deepcopy(dict(nodes))}
    secure(spec)
    return spec


def _copied(documents: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [copy.deepcopy(dict(document)) for document in documents]


def _context(document: Mapping[str, Any]) -> dict[str, Any]:
    given = mapping(document, "securityContext")
    return {key: copy.deepcopy(given[key]) for key in _OF_THE_SECURITY_CONTEXT if key in given}


def _resources(worker: Mapping[str, Any]) -> dict[str, Any]:
    limited = mapping(worker, "resources", "limits")
    more = {kind: most for kind, most in _LIMITS_LIKE_THE_WORKERS.items() if kind in limited}
    return {"requests": dict(_REQUESTS), "limits": {**_LIMITS, **more}}


def _leaves_lost_nodes() -> Iterator[dict[str, Any]]:
    """Yield tolerations that come first, as Kubernetes applies the first one that fits a taint."""
    for taint in ("not-ready", "unreachable"):
        yield {
            "key": f"node.kubernetes.io/{taint}",
            "operator": "Exists",
            "effect": "NoExecute",
            "tolerationSeconds": _NODE_LOST_SECONDS,
        }
