"""Pod template of a shape, and the FiberPool with it.

Workers have what their program has. If the program runs in a pod, the worker's container is a copy
of the program's container: image, environment, volumes, account, without the parts that belong to
one pod. Elsewhere the configured image is used. The resources that functions ask for are added, and
the user's own template overrides everything.

``merge_template`` follows kubectl's strategic merge. Lists of named things are merged by name.
Fields of containers are merged one by one. A volume, a variable or a mount replaces its namesake.
Other lists are replaced. None removes a field, and ``$patch: delete`` removes a named thing.
"""

from __future__ import annotations

import copy
import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from fiber._backends.kubernetes.published import SET_IMAGE, reason_for_no_image, worker_image
from fiber.config import Config
from fiber.errors import ConfigError
from fiber.resources import GPU, Resources, merged, wished
from fiber_api import names

Document = dict[str, Any]

_SHM = "/dev/shm"
_SHM_VOLUME = "fiber-shm"

_AGENT = ("-m", "fiber.agent")


class ImageMissing(ConfigError):
    """Error for a program without an image, in a build that has no published one."""


# ---- the pod template -----------------------------------------------------------------------


def pod_template(
    shape: PodShape, own_pod: Mapping[str, Any] | None, container: str, python: str = "python"
) -> Document:
    """Return the template of a shape's pods; ImageMissing if they would have no image.

    ``own_pod``: pod of this program, or None.  ``container`` and ``python``: container of the
    program in that pod, and its interpreter there.
    """
    spec = _like(own_pod, container) if own_pod is not None else _elsewhere()
    worker = spec["containers"][0]
    own_image = worker["image"] if own_pod is not None else None
    if shape.image is not None and shape.image != worker.get("image"):
        worker["image"] = shape.image
        worker.pop("imagePullPolicy", None)  # of the image before
    _ask_for(worker, shape)
    _place(spec, shape.resources)
    if shape.shm is not None:
        _give_shm(spec, worker, shape.shm)
    template = merge_template({"spec": spec}, json.loads(shape.template))
    for worker in _workers(template):
        _check_image(worker)
        _request_the_rest(worker, shape)
        if not ("command" in worker or "args" in worker):
            # The default command of the image may be the program, which must not start again.
            interpreter = python if worker.get("image") == own_image else "python"
            worker["command"] = [interpreter, *_AGENT]
    return template


def _elsewhere() -> Document:
    image = worker_image()
    published = {} if image is None else {"image": image}
    return {"containers": [{"name": names.WORKER_CONTAINER, **published}]}


def _check_image(worker: Document) -> None:
    if not worker.get("image"):
        raise ImageMissing(
            f"there is no image for workers: {reason_for_no_image()}. To run on pods, {SET_IMAGE}"
        )


def _workers(template: Document) -> Iterator[Document]:
    for container in template["spec"].get("containers") or ():
        if container.get("name") == names.WORKER_CONTAINER:
            yield container


def _ask_for(worker: Document, shape: PodShape) -> None:
    """Set requests and limits to the resources that functions ask for, for each process."""
    wishes, processes, requests = shape.resources, shape.processes_per_pod, {}
    if wishes.cpu is not None:
        requests["cpu"] = quantity(wishes.cpu * processes)
    if wishes.memory is not None:  # files in /dev/shm count as memory
        requests["memory"] = f"{wishes.memory * processes + (shape.shm or 0)}Mi"
    limits = dict(requests)
    for name, amount in ((GPU, wishes.gpu or 0), *wishes.extended):
        if amount:
            limits[name] = str(amount * processes)  # the request is the same
    if limits:
        worker["resources"] = {"limits": limits, **({"requests": requests} if requests else {})}


