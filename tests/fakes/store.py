"""State of a cluster's API server, as exact as the operator can see.

Resource versions, uids, generations, the status subresource, preconditions, label selectors,
owner references and a history that watches are served from and that can be forgotten (410).
"""

from __future__ import annotations

import asyncio
import datetime
import json
import uuid
from collections.abc import Callable, Coroutine
from typing import Any, NamedTuple

Body = dict[str, Any]
Place = tuple[str, str, str]  # plural, namespace, name

KINDS = {
    "fiberpools": ("fiber.dev/v1alpha1", "FiberPool"),
    "pods": ("v1", "Pod"),
    "services": ("v1", "Service"),
    "secrets": ("v1", "Secret"),
    "events": ("v1", "Event"),
    "persistentvolumeclaims": ("v1", "PersistentVolumeClaim"),
    "namespaces": ("v1", "Namespace"),
    "nodes": ("v1", "Node"),
    "resourcequotas": ("v1", "ResourceQuota"),
    "limitranges": ("v1", "LimitRange"),
    "serviceaccounts": ("v1", "ServiceAccount"),
    "endpointslices": ("discovery.k8s.io/v1", "EndpointSlice"),
    "deployments": ("apps/v1", "Deployment"),
    "poddisruptionbudgets": ("policy/v1", "PodDisruptionBudget"),
    "jobs": ("batch/v1", "Job"),
    "roles": ("rbac.authorization.k8s.io/v1", "Role"),
    "rolebindings": ("rbac.authorization.k8s.io/v1", "RoleBinding"),
    "leases": ("coordination.k8s.io/v1", "Lease"),
    "customresourcedefinitions": ("apiextensions.k8s.io/v1", "CustomResourceDefinition"),
}
WITH_STATUS = {"fiberpools", "jobs", "pods"}
EPOCH = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
_GRACE = 30  # seconds that a pod has to end


class Failure(Exception):
    """An answer that is no success."""

    def __init__(self, status: int, reason: str, message: str) -> None:
        super().__init__(message)
        self.status, self.reason, self.message = status, reason, message

    def body(self) -> Body:
        return {
            "kind": "Status",
            "apiVersion": "v1",
            "metadata": {},
            "status": "Failure",
            "message": self.message,
            "reason": self.reason,
            "code": self.status,
        }


class Change(NamedTuple):
    """Event of a watch."""

    version: int
    type: str
    place: Place
    object: Body


