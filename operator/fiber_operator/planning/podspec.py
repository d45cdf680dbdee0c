"""Body of a worker pod: the user's template, with Fiber's additions where the template is silent.

Each field of the template wins over Fiber's value.  A field that makes no sense is passed on, since
the API server's complaint about it is the better one.  The operator alone sets the pod's name and
the environment variable with that name, the owner, Fiber's labels, the absence of finalizers, and
``restartPolicy: Never``.

An init container gives each agent a separate key and hides the pool's key from tasks.  It mounts
the pool's Secret, makes the agent's key, which proves the pod's name and uid, and writes that key
to a volume in memory.  The agent reads the file and removes it.  The init container runs the
worker's command on the worker's image, without the volumes, environment and working directory of
the template, because a task could have written to these.  The exception is a volume that the
command names, because the interpreter is on it.

A startup probe waits until a master has answered the agent.  After that the agent serves a master,
waits for the next one, or ends; so the probe succeeds once and costs nothing afterwards.  A pod
that is created while its pool has no living master has no such probe.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from fiber_api import names
from fiber_api.v1alpha1 import FiberPool, MasterSpec
from fiber_operator.planning.assessment import awaits_agents
from fiber_operator.planning.documents import items, mapping, text
from fiber_operator.planning.manifests import is_of_a_program, owner_reference, template_hash
from fiber_operator.planning.pods import PROBE_PROGRAM

NODE_LOST_SECONDS = 60
"""Seconds for which a pod stays bound to a silent node.  Kubernetes' default is five minutes.  The
worker's tasks go to other workers after seconds, and the pool should get a new worker soon, too."""

_NODE_LOST = ("node.kubernetes.io/not-ready", "node.kubernetes.io/unreachable")
_EVICTION = "NoExecute"

_LOST_GRACE: int = MasterSpec.model_fields["lost_grace_seconds"].default

_TERMINATION_GRACE = 30
"""Kubernetes' default of ``terminationGracePeriodSeconds``."""

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
"""Fields of a pod's metadata.  Others are passed on: the API server reports misspelt fields."""

_TMP = "/tmp"
_TMP_VOLUME = "fiber-tmp"


NO_REQUESTS: Mapping[str, str] = {}


def pod(
    pool: FiberPool, name: str, address: str, requests: Mapping[str, str] = NO_REQUESTS
) -> dict[str, Any]:
    """Return a worker pod.  ``address`` is ``host:port`` of the pool's Service.

    ``requests`` are requests for resources that the template does not mention.
    """
    return pod_maker(pool, address, requests)(name)


def pod_maker(
    pool: FiberPool, address: str, requests: Mapping[str, str] = NO_REQUESTS
) -> Callable[[str], dict[str, Any]]:
    """Return a function that makes a worker pod by name, with costly work done only once."""
    revision = template_hash(pool)
    if is_of_a_program(pool):
        requests = NO_REQUESTS  # a program has its own settings for these
    return lambda name: _pod(pool, name, address, revision, requests)


def _pod(
    pool: FiberPool, name: str, address: str, revision: str, requests: Mapping[str, str]
) -> dict[str, Any]:
    template = copy.deepcopy(pool.spec.template)
    spec = dict(mapping(template, "spec"))
    spec["restartPolicy"] = "Never"
    _default(spec, "automountServiceAccountToken", False)
    # Else each worker would get environment variables for each Service of the namespace.
    _default(spec, "enableServiceLinks", False)
    spec["tolerations"] = _tolerations(spec.get("tolerations"))
    secure(spec)
    variables = _variables(pool, spec, name, address, revision)
    for container in _containers(spec, "containers"):
        if container.get("name") == pool.spec.worker_container:
            _equip(spec, container, variables)
            _request(spec, container, requests)
            _add_identity_container(pool, spec, container)
            _add_startup_probe(pool, spec, container)
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
    # A toleration without a key or effect tolerates every key or effect.
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


# Security, as the "restricted" level of Kubernetes' pod security standards demands.