def _request_the_rest(worker: Document, shape: PodShape) -> None:
    """Add configured requests for resources that no function and no template mentions."""
    resources = worker.get("resources") or {}
    memory = shape.memory_request * shape.processes_per_pod + (shape.shm or 0)
    requests = {
        "cpu": quantity(shape.cpu_request * shape.processes_per_pod) if shape.cpu_request else "",
        "memory": f"{memory}Mi" if memory else "",
    }
    # A limit without a request is also the request.
    said = {*(resources.get("requests") or ()), *(resources.get("limits") or ())}
    added = {kind: amount for kind, amount in requests.items() if amount and kind not in said}
    if added:
        asked = {**(resources.get("requests") or {}), **added}
        worker["resources"] = {**resources, "requests": asked}


def _place(spec: Document, wishes: Resources) -> None:
    """Add the node selector and tolerations that functions ask for."""
    if wishes.node_selector:
        spec["nodeSelector"] = {**(spec.get("nodeSelector") or {}), **dict(wishes.node_selector)}
    there = spec.get("tolerations") or []
    added = [dict(one) for one in wishes.tolerations]
    _set(spec, "tolerations", [*there, *(one for one in added if one not in there)])


def _give_shm(spec: Document, worker: Document, size: int) -> None:
    """Mount memory of ``size`` MiB at /dev/shm, in place of the program's mount there."""
    mounts = [m for m in worker.get("volumeMounts") or () if m["mountPath"].rstrip("/") != _SHM]
    used = {m["name"] for m in (*mounts, *(worker.get("volumeDevices") or ()))}
    volumes = [v for v in spec.get("volumes") or () if v["name"] in used]
    memory = {"medium": "Memory", "sizeLimit": f"{size}Mi"}
    spec["volumes"] = [*volumes, {"name": _SHM_VOLUME, "emptyDir": memory}]
    worker["volumeMounts"] = [*mounts, {"name": _SHM_VOLUME, "mountPath": _SHM}]


# ---- copy of the program's pod --------------------------------------------------------------

_OF_THE_POD = (
    "affinity",
    "dnsConfig",
    "dnsPolicy",
    "hostAliases",
    "imagePullSecrets",
    "nodeSelector",
    "priorityClassName",
    "runtimeClassName",
    "schedulerName",
    "securityContext",
    "serviceAccountName",
    "terminationGracePeriodSeconds",
    "tolerations",
    "topologySpreadConstraints",
)
"""Fields of the program's pod that a worker's pod gets.  Services select the program's pod by its
labels, and its requests are those of the program, so workers get neither."""

_OF_THE_CONTAINER = (
    "env",
    "envFrom",
    "image",
    "imagePullPolicy",
    "securityContext",
    "volumeDevices",
    "volumeMounts",
    "workingDir",
)

_ACCOUNT = "/var/run/secrets/kubernetes.io/serviceaccount"
"""Folder of a pod's token, which workers do not get: they make no calls to the API."""


def _like(pod: Mapping[str, Any], container: str) -> Document:
    own = copy.deepcopy(dict(pod["spec"]))
    found = next(c for c in own["containers"] if c["name"] == container)
    worker = {"name": names.WORKER_CONTAINER, **_given(found, _OF_THE_CONTAINER)}
    variables = [v for v in found.get("env") or () if not v["name"].startswith("FIBER_")]
    _set(worker, "env", [v for v in variables if not _is_secret(v)])
    mounts = [m for m in found.get("volumeMounts") or () if not _is_the_pods(m)]
    _set(worker, "volumeMounts", mounts)
    spec = {**_given(own, _OF_THE_POD), "containers": [worker]}
    used = {m["name"] for m in (*mounts, *(found.get("volumeDevices") or ()))}
    _set(spec, "volumes", [v for v in own.get("volumes") or () if v["name"] in used])
    _set(spec, "tolerations", [t for t in own.get("tolerations") or () if not _is_default(t)])
    spread = spec.get("topologySpreadConstraints") or ()
    _set(spec, "topologySpreadConstraints", [_among_workers(constraint) for constraint in spread])
    _rename(spec, container)
    return spec