class Store:
    """Store of objects. Neither the caller nor the store changes an object that it returned.

    ``admit`` is asked before a creation and raises Failure to refuse it.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.epoch = EPOCH
        """Time at which the clock shows 0."""
        self._objects: dict[Place, Body] = {}
        self._version = 100
        self._addresses = 0
        self.dual_stack = False
        """Setting: Services may have addresses of both IP families."""
        self._bell = asyncio.Event()
        self.changes: list[Change] = []
        self.oldest = 0
        self.admit: Callable[[str, Body], None] = lambda plural, body: None
        self.created: Callable[[str, Body], None] = lambda plural, body: None
        self.pods_linger = False
        """Setting: a deleted pod stays, terminating, until ``remove``."""
        self.collects_garbage = True

    def copy(self, clock: Callable[[], float]) -> Store:
        """Another store with the same past, whose time goes on from now by ``clock``."""
        start, now = clock(), self._clock()
        other = Store(lambda: now + clock() - start)
        other._objects = dict(self._objects)
        other._version, other._addresses = self._version, self._addresses
        other.changes = list(self.changes)
        return other

    @property
    def version(self) -> str:
        return str(self._version)

    def now(self, ahead: float = 0.0) -> str:
        """The time as Kubernetes writes it, or that in so many seconds."""
        moment = self.epoch + datetime.timedelta(seconds=self._clock() + ahead)
        return moment.isoformat(timespec="seconds").replace("+00:00", "Z")

    def unix_now(self) -> float:
        return self.epoch.timestamp() + self._clock()

    def follow_the_machine(self) -> None:
        """Show the time of this machine from now on, as programs of this machine do."""
        now = datetime.datetime.now(datetime.UTC)
        self.epoch = now - datetime.timedelta(seconds=self._clock())

    # -- What clients do

    def get(self, plural: str, namespace: str, name: str) -> Body:
        try:
            return self._objects[plural, namespace, name]
        except KeyError:
            raise Failure(404, "NotFound", f'{plural} "{name}" not found') from None

    def list(self, plural: str, namespace: str | None = None, selector: str = "") -> list[Body]:
        return [
            body
            for (kind, place, _), body in sorted(self._objects.items())
            if kind == plural and namespace in (None, place) and matches(body, selector)
        ]

    def create(self, plural: str, namespace: str, body: Body, *, dry_run: bool = False) -> Body:
        metadata = dict(body.get("metadata") or {})
        body = {**body, "metadata": metadata}
        name = metadata.get("name")
        if not isinstance(name, str) or not name:
            raise Failure(422, "Invalid", "metadata.name: Required value")
        if (plural, namespace, name) in self._objects:
            raise Failure(409, "AlreadyExists", f'{plural} "{name}" already exists')
        self.admit(plural, body)
        if dry_run:
            return body
        metadata |= {"namespace": namespace, "uid": str(uuid.uuid4()), "generation": 1}
        metadata["creationTimestamp"] = self.now()
        body["apiVersion"], body["kind"] = KINDS[plural]
        if plural == "fiberpools":
            body.pop("status", None)
        if plural == "pods":
            body["status"] = {"phase": "Pending"}
        if plural == "services":
            self._addresses += 1
            spec = {"clusterIP": f"10.96.0.{self._addresses}", **body.get("spec", {})}
            if self.dual_stack and spec.get("ipFamilyPolicy") == "PreferDualStack":
                both = [spec["clusterIP"], f"fd00:96::{self._addresses}"]
                spec = {"clusterIPs": both, **spec}
            body["spec"] = spec
        self._put("ADDED", (plural, namespace, name), body)
        self.created(plural, body)
        return self.get(plural, namespace, name)

    def update(self, plural: str, namespace: str, name: str, body: Body) -> Body:
        current = self.get(plural, namespace, name)
        asked = body.get("metadata", {}).get("resourceVersion")
        if asked is not None and asked != current["metadata"]["resourceVersion"]:
            raise Failure(409, "Conflict", f"{name}: the object has been modified")
        new = {**body, "metadata": {**current["metadata"], **body.get("metadata", {})}}
        return self._change(plural, namespace, name, current, new)

    def merge(
        self, plural: str, namespace: str, name: str, patch: Body, subresource: str = ""
    ) -> Body:
        current = self.get(plural, namespace, name)
        uid = (patch.get("metadata") or {}).get("uid", current["metadata"]["uid"])
        if uid != current["metadata"]["uid"]:
            raise Failure(422, "Invalid", "metadata.uid: Invalid value: field is immutable")
        if subresource:
            patch = {subresource: patch.get(subresource)}
        elif plural in WITH_STATUS:
            patch = {key: value for key, value in patch.items() if key != "status"}
        return self._change(plural, namespace, name, current, merged(current, patch))

    def delete(self, plural: str, namespace: str, name: str, options: Body | None = None) -> None:
        current = self.get(plural, namespace, name)
        options = options or {}
        for field, wanted in (options.get("preconditions") or {}).items():
            found = current["metadata"][field]
            if wanted != found:
                message = f"Precondition failed: {field} in precondition: {wanted}, found: {found}"
                raise Failure(409, "Conflict", message)
        if plural == "pods" and self.pods_linger and options.get("gracePeriodSeconds") != 0:
            if "deletionTimestamp" not in current["metadata"]:
                # As in Kubernetes: the time at which the pod will be killed.
                stamp = {
                    "deletionTimestamp": self.now(_GRACE),
                    "deletionGracePeriodSeconds": _GRACE,
                }
                self._put(
                    "MODIFIED", (plural, namespace, name), merged(current, {"metadata": stamp})
                )
            return
        self.remove(plural, namespace, name)

    # -- The rest of a cluster

    def remove(self, plural: str, namespace: str, name: str) -> None:
        """Remove the object and the objects that it owns."""
        body = self._objects.pop((plural, namespace, name))
        self._version += 1
        self._record("DELETED", (plural, namespace, name), self._stamped(body))
        if self.collects_garbage:
            self.collect_garbage(body["metadata"]["uid"])

    def collect_garbage(self, uid: str) -> None:
        for place, body in list(self._objects.items()):
            owners = body["metadata"].get("ownerReferences") or []
            if any(owner.get("uid") == uid for owner in owners) and place in self._objects:
                self.remove(*place)

    def set_status(self, plural: str, namespace: str, name: str, status: Body) -> Body:
        """Replace the whole status, as a kubelet does."""
        current = self.get(plural, namespace, name)
        return self._change(plural, namespace, name, current, {**current, "status": status})

    def forget_history(self) -> None:
        """Watches from before now get 410 Gone."""
        self.oldest = self._version

    def changed(self) -> Coroutine[Any, Any, object]:
        """Return what waits for the next change from now on, also if it is awaited later."""
        return self._bell.wait()

    # -- Within

    def _change(self, plural: str, namespace: str, name: str, current: Body, new: Body) -> Body:
        if new == current:
            return current
        if new.get("spec") != current.get("spec"):
            generation = current["metadata"].get("generation", 1) + 1
            new = {**new, "metadata": {**new["metadata"], "generation": generation}}
        self._put("MODIFIED", (plural, namespace, name), new)
        return self.get(plural, namespace, name)

    def _put(self, type_: str, place: Place, body: Body) -> None:
        self._version += 1
        self._objects[place] = self._stamped(body)
        self._record(type_, place, self._objects[place])

    def _stamped(self, body: Body) -> Body:
        return {**body, "metadata": {**body["metadata"], "resourceVersion": self.version}}

    def _record(self, type_: str, place: Place, body: Body) -> None:
        self.changes.append(Change(self._version, type_, place, body))
        self._bell.set()
        self._bell = asyncio.Event()


def merged(target: Any, patch: Any) -> Any:
    """RFC 7396."""
    if not isinstance(patch, dict):
        return patch
    result = dict(target) if isinstance(target, dict) else {}
    for key, value in patch.items():
        if value is None:
            result.pop(key, None)
        else:
            result[key] = merged(result.get(key), value)
    return result


def matches(body: Body, selector: str) -> bool:
    """Return whether the labels of ``body`` match: ``a=b``, ``a`` or ``!a``, joined by commas."""
    labels = body["metadata"].get("labels") or {}
    for term in filter(None, selector.split(",")):
        key, equals, value = term.partition("=")
        if equals:
            fits = labels.get(key) == value.lstrip("=")
        else:
            fits = (key.removeprefix("!") in labels) != key.startswith("!")
        if not fits:
            return False
    return True


def has_fields(body: Body, selector: str) -> bool:
    """Return whether the fields of ``body`` match: ``a.b=c``, joined by commas."""
    for term in filter(None, selector.split(",")):
        path, _, value = term.partition("=")
        place: Any = body
        for name in path.split("."):
            place = place.get(name) if isinstance(place, dict) else None
        if place != value:
            return False
    return True


def line(type_: str, body: Body) -> bytes:
    """Encode one line of a watch."""
    return json.dumps({"type": type_, "object": body}).encode() + b"\n"