def secure(spec: dict[str, Any]) -> None:
    """Add the security contexts that the template leaves out."""
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
        # Else the kubelet would refuse it because of the pod's runAsNonRoot.
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
        names.ENV_CREDENTIALS: _CREDENTIALS,
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
        # The agent's sockets and Python's temporary files are in /tmp.  With a writable root the
        # image's /tmp is used, together with its files.
        _mount(spec, container, {"name": _TMP_VOLUME, "emptyDir": {}}, _TMP)


def _request(
    spec: Mapping[str, Any], container: dict[str, Any], requests: Mapping[str, str]
) -> None:
    """Add requests for resources that neither the container nor the pod mentions."""
    resources = container.get("resources")
    asked = mapping(resources, "requests")
    # A limit is also the request if there is no request.
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
    # An agent with another name than its pod's could never be released.
    own = [v for v in own or () if not (isinstance(v, Mapping) and v.get("name") == names.ENV_NAME)]
    uid = {"fieldRef": {"apiVersion": "v1", "fieldPath": "metadata.uid"}}
    taken = {text(variable.get("name")) for variable in items(own)}
    # Fiber's variables first, so that the user's may refer to them.
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
    """Mount a volume, unless the template has a volume of that name or a mount at that path."""
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
    """Set a field if it is absent or null, which are the same to the API server."""
    if document.get(key) is None:
        document[key] = value
    return document[key]


def _containers(spec: Mapping[str, Any], kind: str) -> list[dict[str, Any]]:
    listed = spec.get(kind)
    return [c for c in listed if isinstance(c, dict)] if isinstance(listed, list) else []


# -- The init container

_LIKE_THE_WORKER = (
    "args",
    "command",
    "image",
    "imagePullPolicy",
    "securityContext",
    "terminationMessagePolicy",
)

_AGENT = "fiber.agent"

_ASKED_FOR = ("cpu", "memory", "ephemeral-storage")
"""Resources that the init container requests as the worker does.

A pod requests the maximum of its init containers and its containers, so this costs nothing, and it
meets every quota and limit range that the worker meets.  Devices are not needed."""

_CREDENTIALS = f"{names.CREDENTIALS_DIRECTORY}/{names.CREDENTIALS_FILE}"


def _add_identity_container(pool: FiberPool, spec: dict[str, Any], worker: dict[str, Any]) -> None:
    """Add the init container to the pod, and its mount to the ``worker`` container."""
    volumes, first = spec.get("volumes") or [], spec.get("initContainers") or []
    mounts = worker.get("volumeMounts") or []
    if not (isinstance(volumes, list) and isinstance(first, list) and isinstance(mounts, list)):
        return
    if any(
        text(m.get("mountPath")).rstrip("/") == names.CREDENTIALS_DIRECTORY for m in items(mounts)
    ):
        return  # the template provides the credentials
    spec["volumes"] = [
        *volumes,
        {
            "name": names.KEY_VOLUME,
            # The image may run as any user, so all may read the file; no other container mounts it.
            "secret": {"secretName": pool.credentials_secret, "defaultMode": 0o444},
        },
        {"name": names.CREDENTIALS_VOLUME, "emptyDir": {"medium": "Memory", "sizeLimit": "1Mi"}},
    ]
    mount = {"name": names.CREDENTIALS_VOLUME, "mountPath": names.CREDENTIALS_DIRECTORY}
    spec["initContainers"] = [_identity_container(pool, worker, mount), *first]
    worker["volumeMounts"] = [*mounts, mount]


def command_of(worker: Mapping[str, Any]) -> dict[str, Any]:
    """Return image, command and security context of a container that runs Fiber as ``worker`` does.

    Variables of the environment then say what Fiber does there.
    """
    made = {k: copy.deepcopy(worker[k]) for k in _LIKE_THE_WORKER if worker.get(k) is not None}
    if not _runs_the_agent(worker):
        made.pop("args", None)
        made["command"] = ["python", "-m", _AGENT]
    return made


