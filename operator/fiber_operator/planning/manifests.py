"""The bodies of what the operator makes.

Every function returns a new plain JSON document with ``apiVersion`` and ``kind``.  Each object has
the pool as its controller, so that deleting the pool deletes it with nobody's help, and no
finalizer.  ``podspec`` has the pod.
"""

from __future__ import annotations

import base64
import ipaddress
from collections.abc import Mapping
from typing import Any

from fiber_api import names
from fiber_api.v1alpha1 import FiberPool, Master
from fiber_operator.planning.documents import items, mapping, text
from fiber_operator.planning.podspec import owner_reference, pod, pod_maker
from fiber_operator.planning.revisions import template_hash

__all__ = [
    "budget",
    "endpoint_slice",
    "is_ours",
    "other_owner",
    "pod",
    "pod_maker",
    "secret",
    "selector",
    "service",
    "slice_must_be_replaced",
    "slice_patch",
    "template_hash",
]


def selector(pool: FiberPool) -> str:
    """The label selector of the pool's pods; an earlier pool of the same name has another."""
    return f"{names.LABEL_POOL_UID}={pool.metadata.uid}"


def service(pool: FiberPool) -> dict[str, Any]:
    """The Service without a selector that agents dial, of both IP families if the cluster has both.

    The master may be of either, and agents dial both.
    """
    port = {
        "name": names.MASTER_PORT_NAME,
        "port": names.MASTER_PORT,
        "targetPort": names.MASTER_PORT,
        "protocol": "TCP",
    }
    return {
        "apiVersion": "v1",
        "kind": "Service",
        "metadata": _metadata(pool, names.service_name(pool.metadata.name)),
        "spec": {"type": "ClusterIP", "ipFamilyPolicy": "PreferDualStack", "ports": [port]},
    }


def endpoint_slice(pool: FiberPool) -> dict[str, Any]:
    """The one EndpointSlice of the Service: the master's address, or no endpoint."""
    metadata = _metadata(pool, names.endpoint_slice_name(pool.metadata.name))
    metadata["labels"] |= {
        names.LABEL_SERVICE_NAME: names.service_name(pool.metadata.name),
        names.LABEL_SLICE_MANAGED_BY: names.OPERATOR_MANAGER,
    }
    return {
        "apiVersion": "discovery.k8s.io/v1",
        "kind": "EndpointSlice",
        "metadata": metadata,
        "addressType": _family(pool.spec.master),
        "endpoints": _endpoints(pool.spec.master),
        "ports": _ports(pool.spec.master),
    }


def budget(pool: FiberPool) -> dict[str, Any]:
    """The PodDisruptionBudget of the pool's workers."""
    return {
        "apiVersion": "policy/v1",
        "kind": "PodDisruptionBudget",
        "metadata": _metadata(pool, names.budget_name(pool.metadata.name)),
        "spec": {
            "minAvailable": pool.spec.min_available,
            "selector": {"matchLabels": {names.LABEL_POOL_UID: pool.metadata.uid}},
            # A worker that does not get ready holds up no drain.
            "unhealthyPodEvictionPolicy": "AlwaysAllow",
        },
    }


def secret(pool: FiberPool, data: Mapping[str, str]) -> dict[str, Any]:
    """The credentials Secret; ``data`` maps the keys of ``fiber_api.names`` to plain text."""
    return {
        "apiVersion": "v1",
        "kind": "Secret",
        "metadata": _metadata(pool, names.secret_name(pool.metadata.name)),
        "type": "Opaque",
        "data": {key: base64.b64encode(text.encode()).decode() for key, text in data.items()},
    }


def is_ours(pool: FiberPool, existing: Mapping[str, Any]) -> bool:
    """Tell whether an object that already has the name was made for this pool."""
    owners = items(mapping(existing, "metadata").get("ownerReferences"))
    return any(o.get("uid") == pool.metadata.uid and o.get("controller") is True for o in owners)


def other_owner(pool: FiberPool, secret: Mapping[str, Any]) -> str | None:
    """The name of another FiberPool whose Secret this is."""
    metadata = mapping(secret, "metadata")
    owners = [o for o in items(metadata.get("ownerReferences")) if o.get("kind") == names.KIND]
    for owner in owners:
        if owner.get("uid") != pool.metadata.uid:
            return text(owner.get("name"))
    named = text(mapping(metadata, "labels").get(names.LABEL_POOL))
    return named if named and not owners and named != pool.metadata.name else None


def slice_patch(pool: FiberPool, existing: Mapping[str, Any]) -> dict[str, Any] | None:
    """The merge patch that points an existing EndpointSlice to the master; None if it does.

    It cannot change ``addressType``, which is immutable: see ``slice_must_be_replaced``.
    """
    wanted = endpoint_slice(pool)
    labels = wanted["metadata"]["labels"]
    there = mapping(existing, "metadata", "labels")
    if _leads_to(existing) == _leads_to(wanted) and labels.items() <= there.items():
        return None
    return {
        "metadata": {"labels": labels},
        "endpoints": wanted["endpoints"],
        "ports": wanted["ports"],
    }


def slice_must_be_replaced(pool: FiberPool, existing: Mapping[str, Any]) -> bool:
    """Tell whether the master moved between IPv4 and IPv6: make the slice anew then."""
    master = pool.spec.master
    return master is not None and existing.get("addressType") != _family(master)


def _metadata(pool: FiberPool, name: str) -> dict[str, Any]:
    return {
        "name": name,
        "namespace": pool.metadata.namespace,
        "labels": {
            names.LABEL_POOL: pool.metadata.name,
            names.LABEL_POOL_UID: pool.metadata.uid,
            names.LABEL_MANAGED_BY: names.OPERATOR_MANAGER,
        },
        "ownerReferences": [owner_reference(pool)],
    }


def _family(master: Master | None) -> str:
    if master is None:
        return "IPv4"
    return f"IPv{ipaddress.ip_address(master.host).version}"


def _endpoints(master: Master | None) -> list[dict[str, Any]]:
    if master is None:
        return []
    # Ready even where the master's Lease has expired: whoever dials finds out sooner than a Lease
    # does, and a master that was only slow is found at once.
    conditions = {"ready": True, "serving": True, "terminating": False}
    return [{"addresses": [master.host], "conditions": conditions}]


def _ports(master: Master | None) -> list[dict[str, Any]]:
    if master is None:
        return []
    return [{"name": names.MASTER_PORT_NAME, "port": master.port, "protocol": "TCP"}]


def _leads_to(document: Mapping[str, Any]) -> tuple[list[Any], list[Any]]:
    """Return addresses and ports of a slice, without what the API server may have added."""
    addresses = [
        (endpoint.get("addresses"), mapping(endpoint, "conditions").get("ready"))
        for endpoint in items(document.get("endpoints"))
    ]
    ports = [(text(p.get("name")), p.get("port")) for p in items(document.get("ports"))]
    return addresses, ports
