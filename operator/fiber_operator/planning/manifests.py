"""Bodies of the objects that the operator creates beside pods, and hashes of the spec.

Every function returns a new JSON document with ``apiVersion`` and ``kind``.  Each object has the
pool as its owner and no finalizer, so Kubernetes deletes it together with the pool.  ``podspec``
makes the bodies of pods.
"""

from __future__ import annotations

import base64
import hashlib
import ipaddress
import json
from collections.abc import Mapping
from typing import Any

from fiber_api import names
from fiber_api.v1alpha1 import FiberPool, MasterSpec
from fiber_operator.planning.documents import items, mapping, text


def selector(pool: FiberPool) -> str:
    """Return the label selector of the pool's pods.  An earlier pool of that name had another."""
    return f"{names.LABEL_POOL_UID}={pool.metadata.uid}"


def service(pool: FiberPool) -> dict[str, Any]:
    """Return the Service that agents dial.  It has a selector only if it leads to a relay.

    It has both IP families if the cluster has both: the master may have either, and agents dial
    both.
    """
    port = {
        "name": names.MASTER_PORT_NAME,
        "port": names.MASTER_PORT,
        "targetPort": names.MASTER_PORT,
        "protocol": "TCP",
    }
    spec = {"type": "ClusterIP", "ipFamilyPolicy": "PreferDualStack", "ports": [port]}
    return {
        "apiVersion": "v1",
        "kind": "Service",
        "metadata": _metadata(pool, names.service_name(pool.metadata.name)),
        "spec": {**spec, "selector": relay_selector(pool)} if pool.spec.relay else spec,
    }


def relay_selector(pool: FiberPool) -> dict[str, str]:
    """Return the labels of the relay's pod, and of no other pod."""
    return {names.LABEL_RELAY: pool.metadata.uid}


def selector_patch(pool: FiberPool, there: Mapping[str, Any]) -> dict[str, Any]:
    """Return the merge patch of the Service's spec that corrects the selector ``there``.

    The relay's selector stays when the relay goes.  Kubernetes then removes the pod's address from
    the Service, which it would not do for a Service without a selector.
    """
    relays = relay_selector(pool)
    if there == relays or not (there or pool.spec.relay):
        return {}
    return {"selector": {**dict.fromkeys(there), **relays} if pool.spec.relay else None}


def endpoint_slice(pool: FiberPool) -> dict[str, Any]:
    """Return the Service's only EndpointSlice, with the master's address if there is a master."""
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
        # With a relay, the Service selects the relay's pod instead.
        "endpoints": [] if pool.spec.relay else _endpoints(pool.spec.master),
        "ports": _ports(pool.spec.master),
    }


def budget(pool: FiberPool) -> dict[str, Any]:
    """Return the PodDisruptionBudget of the pool's workers."""
    return {
        "apiVersion": "policy/v1",
        "kind": "PodDisruptionBudget",
        "metadata": _metadata(pool, names.budget_name(pool.metadata.name)),
        "spec": {
            "minAvailable": pool.spec.min_available,
            "selector": {"matchLabels": {names.LABEL_POOL_UID: pool.metadata.uid}},
            # A worker that does not become ready must not hold up a drain.
            "unhealthyPodEvictionPolicy": "AlwaysAllow",
        },
    }


def secret(pool: FiberPool, data: Mapping[str, str]) -> dict[str, Any]:
    """Return the Secret with the pool's key.  ``data`` maps the names of its keys to plain text."""
    return {
        "apiVersion": "v1",
        "kind": "Secret",
        "metadata": _metadata(pool, names.secret_name(pool.metadata.name)),
        "type": "Opaque",
        "data": {key: base64.b64encode(text.encode()).decode() for key, text in data.items()},
    }


def is_of_a_program(pool: FiberPool) -> bool:
    """Return True if a program made the pool for itself."""
    return pool.metadata.labels.get(names.LABEL_MANAGED_BY) == names.SDK_MANAGER