def _identity_container(
    pool: FiberPool, worker: Mapping[str, Any], written: Mapping[str, Any]
) -> dict[str, Any]:
    made = command_of(worker)
    made["name"] = names.IDENTITY_CONTAINER
    made["volumeMounts"] = [
        *mounts_of_the_interpreter(worker, made),
        dict(written),
        {"name": names.KEY_VOLUME, "mountPath": names.KEY_DIRECTORY, "readOnly": True},
    ]
    if resources := _resources(worker):
        made["resources"] = resources
    made["env"] = [
        {"name": names.ENV_KEY, "value": names.KEY_DIRECTORY},
        {"name": names.ENV_CREDENTIALS, "value": _CREDENTIALS},
        {"name": names.ENV_EPOCH, "value": str(_highest_epoch(pool))},
        {"name": names.ENV_POOL_UID, "value": pool.metadata.uid},
        _of_the_pod(names.ENV_NAME, "metadata.name"),
        _of_the_pod(names.ENV_UID, "metadata.uid"),
    ]
    return made


def _highest_epoch(pool: FiberPool) -> int:
    present = pool.spec.master.epoch if pool.spec.master else 0
    return max(present, pool.status.master_epoch or 0)


def mounts_of_the_interpreter(
    worker: Mapping[str, Any], made: Mapping[str, Any]
) -> Iterator[dict[str, Any]]:
    """Yield the mounts that the command needs because it names a path on them."""
    command = str([made.get("command"), made.get("args")])
    for mount in items(worker.get("volumeMounts")):
        path = text(mount.get("mountPath")).rstrip("/")
        if path and f"{path}/" in command:
            yield {**copy.deepcopy(dict(mount)), "readOnly": True}


def _runs_the_agent(worker: Mapping[str, Any]) -> bool:
    """Return True if the worker container runs the agent, by its command or its image."""
    words = [worker.get("command"), worker.get("args")]
    return not any(words) or _AGENT in str(words)


def _resources(worker: Mapping[str, Any]) -> dict[str, Any]:
    found = {}
    for kind in ("limits", "requests"):
        asked = mapping(worker, "resources", kind)
        if kept := {name: asked[name] for name in _ASKED_FOR if name in asked}:
            found[kind] = kept
    return found


def _of_the_pod(name: str, field: str) -> dict[str, Any]:
    return {"name": name, "valueFrom": {"fieldRef": {"apiVersion": "v1", "fieldPath": field}}}


# -- The startup probe

_LINKED_FILE = f"{names.CREDENTIALS_DIRECTORY}/{names.LINKED_FILE}"

_SCRIPT = """\
import os, sys, time
for _ in range(200):
    if os.path.exists(sys.argv[1]):
        sys.exit()
    time.sleep(0.1)
sys.exit("no master has answered the agent yet; the log of the pod may say why")
"""
"""Program of the probe.  One sleeping process is cheaper and faster than one process a second."""

_PROBE: Mapping[str, Any] = {
    # Without the site module the interpreter starts in a hundredth of a second.
    "exec": {"command": [PROBE_PROGRAM, "-ISc", _SCRIPT, _LINKED_FILE]},
    "initialDelaySeconds": 1,  # leaves the processor to the starting agent
    "periodSeconds": 2,
    "timeoutSeconds": 30,
    "failureThreshold": 2**31 - 1,  # the probe must not end a pod
}


def _add_startup_probe(pool: FiberPool, spec: Mapping[str, Any], worker: dict[str, Any]) -> None:
    """Add the probe to the ``worker`` container if that is known to run Fiber's agent."""
    first = next(items(spec.get("initContainers") or ()), {})
    if first.get("name") != names.IDENTITY_CONTAINER or not _runs_the_agent(worker):
        return
    if not awaits_agents(pool) or worker.get("startupProbe") is not None:
        return
    if not isinstance(worker.get("env"), list):
        return
    worker["startupProbe"] = dict(_PROBE)
    worker["env"] = [{"name": names.ENV_LINKED, "value": _LINKED_FILE}, *worker["env"]]
