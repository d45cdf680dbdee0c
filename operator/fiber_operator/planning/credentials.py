"""Init container by which an agent gets its own key, and no task the pool's.

A first init container mounts the pool's Secret, derives the agent's key from it and from the pod's
name and uid, and writes it to a volume in memory.  The agent reads the file and removes it.

The init container runs the worker's command on the worker's image and nothing that a task could
have written: no volume, environment or working directory of the template reaches it.  The one
exception is a volume that the command names, which has the interpreter.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from typing import Any

from fiber_api import names
from fiber_api.v1alpha1 import FiberPool
from fiber_operator.planning.documents import items, mapping, text

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
"""A pod asks for the larger of what its init containers and its containers ask for: as much as the
worker does costs nothing, and meets every quota and limit range that the worker meets.  A device is
of no use here."""

_FILE = f"{names.CREDENTIALS_DIRECTORY}/{names.CREDENTIALS_FILE}"


def add(pool: FiberPool, spec: dict[str, Any], worker: dict[str, Any]) -> None:
    """Give the pod its init container, and what the worker's ``container`` mounts for it."""
    volumes, first = spec.get("volumes") or [], spec.get("initContainers") or []
    mounts = worker.get("volumeMounts") or []
    if not (isinstance(volumes, list) and isinstance(first, list) and isinstance(mounts, list)):
        return
    if any(
        text(m.get("mountPath")).rstrip("/") == names.CREDENTIALS_DIRECTORY for m in items(mounts)
    ):
        return  # the template's own way to hand credentials over
    spec["volumes"] = [
        *volumes,
        {
            "name": names.KEY_VOLUME,
            # Any user may read it that the image runs as; no other container mounts it.
            "secret": {"secretName": pool.credentials_secret, "defaultMode": 0o444},
        },
        {"name": names.CREDENTIALS_VOLUME, "emptyDir": {"medium": "Memory", "sizeLimit": "1Mi"}},
    ]
    mount = {"name": names.CREDENTIALS_VOLUME, "mountPath": names.CREDENTIALS_DIRECTORY}
    spec["initContainers"] = [_container(worker, mount), *first]
    worker["volumeMounts"] = [*mounts, mount]


def _container(worker: Mapping[str, Any], written: Mapping[str, Any]) -> dict[str, Any]:
    made = {k: copy.deepcopy(worker[k]) for k in _LIKE_THE_WORKER if worker.get(k) is not None}
    made["name"] = names.IDENTITY_CONTAINER
    if not runs_the_agent(worker):
        made.pop("args", None)
        made["command"] = ["python", "-m", _AGENT]
    made["volumeMounts"] = [
        *_mounts_of_the_interpreter(worker, made),
        dict(written),
        {"name": names.KEY_VOLUME, "mountPath": names.KEY_DIRECTORY, "readOnly": True},
    ]
    if resources := _resources(worker):
        made["resources"] = resources
    made["env"] = [
        {"name": names.ENV_KEY, "value": names.KEY_DIRECTORY},
        {"name": names.ENV_CREDENTIALS, "value": _FILE},
        _of_the_pod(names.ENV_NAME, "metadata.name"),
        _of_the_pod(names.ENV_UID, "metadata.uid"),
    ]
    return made


def _mounts_of_the_interpreter(
    worker: Mapping[str, Any], made: Mapping[str, Any]
) -> Iterator[dict[str, Any]]:
    """The mounts without which the command could not run: it names a path on them."""
    command = str([made.get("command"), made.get("args")])
    for mount in items(worker.get("volumeMounts")):
        path = text(mount.get("mountPath")).rstrip("/")
        if path and f"{path}/" in command:
            yield {**copy.deepcopy(dict(mount)), "readOnly": True}


def runs_the_agent(worker: Mapping[str, Any]) -> bool:
    """Tell whether the worker container runs the agent, by its command or its image."""
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
