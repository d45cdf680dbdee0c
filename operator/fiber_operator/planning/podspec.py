"""The body of a worker pod: the user's template, and what Fiber adds where it says nothing.

What the user's template says wins, field by field, and what it says in a way that makes no sense
is passed on: the API server's complaint about it is better than one of ours.  Only these are not
the template's to say: the name (the agent's variable of it included), the owner, Fiber's labels, no
finalizer, and ``restartPolicy: Never``.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any

from fiber_api import names
from fiber_api.v1alpha1 import FiberPool, Master
from fiber_operator.planning import credentials, readiness
from fiber_operator.planning.documents import items, mapping, text
from fiber_operator.planning.revisions import template_hash

NODE_LOST_SECONDS = 60
"""Seconds for which a pod stays bound to a silent node.  Kubernetes' default is five minutes.  A
worker's tasks go to others after seconds, and the pool should not lack the worker for longer."""

_NODE_LOST = ("node.kubernetes.io/not-ready", "node.kubernetes.io/unreachable")
_EVICTION = "NoExecute"

_LOST_GRACE: int = Master.model_fields["lost_grace_seconds"].default

_TERMINATION_GRACE = 30
"""Seconds, where the template does not say: Kubernetes' own default."""

_POD = frozenset({"apiVersion", "kind", "metadata", "spec", "status"})
_POD_METADATA = frozenset(
    {
        "annotations",
        "creationTimestamp",
        "deletionGracePeriodSeconds",
        "deletionTimestamp",
        "finalizers",
        "generateName",
        "generation",
        "labels",
        "managedFields",
        "name",
        "namespace",
        "ownerReferences",
        "resourceVersion",
        "selfLink",
        "uid",
    }
)
"""Fields that a pod has.  Any other is passed on too: the API server says that it is misspelt."""

_TMP = "/tmp"
_TMP_VOLUME = "fiber-tmp"


def owner_reference(pool: FiberPool) -> dict[str, Any]:
    """Ties an object's life to the pool's."""
    return {
        "apiVersion": names.API_VERSION,
        "kind": names.KIND,
        "name": pool.metadata.name,
        "uid": pool.metadata.uid,
        "controller": True,
        # True needs the right to change the pool's finalizers, on clusters that check it, and
        # would let a pod that cannot end hold up the end of the pool.
        "blockOwnerDeletion": False,
    }


NO_REQUESTS: Mapping[str, str] = {}


def pod(
    pool: FiberPool, name: str, address: str, requests: Mapping[str, str] = NO_REQUESTS
) -> dict[str, Any]:
    """Return a worker pod.  ``address`` is ``host:port`` of the pool's Service.

    ``requests`` says what a worker requests of a resource that the template says nothing of.
    """
    return pod_maker(pool, address, requests)(name)


def pod_maker(
    pool: FiberPool, address: str, requests: Mapping[str, str] = NO_REQUESTS
) -> Callable[[str], dict[str, Any]]:
    """Makes worker pods by name: what is costly is done once for all of them."""
    revision = template_hash(pool)
    if pool.metadata.labels.get(names.LABEL_MANAGED_BY) == names.SDK_MANAGER:
        requests = NO_REQUESTS  # a program has settings for that
    return lambda name: _pod(pool, name, address, revision, requests)


def _pod(
    pool: FiberPool, name: str, address: str, revision: str, requests: Mapping[str, str]
) -> dict[str, Any]:
    template = copy.deepcopy(pool.spec.template)
    spec = dict(mapping(template, "spec"))
    spec["restartPolicy"] = "Never"
    _default(spec, "automountServiceAccountToken", False)
    # Else each worker gets variables for each Service of the namespace, two of every pool.
    _default(spec, "enableServiceLinks", False)
    spec["tolerations"] = _tolerations(spec.get("tolerations"))
    _secure(spec)
    variables = _variables(pool, spec, name, address, revision)
    for container in _containers(spec, "containers"):
        if container.get("name") == pool.spec.worker_container:
            _equip(spec, container, variables)
            _request(spec, container, requests)
            credentials.add(pool, spec, container)
            readiness.add(pool, spec, container)
    return {
        **_others(template, _POD),
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": _metadata(pool, mapping(template, "metadata"), name, revision),
        "spec": spec,
    }


def _metadata(
    pool: FiberPool, template: Mapping[str, Any], name: str, revision: str
) -> dict[str, Any]:
    master = pool.spec.master
    metadata = {
        **_others(template, _POD_METADATA),
        "name": name,
        "namespace": pool.metadata.namespace,
        "labels": {
            **mapping(template, "labels"),
            names.LABEL_POOL: pool.metadata.name,
            names.LABEL_POOL_UID: pool.metadata.uid,
            names.LABEL_TEMPLATE_HASH: revision,
            names.LABEL_EPOCH: str(master.epoch if master else 0),
            names.LABEL_MANAGED_BY: names.OPERATOR_MANAGER,
        },
        "ownerReferences": [owner_reference(pool)],
    }
    annotations = template.get("annotations") or {}
    if isinstance(annotations, Mapping):
        annotations = {**names.ANNOTATIONS_KEEP_NODE, **annotations}
    return {**metadata, "annotations": annotations}


def _others(document: Mapping[str, Any], known: frozenset[str]) -> dict[str, Any]:
    return {key: value for key, value in document.items() if key not in known}


def _tolerations(own: object) -> object:
    if own is not None and not isinstance(own, list):
        return own
    listed = list(own or ())
    # A toleration without a key is one of every key, and so with the effect.
    keys = {text(t.get("key")) for t in items(listed) if text(t.get("effect")) in ("", _EVICTION)}
    if "" in keys:
        return listed
    return listed + [
        {
            "key": key,
            "operator": "Exists",
            "effect": _EVICTION,
            "tolerationSeconds": NODE_LOST_SECONDS,
        }
        for key in _NODE_LOST
        if key not in keys
    ]