def is_ours(pool: FiberPool, existing: Mapping[str, Any]) -> bool:
    """Return True if an existing object was made for this pool."""
    owners = items(mapping(existing, "metadata").get("ownerReferences"))
    return any(o.get("uid") == pool.metadata.uid and o.get("controller") is True for o in owners)


def other_owner(pool: FiberPool, secret: Mapping[str, Any]) -> str | None:
    """Return the name of the other FiberPool that this Secret belongs to; None if there is none."""
    metadata = mapping(secret, "metadata")
    owners = [o for o in items(metadata.get("ownerReferences")) if o.get("kind") == names.KIND]
    for owner in owners:
        if owner.get("uid") != pool.metadata.uid:
            return text(owner.get("name"))
    named = text(mapping(metadata, "labels").get(names.LABEL_POOL))
    return named if named and not owners and named != pool.metadata.name else None


def slice_patch(pool: FiberPool, existing: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the merge patch that points an EndpointSlice to the master; None if it already does.

    ``addressType`` is immutable: see ``slice_must_be_replaced``.
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
    """Return True if the master moved between IPv4 and IPv6, so that a new slice is needed."""
    master = pool.spec.master
    return master is not None and existing.get("addressType") != _family(master)


def owner_reference(pool: FiberPool) -> dict[str, Any]:
    """Return the owner reference by which Kubernetes deletes an object together with the pool."""
    return {
        "apiVersion": names.API_VERSION,
        "kind": names.KIND,
        "name": pool.metadata.name,
        "uid": pool.metadata.uid,
        "controller": True,
        # True would need the right to change the pool's finalizers on clusters that check it, and
        # a pod that cannot end would hold up the pool's deletion.
        "blockOwnerDeletion": False,
    }


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


def _family(master: MasterSpec | None) -> str:
    if master is None:
        return "IPv4"
    return f"IPv{ipaddress.ip_address(master.host).version}"


def _endpoints(master: MasterSpec | None) -> list[dict[str, Any]]:
    if master is None:
        return []
    # Ready even if the master's Lease has expired: a connection fails sooner than a Lease expires,
    # and a master that was only slow is found at once.
    conditions = {"ready": True, "serving": True, "terminating": False}
    return [{"addresses": [master.host], "conditions": conditions}]


def _ports(master: MasterSpec | None) -> list[dict[str, Any]]:
    if master is None:
        return []
    return [{"name": names.MASTER_PORT_NAME, "port": master.port, "protocol": "TCP"}]


def _leads_to(document: Mapping[str, Any]) -> tuple[list[Any], list[Any]]:
    """Return addresses and ports of a slice, without fields that the API server may have added."""
    addresses = [
        (endpoint.get("addresses"), mapping(endpoint, "conditions").get("ready"))
        for endpoint in items(document.get("endpoints"))
    ]
    ports = [(text(p.get("name")), p.get("port")) for p in items(document.get("ports"))]
    return addresses, ports


# -- Hashes

_LENGTH = 16
"""Hexadecimal digits of a hash: few enough for a label, enough for the revisions of one pool."""


def template_hash(pool: FiberPool) -> str:
    """Return a hash of the template and of the number of processes in each pod.

    It does not depend on fields that the operator adds, so that a new operator replaces no pod, or
    on fields that the SDK writes.
    """
    return _digest({"template": pool.spec.template, "processes": pool.spec.processes_per_pod})


def spec_hash(pool: FiberPool) -> str:
    """Return a hash of the fields that a user or a new master changes to revive a failed pool.

    It does not depend on ``replicas`` and ``release``, which the SDK writes all the time.
    """
    spec = pool.spec
    return _digest(
        {
            "template": spec.template,
            "processes": spec.processes_per_pod,
            "container": spec.worker_container,
            "failures": spec.failure_policy.model_dump(),
            "update": spec.update.model_dump(),
            "suspend": spec.suspend,
            "epoch": spec.master.epoch if spec.master else None,
        }
    )


def _digest(document: dict[str, Any]) -> str:
    canonical = json.dumps(document, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()[:_LENGTH]