def secrets_left_out(pod: Mapping[str, Any], container: str) -> list[str]:
    """Return names of the container's variables that look like secrets; workers do not get them.

    A FiberPool would show their values to all its readers.
    """
    found = next(c for c in pod["spec"]["containers"] if c["name"] == container)
    return [v["name"] for v in found.get("env") or () if _is_secret(v)]


_SECRET = re.compile(
    r"(^|_)(SECRET|TOKEN|PASSWORD|PASSWD|PASSPHRASE|PASS|PAT|CREDENTIALS?|AUTH|DSN"
    r"|(API|ACCESS|PRIVATE|SSH|ENCRYPTION|SIGNING)_?KEY|(DATABASE|DB|REDIS|MONGO|AMQP)_UR[IL])(_|$)"
    r"|^PGPASSWORD$|_PWD$",
    re.IGNORECASE,
)


def _is_secret(variable: Mapping[str, Any]) -> bool:
    """Return whether the variable has a value in the manifest, and the name of a secret."""
    return bool(variable.get("value")) and names_secret(variable["name"])


def names_secret(name: str) -> bool:
    """Return whether a variable of this name looks like a secret."""
    return _SECRET.search(name) is not None


def _given(document: Document, fields: tuple[str, ...]) -> Document:
    return {name: document[name] for name in fields if document.get(name)}


def _set(document: Document, name: str, items: list[Any]) -> None:
    document.pop(name, None)
    if items:
        document[name] = items


def _is_the_pods(mount: Mapping[str, Any]) -> bool:
    return mount["mountPath"].rstrip("/") in (_ACCOUNT, names.CREDENTIALS_DIRECTORY)


def _is_default(toleration: Mapping[str, Any]) -> bool:
    """Return whether the API server added the toleration.

    The operator gives workers shorter ones, unless the template has such a toleration.
    """
    key = str(toleration.get("key"))
    return toleration.get("tolerationSeconds") == 300 and key.startswith("node.kubernetes.io/")


def _among_workers(constraint: Mapping[str, Any]) -> Document:
    """Return the constraint with the pool's workers as the pods that are spread."""
    # Its own selector finds pods by labels of the program, which workers do not have.
    workers = {"matchExpressions": [{"key": names.LABEL_POOL_UID, "operator": "Exists"}]}
    return {**constraint, "labelSelector": workers, "matchLabelKeys": [names.LABEL_POOL_UID]}


def _rename(document: object, container: str) -> None:
    """Change references to the program's container into references to the worker's."""
    if isinstance(document, list):
        for item in document:
            _rename(item, container)
    elif isinstance(document, dict):
        reference = document.get("resourceFieldRef")
        if isinstance(reference, dict) and reference.get("containerName") == container:
            reference["containerName"] = names.WORKER_CONTAINER
        for item in document.values():
            _rename(item, container)


_TERMINATION_LOG = re.compile(r"/pods/[^/ ]+/containers/([^/ ]+)/\S+ /dev/termination-log ")


def own_container(pod: Mapping[str, Any], mountinfo: str) -> str:
    """Return the container of its pod that this program runs in, by ``/proc/self/mountinfo``.

    The kubelet mounts a file into each container, from a folder with the container's name.  If
    that is not visible, this is kubectl's default container.
    """
    containers = [container["name"] for container in pod["spec"]["containers"]]
    seen = _TERMINATION_LOG.search(mountinfo)
    annotations = pod["metadata"].get("annotations") or {}
    default = annotations.get("kubectl.kubernetes.io/default-container")
    for name in (seen and seen[1], default):
        if name in containers:
            return str(name)
    return str(containers[0])


# ---- the FiberPool --------------------------------------------------------------------------