# Security: what the "restricted" level of Kubernetes' pod security standards asks for.


def _secure(spec: dict[str, Any]) -> None:
    context = _default(spec, "securityContext", {})
    if not isinstance(context, dict):
        return
    if context.get("runAsUser") != 0:
        _default(context, "runAsNonRoot", True)
    _default(context, "seccompProfile", {"type": "RuntimeDefault"})
    for kind in ("initContainers", "containers"):
        for container in _containers(spec, kind):
            _secure_container(container, root_is_welcome=context.get("runAsNonRoot") is not True)


def _secure_container(container: dict[str, Any], *, root_is_welcome: bool) -> None:
    context = _default(container, "securityContext", {})
    if not isinstance(context, dict) or context.get("privileged"):
        return
    if context.get("runAsUser") == 0:
        # The kubelet would refuse it for the pod's runAsNonRoot.
        _default(context, "runAsNonRoot", False)
    non_root = context.get("runAsNonRoot")
    root = root_is_welcome if non_root is None else not non_root
    added = mapping(context, "capabilities").get("add")
    if not (isinstance(added, list) and any(c in ("SYS_ADMIN", "CAP_SYS_ADMIN") for c in added)):
        _default(context, "allowPrivilegeEscalation", False)  # invalid beside that capability
    if not root:
        _default(context, "capabilities", {"drop": ["ALL"]})


# The worker's container


def _variables(
    pool: FiberPool, spec: Mapping[str, Any], name: str, address: str, revision: str
) -> dict[str, str]:
    master = pool.spec.master
    grace = master.lost_grace_seconds if master else _LOST_GRACE
    return {
        names.ENV_NAME: name,
        names.ENV_ADDRESS: address,
        names.ENV_CREDENTIALS: f"{names.CREDENTIALS_DIRECTORY}/{names.CREDENTIALS_FILE}",
        names.ENV_POOL: pool.metadata.name,
        names.ENV_NAMESPACE: pool.metadata.namespace,
        names.ENV_PROCESSES: str(pool.spec.processes_per_pod),
        names.ENV_LOST_GRACE: str(grace),
        names.ENV_TERMINATION_GRACE: str(_termination_grace(spec)),
        names.ENV_TEMPLATE_HASH: revision,
    }


def _equip(spec: dict[str, Any], container: dict[str, Any], variables: Mapping[str, str]) -> None:
    _default(container, "terminationMessagePolicy", "FallbackToLogsOnError")
    _add_environment(container, variables)
    if mapping(container, "securityContext").get("readOnlyRootFilesystem") is True:
        # The agent's sockets are in /tmp, and Python's temporary files.  Where the root can be
        # written to, the image's own /tmp does, with what the image may have put there.
        _mount(spec, container, {"name": _TMP_VOLUME, "emptyDir": {}}, _TMP)


def _request(
    spec: Mapping[str, Any], container: dict[str, Any], requests: Mapping[str, str]
) -> None:
    """Request what neither the container nor the pod as a whole speaks of."""
    resources = container.get("resources")
    asked = mapping(resources, "requests")
    # A limit is the request, too, if there is no other.
    said = {
        *asked,
        *mapping(resources, "limits"),
        *mapping(spec, "resources", "requests"),
        *mapping(spec, "resources", "limits"),
    }
    added = {kind: amount for kind, amount in requests.items() if kind not in said}
    if added and isinstance(resources or {}, Mapping):
        container["resources"] = {**(resources or {}), "requests": {**asked, **added}}


def _add_environment(container: dict[str, Any], variables: Mapping[str, str]) -> None:
    own = container.get("env")
    if own is not None and not isinstance(own, list):
        return
    # An agent by another name than its pod's could never be released.
    own = [v for v in own or () if not (isinstance(v, Mapping) and v.get("name") == names.ENV_NAME)]
    uid = {"fieldRef": {"apiVersion": "v1", "fieldPath": "metadata.uid"}}
    taken = {text(variable.get("name")) for variable in items(own)}
    # Ours first, so that the user's may refer to them.
    added: list[dict[str, Any]] = [
        {"name": key, "value": value} for key, value in variables.items()
    ]
    added.append({"name": names.ENV_UID, "valueFrom": uid})
    container["env"] = [variable for variable in added if variable["name"] not in taken] + own


def _termination_grace(spec: Mapping[str, Any]) -> int:
    own = spec.get("terminationGracePeriodSeconds")
    return own if isinstance(own, int) and own >= 0 else _TERMINATION_GRACE


def _mount(
    spec: dict[str, Any],
    container: dict[str, Any],
    volume: dict[str, Any],
    path: str,
) -> None:
    """Mount a volume, unless the template has one of that name or mounts something there."""
    volumes, mounts = spec.get("volumes") or [], container.get("volumeMounts") or []
    if not isinstance(volumes, list) or not isinstance(mounts, list):
        return
    if any(text(m.get("mountPath")).rstrip("/") == path for m in items(mounts)):
        return
    if all(v.get("name") != volume["name"] for v in items(volumes)):
        spec["volumes"] = [*volumes, volume]
    mount = {"name": volume["name"], "mountPath": path, "readOnly": False}
    container["volumeMounts"] = [*mounts, mount]


def _default(document: dict[str, Any], key: str, value: Any) -> Any:
    """Set a field that is absent or null, which is the same to the API server."""
    if document.get(key) is None:
        document[key] = value
    return document[key]


def _containers(spec: Mapping[str, Any], kind: str) -> list[dict[str, Any]]:
    listed = spec.get(kind)
    return [c for c in listed if isinstance(c, dict)] if isinstance(listed, list) else []
