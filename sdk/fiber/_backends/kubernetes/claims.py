"""PersistentVolumeClaims of the program's own pod, and which of them workers cannot mount.

A volume that one node alone may mount keeps each worker on another node from starting.
"""

from __future__ import annotations

import copy
import threading
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.api_errors import Body, Forbidden, NotFound
from fiber._backends.kubernetes.resources import CLAIMS

_ONE_NODE = {"ReadWriteOnce", "ReadWriteOncePod"}


class Claims(NamedTuple):
    """The claims that need a word."""

    one_node: tuple[str, ...] = ()
    """Names of those that one node alone may mount."""
    unread: Mapping[str, str] = {}
    """Why a claim cannot be read, by its name."""

    def warnings(self, template: Mapping[str, Any]) -> list[str]:
        """Lines about the claims, for a program whose workers have this pod template."""
        mounted = set(_claims_by_volume(template["spec"]).values())
        left_out = [claim for claim in self.one_node if claim not in mounted]
        lines = [
            f"workers mount the PersistentVolumeClaim {claim} as this program does, though it "
            f"cannot be read ({why}): if one node alone may mount it, workers on other nodes do "
            "not start. Give this program's account the right to get persistentvolumeclaims, "
            "which the role fiber-user has"
            for claim, why in self.unread.items()
        ]
        if left_out:
            lines.append(
                f"workers do not get the PersistentVolumeClaims {', '.join(left_out)}: their "
                "access mode lets one node alone mount them, and workers run on others, too. Use a "
                "claim with ReadWriteMany or ReadOnlyMany, or bring the volumes and volumeMounts "
                "with fiber.init(template=), where a nodeSelector can keep workers on that node"
            )
        return lines


def look_up(
    api: Api, namespace: str, pod: Mapping[str, Any], container: str, cancel: threading.Event
) -> Claims:
    """Ask what the claims allow that the container mounts, for workers in ``namespace``."""
    found = next(c for c in pod["spec"]["containers"] if c["name"] == container)
    uses = (*(found.get("volumeMounts") or ()), *(found.get("volumeDevices") or ()))
    used = {use["name"] for use in uses}
    volumes = _claims_by_volume(pod["spec"])
    one_node, unread = [], {}
    for claim in sorted({claim for volume, claim in volumes.items() if volume in used}):
        try:
            spec = api.get(CLAIMS.path(namespace, claim), cancel=cancel)["spec"]
        except (Forbidden, NotFound) as error:
            unread[claim] = error.message
        else:
            modes = set(spec.get("accessModes") or ())
            if modes and modes <= _ONE_NODE:
                one_node.append(claim)
    return Claims(tuple(one_node), unread)


def without_claims(pod: Mapping[str, Any], claims: Collection[str]) -> Body:
    """Return the pod without the volumes of these claims, and without their mounts."""
    changed = copy.deepcopy(dict(pod))
    spec = changed["spec"]
    gone = {volume for volume, claim in _claims_by_volume(spec).items() if claim in claims}
    documents = [(spec, "volumes")]
    for container in spec["containers"]:
        documents += [(container, "volumeMounts"), (container, "volumeDevices")]
    for document, field in documents:
        if document.get(field):
            document[field] = [item for item in document[field] if item["name"] not in gone]
    return changed


def _claims_by_volume(spec: Mapping[str, Any]) -> dict[str, str]:
    return {
        volume["name"]: volume["persistentVolumeClaim"]["claimName"]
        for volume in spec.get("volumes") or ()
        if volume.get("persistentVolumeClaim")
    }