def fiber_pool_body(name: str, template: Mapping[str, Any], config: Config) -> Document:
    """Return a FiberPool for this program alone, without the fields of its master."""
    return {
        "apiVersion": names.API_VERSION,
        "kind": names.KIND,
        "metadata": {"name": name, "labels": {names.LABEL_MANAGED_BY: names.SDK_MANAGER}},
        "spec": {
            "maxReplicas": config.max_pods,
            "processesPerPod": config.processes_per_pod,
            "template": dict(template),
            "scaleDown": {"idleTimeoutSeconds": math.ceil(config.idle_timeout)},
        },
    }


@dataclass(frozen=True, slots=True)
class PodShape:
    """Everything that a pod's template depends on.  Equal shapes share one FiberPool."""

    image: str | None = None
    """Image; None for that of the program's pod, or of this version's worker."""
    resources: Resources = field(default_factory=Resources)
    """Resources that one process needs."""
    template: str = field(default="{}", repr=False)
    """The configured pod template, as JSON with sorted keys."""
    processes_per_pod: int = 1
    cpu_request: float = 0
    """CPUs to request for a process whose function asks for none."""
    memory_request: int = 0
    """MiB of memory to request for a process whose function asks for none."""
    shm: int | None = None
    """MiB of memory at /dev/shm; None for the default of containers."""

    @classmethod
    def of(cls, config: Config) -> PodShape:
        """Return the shape for functions that ask for nothing.

        ConfigError: the file of the template cannot be read.
        """
        template = read_template(config.template)
        try:
            text = json.dumps(template, sort_keys=True)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"bad value for 'template': {error}. A template has only values of JSON: write "
                "text that looks like a date in quotes."
            ) from error
        selector, tolerations = config.node_selector, config.tolerations
        return cls(
            config.image,
            wished("fiber.init", node_selector=selector, tolerations=tolerations),
            text,
            config.processes_per_pod,
            config.cpu_request,
            config.memory_request,
            config.shm,
        )

    def with_resources(self, resources: Resources) -> PodShape:
        """Return the shape for a function with these resources, which override those here."""
        return replace(self, resources=merged(self.resources, resources))


# ---- the configured template ----------------------------------------------------------------


def read_template(configured: str | Mapping[str, Any] | None) -> dict[str, Any]:
    """Return a pod template with only ``metadata`` and ``spec``; ConfigError if it is none."""
    if configured is None:
        return {}
    if isinstance(configured, str):
        source, document = f"the file {configured}", _read(configured)
    else:
        source, document = "the dict", configured
    return _checked(document, f"bad value for 'template': {source}")


def _read(path: str) -> object:
    try:
        with open(path, encoding="utf-8") as file:
            text = file.read()
        return json.loads(text) if path.endswith(".json") else _parse_yaml(text)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"cannot read the pod template {path} (key 'template'): {error}. Name a YAML or JSON "
            "file that this program can read."
        ) from error


def _parse_yaml(text: str) -> object:
    try:
        import yaml  # comes with the Kubernetes client
    except ModuleNotFoundError:
        raise ValueError(
            "YAML needs PyYAML, which is not installed (pip install 'fiberpool[kubernetes]')"
        ) from None
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error


def _checked(document: object, what: str) -> dict[str, Any]:
    if not isinstance(document, Mapping):
        raise ConfigError(f"{what} is not an object with metadata and spec, as in a Deployment")
    # A whole Pod may be given too.
    template = {key: part for key, part in document.items() if key not in ("apiVersion", "kind")}
    for key, part in template.items():
        if key not in ("metadata", "spec"):
            hint = ". Put fields of the pod under 'spec'" if "spec" not in template else ""
            raise ConfigError(f"{what} has {key!r} beside metadata and spec{hint}")
        if not isinstance(part, Mapping):
            raise ConfigError(f"{what} has a {key} that is not an object")
    for container in template.get("spec", {}).get("containers") or ():
        _check_container(container, what)
    return template


