"""A FiberPool whose master is this program."""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from fiber import _logs
from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.api_errors import Body, Forbidden, NotFound
from fiber._backends.kubernetes.resources import LEASES, POOLS
from fiber._exceptions import fresh
from fiber.errors import FiberPoolError
from fiber_api import names

LOST = ("Deleted", "Replaced")
"""Reasons of a FiberPoolError by which the pool is this program's no more."""


@dataclass(frozen=True)
class Master:
    """Master as ``spec.master`` describes it: this program."""

    host: str
    """The IP address that pods reach it at."""
    port: int
    identity: str
    """Name of the program, for users and for itself.  No other program has the same."""
    lease_duration: int = 30
    lost_grace: int = 60

    @property
    def address(self) -> str:
        """``host:port`` that the pool's Service leads to."""
        return names.address_of(self.host, self.port)

    def spec(self, pool: str, epoch: int) -> Body:
        """``spec.master`` of ``pool``."""
        return {
            "host": self.host,
            "port": self.port,
            "epoch": epoch,
            "identity": self.identity,
            "leaseName": names.master_lease_name(pool),
            "leaseDurationSeconds": self.lease_duration,
            "lostGraceSeconds": self.lost_grace,
        }


class AttachedPool:
    """FiberPool on the side of its master.  Calls block and raise ``ApiError``."""

    def __init__(
        self, api: Api, found: Body, master: Master, epoch: int, *, kept_by_others: bool = False
    ) -> None:
        self._api = api
        self.kept_by_others = kept_by_others
        """True if other programs may be its master before and after this one."""
        self.master = master
        self.epoch = epoch
        metadata = found["metadata"]
        self.name = str(metadata["name"])
        self.namespace = str(metadata["namespace"])
        self.uid = str(metadata["uid"])
        self.path = POOLS.path(self.namespace, self.name)
        self._lease_path = LEASES.path(self.namespace, names.master_lease_name(self.name))
        self.connected: Callable[[], int] = lambda: 0
        """Agents that are linked to this program, as its Lease tells; called on any thread."""
        self.generation = int(metadata["generation"])
        """Generation of the spec that this program wrote last."""

    @property
    def owner(self) -> Body:
        """Owner reference for objects that are deleted with the pool."""
        return {
            "apiVersion": names.API_VERSION,
            "kind": names.KIND,
            "name": self.name,
            "uid": self.uid,
        }

    def apply(
        self,
        replicas: int,
        release: Iterable[str] = (),
        *,
        master: bool = True,
        resource_version: str | None = None,
        **how: Any,
    ) -> None:
        """Write all that a program writes into a pool, in one document: what is left out goes.

        Conflict if the pool is another by now, or not that of ``resource_version``.
        """
        _logs.debug("FiberPool %s/%s: %d replicas wanted", self.namespace, self.name, replicas)
        metadata = {"name": self.name, "uid": self.uid}
        if resource_version is not None:
            metadata["resourceVersion"] = resource_version
        spec: Body = {"replicas": replicas}
        if names_to_release := list(release):
            spec["scaleDown"] = {"release": names_to_release}
        if master:
            spec["master"] = self.master.spec(self.name, self.epoch)
        body = {
            "apiVersion": names.API_VERSION,
            "kind": names.KIND,
            "metadata": metadata,
            "spec": spec,
        }
        self.generation = int(self._api.apply(self.path, body, **how)["metadata"]["generation"])

    def loss(self, found: Body | None) -> FiberPoolError | None:
        """Why the pool, which is as ``found`` now, is this program's no more, if that is so."""
        metadata = {} if found is None else found["metadata"]
        if found is None or metadata["uid"] != self.uid or "deletionTimestamp" in metadata:
            return self._loss(
                "Deleted",
                "was deleted, and its processes with it",
                "It is not this program's own: whoever keeps it has to make it again. Or let this "
                "program make one for itself: leave out pool=",
            )
        holder = identity_in(found)
        if holder == self.master.identity:
            return None
        if holder is None:
            return self._loss(
                "Replaced",
                "has no master any more: somebody detached this program",
                "Make a new Pool, or Process, to attach to it again",
            )
        return self._loss(
            "Replaced",
            f"has another master now: {holder}",
            "Wait until that program ends, or use another FiberPool",
        )

    def check(self) -> None:
        """Raise FiberPoolError if the pool is this program's no more."""
        try:
            found = self._api.get(self.path, timeout=0.0)
        except NotFound:
            found = None
        if loss := self.loss(found):
            raise fresh(loss)

    def _loss(self, reason: str, what: str, advice: str) -> FiberPoolError:
        """``advice`` is for a pool that somebody else keeps; its own is followed by another."""
        if not self.kept_by_others:
            advice = "What is to run from now on gets another FiberPool, and lost tasks run again"
        return FiberPoolError(
            f"the FiberPool {self.name!r} in namespace {self.namespace!r} {what}. {advice}",
            pool=self.name,
            namespace=self.namespace,
            reason=reason,
        )

    # -- The Lease that says that the program lives

    def renew_lease(self, **how: Any) -> None:
        """NotFound if there is none."""
        self._patch_lease(self._lease_spec(_micro_time()), **how)

    def take_lease(self, **how: Any) -> None:
        """Be the holder of the one that is there; NotFound if there is none."""
        now = _micro_time()
        self._patch_lease({**self._lease_spec(now), "acquireTime": now}, **how)

    def make_lease(self, **how: Any) -> None:
        """Conflict if there is one."""
        now = _micro_time()
        body = {
            "apiVersion": LEASES.api_version,
            "kind": LEASES.kind,
            "metadata": {
                "name": names.master_lease_name(self.name),
                "labels": self.labels,
                "annotations": self._lease_annotations,
                "ownerReferences": [self.owner],
            },
            "spec": {**self._lease_spec(now), "acquireTime": now},
        }
        self._api.create(LEASES.path(self.namespace), body, **how)

    def has_lease(self, **how: Any) -> bool:
        """Return whether the Lease that is there is this master's."""
        spec = self._api.get(self._lease_path, **how).get("spec") or {}
        return spec.get("holderIdentity") == self.master.identity

    def free_lease(self, **how: Any) -> None:
        """Let whoever comes next find that nobody holds it."""
        # Whoever may not has lost that right since; the pool itself can be left all the same.
        with contextlib.suppress(NotFound, Forbidden):
            self._patch_lease({"holderIdentity": ""}, **how)

    def _patch_lease(self, spec: Body, **how: Any) -> None:
        metadata = {"labels": self.labels, "annotations": self._lease_annotations}
        patch = {"metadata": metadata, "spec": spec}
        self._api.merge_patch(self._lease_path, patch, **how)

    @property
    def labels(self) -> dict[str, str]:
        """Labels of the objects that belong to the pool.

        The operator watches only Leases that have the first.
        """
        return {names.LABEL_POOL_UID: self.uid, names.LABEL_POOL: self.name}

    @property
    def _lease_annotations(self) -> dict[str, str]:
        return {names.ANNOTATION_CONNECTED: str(self.connected())}

    def _lease_spec(self, now: str) -> Body:
        return {
            "holderIdentity": self.master.identity,
            "leaseDurationSeconds": self.master.lease_duration,
            "renewTime": now,
        }


def identity_in(pool: Body) -> str | None:
    """Return the identity of the pool's master; None if it has none."""
    master = pool["spec"].get("master")
    return None if master is None else str(master.get("identity", ""))


def _micro_time() -> str:
    now = datetime.datetime.now(datetime.UTC)
    return now.isoformat(timespec="microseconds").replace("+00:00", "Z")