def _check_container(container: object, what: str) -> None:
    name = container.get("name") if isinstance(container, Mapping) else None
    if not name:
        raise ConfigError(
            f"{what} has a container without a name; the one that runs the processes is called "
            f"{names.WORKER_CONTAINER!r}"
        )
    assert isinstance(container, Mapping)
    if name != names.WORKER_CONTAINER and not container.get("image"):
        raise ConfigError(
            f"{what} has a container {name!r} without an image. The one that runs the processes is "
            f"called {names.WORKER_CONTAINER!r}: give it that name, or give {name!r} an image to "
            "run it beside."
        )


# ---- names ----------------------------------------------------------------------------------


def program_name(path: str | None) -> str:
    """Return a name for the program with this ``__main__.__file__``, for the names of its pools.

    None: the program has no file, as an interactive session.
    """
    if not path:
        return _PROGRAM
    folder, file = os.path.split(os.path.abspath(path))
    stem = os.path.splitext(file)[0]
    # ``main.py`` is too common: the name of its folder says more.
    return _label(stem if stem not in ("main", "__main__") else os.path.basename(folder))


def pool_name(program: str, shape: PodShape, suffix: str) -> str:
    """Return the name of a FiberPool: program, resources of a pod, and a unique ``suffix``."""
    end = "".join(f"-{word}" for word in (*_words(shape.resources), suffix))
    return f"{_label(program)[: names.MAX_POOL_NAME - len(end)].rstrip('-')}{end}"


_PROGRAM = "python"


def _label(name: str) -> str:
    """Return ``name`` with only the characters of a pool's name, from the first letter on."""
    label = re.sub("[^a-z0-9]+", "-", name.lower()).strip("-")
    return re.sub("^[^a-z]+", "", label) or _PROGRAM


def _words(resources: Resources) -> list[str]:
    wishes = {
        "cpu": None if resources.cpu is None else quantity(resources.cpu),
        "mem": None if resources.memory is None else f"{resources.memory}mi",
        "gpu": resources.gpu,
    }
    return [f"{kind}{wish}" for kind, wish in wishes.items() if wish is not None]


def quantity(cpus: float) -> str:
    """Return CPUs as Kubernetes writes them, to the thousandth: ``2``, ``500m``."""
    thousandths = max(1, round(cpus * 1000))
    return f"{thousandths}m" if thousandths % 1000 else str(thousandths // 1000)


_KEYS = {
    "containers": "name",
    "env": "name",
    "hostAliases": "ip",
    "imagePullSecrets": "name",
    "initContainers": "name",
    "volumeDevices": "devicePath",
    "volumeMounts": "mountPath",
    "volumes": "name",
}
_MERGED = frozenset({"containers", "initContainers"})


def merge_template(template: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``template`` with the values of ``over`` merged into it; neither is changed."""
    merged = copy.deepcopy(dict(template))
    for key, value in over.items():
        if value is None:
            merged.pop(key, None)
        else:
            merged[key] = _merge(key, merged.get(key), value)
    return merged


def _merge(key: str, ours: Any, theirs: Any) -> Any:
    if isinstance(theirs, Mapping):
        return merge_template(ours if isinstance(ours, Mapping) else {}, theirs)
    named_by = _KEYS.get(key)
    if named_by and isinstance(theirs, list) and all(_has(item, named_by) for item in theirs):
        return _merge_named(ours or [], theirs, named_by, in_turn=key in _MERGED)
    # Also a value of a wrong type: the API server reports it best.
    return copy.deepcopy(theirs)


def _has(item: object, key: str) -> bool:
    return isinstance(item, Mapping) and isinstance(item.get(key), str)


def _merge_named(ours: list[Any], theirs: list[Any], key: str, *, in_turn: bool) -> list[Any]:
    merged = {item[key]: item for item in ours}
    for item in theirs:
        name = item[key]
        if item.get("$patch") == "delete":
            merged.pop(name, None)
        else:
            merged[name] = merge_template(merged.get(name, {}) if in_turn else {}, item)
    return list(merged.values())
