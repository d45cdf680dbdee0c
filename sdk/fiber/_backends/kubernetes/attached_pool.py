"""FiberPool whose master is this program.

``OwnPool`` is made for the program and deleted when it ends. ``WarmPool`` belongs to another owner,
and the program is its master for a while.
"""

from __future__ import annotations

import base64
import contextlib
import json
import secrets
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from fiber import _logs
from fiber._backends.kubernetes.api import TIMEOUT, Api
from fiber._exceptions import fresh
from fiber._transport.credentials import OwnCredentials, WarmCredentials
from fiber.errors import FiberPoolError
from fiber_api import names
from fiber_api.names import ConditionType
from fiber_api.rest import (
    LEASES,
    POOLS,
    SECRETS,
    ApiError,
    Body,
    Conflict,
    Forbidden,
    NotFound,
    Transient,
)
from fiber_api.times import format_micro_time

LOST = ("Deleted", "Replaced")
"""Reasons of a FiberPoolError that mean that this program lost the pool."""


@dataclass(frozen=True)
class PoolMaster:
    """Content of ``spec.master`` for this program."""

    host: str
    """IP address that pods reach the program at."""
    port: int
    identity: str
    """Unique name of the program, also shown to users."""
    certificate: str
    """SHA-256 of the certificate that the program shows the agents, in hexadecimal digits."""
    lease_duration: int = 30
    lost_grace: int = 60
    relay: bool = False
    """True if agents are to connect to a relay from the start."""

    @property
    def address(self) -> str:
        """``host:port`` that the pool's Service leads to."""
        return names.address_of(self.host, self.port)

    def spec(self, pool: str, epoch: int) -> Body:
        """Return ``spec.master`` of ``pool``."""
        return {
            "host": self.host,
            "port": self.port,
            "epoch": epoch,
            "identity": self.identity,
            "certificate": self.certificate,
            "leaseName": names.master_lease_name(pool),
            "leaseDurationSeconds": self.lease_duration,
            "lostGraceSeconds": self.lost_grace,
        }


class AttachedPool:
    """FiberPool whose master this program is.  Calls block and raise ``ApiError``."""

    def __init__(
        self,
        api: Api,
        found: Body,
        master: PoolMaster,
        epoch: int,
        credentials: WarmCredentials | None = None,
    ) -> None:
        """``credentials``: those for a pool of another owner, which the operator has to sign."""
        self._api = api
        self._credentials = credentials
        self.kept_by_others = credentials is not None
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
        """Function for any thread that returns the number of linked agents, for the Lease."""
        self._acquired = ""
        """Time in the Lease that this program made."""
        self.relay = bool(found["spec"].get("relay"))
        """True if agents are to connect to a relay instead of this program."""
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
        """Write all fields of a pool that a program writes; fields left out are removed.

        Conflict: another pool has the name now, or the pool differs from ``resource_version``.
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
        if master and self.relay:
            spec["relay"] = True
        body = {
            "apiVersion": names.API_VERSION,
            "kind": names.KIND,
            "metadata": metadata,
            "spec": spec,
        }
        self.generation = int(self._api.apply(self.path, body, **how)["metadata"]["generation"])

    def take_signature(self, status: Body) -> bool:
        """Take the operator's signature in the pool's status; return False if one is missing."""
        if self._credentials is None or self._credentials.complete:
            return True
        try:
            signature = bytes.fromhex(status.get("masterSignature") or "")
        except ValueError:
            return False
        return self._credentials.take_signature(self.epoch, signature)

    def loss(self, found: Body | None) -> FiberPoolError | None:
        """Return the error if this program lost the pool, whose document is ``found`` now."""
        metadata = {} if found is None else found["metadata"]
        if found is None or metadata["uid"] != self.uid or "deletionTimestamp" in metadata:
            return self._loss(
                "Deleted",
                "was deleted, and its processes with it",
                "Its owner has to make it again. Or leave out pool= to let this program make its "
                "own FiberPool",
            )
        holder = identity_in(found)
        if holder == self.master.identity:
            return None
        if holder is None:
            return self._loss(
                "Replaced",
                "has no master: another client detached this program",
                "Make a new Pool, or Process, to attach to it again",
            )
        return self._loss(
            "Replaced",
            f"has another master now: {holder}",
            "Wait until that program ends, or use another FiberPool",
        )

    def check(self) -> None:
        """Raise FiberPoolError if this program lost the pool."""
        try:
            found = self._api.get(self.path, timeout=0.0)
        except NotFound:
            found = None
        if loss := self.loss(found):
            raise fresh(loss)

    def _loss(self, reason: str, what: str, advice: str) -> FiberPoolError:
        """Return the error.  ``advice`` is for a warm pool; another pool follows an own one."""
        if not self.kept_by_others:
            advice = "New processes get another FiberPool, and lost tasks run again"
        return FiberPoolError(
            f"the FiberPool {self.name!r} in namespace {self.namespace!r} {what}. {advice}",
            pool=self.name,
            namespace=self.namespace,
            reason=reason,
        )

    # -- Lease, which shows that the program lives

    def renew_lease(self, **how: Any) -> None:
        """Renew the Lease; NotFound if there is none."""
        self._patch_lease(self._lease_spec(_micro_time()), **how)

    def take_lease(self, **how: Any) -> None:
        """Become the holder of the existing Lease; NotFound if there is none."""
        now = _micro_time()
        self._patch_lease({**self._lease_spec(now), "acquireTime": now}, **how)

    def make_lease(self, **how: Any) -> None:
        """Create the Lease; Conflict if there is one."""
        now = self._acquired = _micro_time()
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

    def made_lease(self, **how: Any) -> bool:
        """Return True if the Lease that is there is the one of ``make_lease``.

        A neighbour may read the identity in the pool, but not foresee the time to a microsecond.
        """
        spec = self._api.get(self._lease_path, **how).get("spec") or {}
        written = (self.master.identity, self._acquired)
        return written == (spec.get("holderIdentity"), spec.get("acquireTime"))

    def free_lease(self, **how: Any) -> None:
        """Give up the Lease, so that the next master finds it free."""
        # If the right to do so was lost, the pool can be left all the same.
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
    return format_micro_time(time.time())


def secret_body(
    name: str, credentials: OwnCredentials, owner: Body, labels: dict[str, str]
) -> Body:
    """Return the Secret that the init containers of pods mount.

    It names the master's certificate.  A thief of the key can pose as an agent, not as the master.
    """
    texts = {names.KEY_POOL: credentials.pool_key, names.KEY_MASTER: credentials.fingerprint}
    return {
        "apiVersion": SECRETS.api_version,
        "kind": SECRETS.kind,
        "metadata": {
            "name": name,
            "labels": {**labels, names.LABEL_MANAGED_BY: names.SDK_MANAGER},
            "ownerReferences": [owner],
        },
        "type": "Opaque",
        "data": {key: base64.b64encode(text.encode()).decode() for key, text in texts.items()},
    }


_NAME_BYTES = names.SECRET_SUFFIX_LENGTH // 2
"""Random bytes in the name of a Secret that replaces another one."""
_EPOCH = 1
"""Epoch of an own pool, which never has another master."""


class OwnPool:
    """FiberPool that this program makes, uses alone and deletes.

    Its name must never have been used before.
    """

    def __init__(
        self,
        api: Api,
        namespace: str,
        body: Body,
        credentials: OwnCredentials,
        master: PoolMaster,
        owner: Body | None,
    ) -> None:
        self._api = api
        self._body = body
        self._credentials = credentials
        self._master = master
        self._owner = owner
        self._attached: AttachedPool | None = None
        self._may_exist = False
        self.name = str(body["metadata"]["name"])
        self.namespace = namespace
        self._path = POOLS.path(namespace, self.name)
        self._secret = names.secret_name(self.name)
        self.doing = "make"
        self.displaced = ""
        self.remedy = f"kubectl delete fiberpool {self.name} -n {namespace}"
        """Command that removes the pool if ``detach`` cannot."""

    def attach(self, cancel: threading.Event) -> AttachedPool:
        """Make the pool without pods, then its Secret and its Lease, which are deleted with it.

        The pool names its master from the start.  If the program dies between two of these calls,
        the master's Lease is absent or expires, and the operator deletes the pool.
        """
        attached = self._make_pool(cancel)
        while not self._make_secret(attached, cancel):
            # A FiberPool cannot change its Secret, so another FiberPool replaces it.  If this
            # program made the Secret after all, the Secret is deleted with the first pool.
            with contextlib.suppress(NotFound, Conflict):
                self._api.delete(self._path, uid=attached.uid, cancel=cancel)
            self._secret = f"{names.secret_name(self.name)}-{secrets.token_hex(_NAME_BYTES)}"
            attached = self._make_pool(cancel)
        try:
            attached.make_lease(cancel=cancel)
        except Conflict as error:
            if not (error.repeated and attached.made_lease(cancel=cancel)):
                raise
            # It was made by an attempt whose answer was lost.
        return attached

    def detach(self, timeout: float) -> None:
        """Delete the pool, if it may exist."""
        try:
            if self._attached is not None:
                uid = self._attached.uid
            elif self._may_exist:
                found = self._api.get(self._path, timeout=timeout)
                if not self._is_own(found):
                    return
                uid = str(found["metadata"]["uid"])
            else:
                return
            self._api.delete(self._path, uid=uid, timeout=timeout)
        except (NotFound, Conflict):
            pass  # the pool is gone, or another pool has its name

    def _make_pool(self, cancel: threading.Event) -> AttachedPool:
        self._attached = None
        found = self._create(cancel)
        self._attached = AttachedPool(self._api, found, self._master, _EPOCH)
        return self._attached

    def _make_secret(self, pool: AttachedPool, cancel: threading.Event) -> bool:
        """Make the Secret; return False if one exists whose maker is unknown.

        In that case an earlier attempt had no answer.  The role fiber-user reads no Secret, so this
        program cannot compare the two.
        """
        secret = secret_body(self._secret, self._credentials, pool.owner, pool.labels)
        try:
            self._api.create(SECRETS.path(self.namespace), secret, cancel=cancel)
        except Conflict as error:
            if not error.repeated:
                raise  # another client made it
            return False
        return True

    def _create(self, cancel: threading.Event) -> Body:
        metadata = dict(self._body["metadata"])
        if self._owner is not None:
            metadata["ownerReferences"] = [self._owner]
        spec = {
            **self._body["spec"],
            "replicas": 0,
            "master": self._master.spec(self.name, _EPOCH),
            "onLost": "Delete",
            "credentialsSecretName": self._secret,
        }
        if self._master.relay:
            spec["relay"] = True
        body = {**self._body, "metadata": metadata, "spec": spec}
        try:
            return self._api.create(POOLS.path(self.namespace), body, strict=True, cancel=cancel)
        except Conflict as error:
            if not error.repeated:
                raise
            found = self._api.get(self._path, cancel=cancel)
            if not self._is_own(found):
                raise
            return found  # made by an attempt whose answer was lost
        except Transient:
            self._may_exist = True
            raise

    def _is_own(self, found: Body) -> bool:
        """Return whether the pool has values that only this program knew."""
        written = (self._master.identity, self._secret)
        return written == (identity_in(found), found["spec"].get("credentialsSecretName"))


_PAUSE = 0.05
"""Seconds until the next attempt, after another client has changed the pool."""


class WarmPool:
    """FiberPool of another owner, which this program attaches to and detaches from."""

    def __init__(
        self,
        api: Api,
        namespace: str,
        name: str,
        master: PoolMaster,
        credentials: WarmCredentials,
    ) -> None:
        self._api = api
        self._master = master
        self._credentials = credentials
        self._attached: AttachedPool | None = None
        self._replicas = 0
        """Replicas of the pool before, which ``detach`` restores."""
        self.name = name
        self.namespace = namespace
        self.doing = "attach to"
        self.displaced = ""

    @property
    def remedy(self) -> str:
        """Command that detaches the program if ``detach`` cannot."""
        patch = json.dumps({"spec": {"master": None, "replicas": self._replicas}})
        where = f"fiberpool {self.name} -n {self.namespace}"
        return f"kubectl patch {where} --type=merge -p '{patch}'"

    def attach(self, cancel: threading.Event) -> AttachedPool:
        """Become the pool's master; FiberPoolError if it has another one."""
        deadline = time.monotonic() + TIMEOUT
        while not self._try_to_attach(cancel):
            # The operator wrote its status meanwhile, or another program attached first.
            if time.monotonic() > deadline or cancel.wait(_PAUSE):
                raise Conflict("each attempt met a change of the pool", status=409)
        assert self._attached is not None
        try:
            self._attached.make_lease(cancel=cancel)
        except Conflict:
            self._attached.take_lease(cancel=cancel)  # of the master before
        return self._attached

    def detach(self, timeout: float) -> None:
        """Restore the pool, if this program still is its master."""
        attached = self._attached
        if attached is None:
            return
        deadline = time.monotonic() + timeout
        while not self._try_to_detach(attached, left := max(deadline - time.monotonic(), 0.0)):
            if not left:
                raise Conflict("each attempt met a change of the pool", status=409)
            time.sleep(min(_PAUSE, left))

    def _try_to_detach(self, attached: AttachedPool, timeout: float) -> bool:
        try:
            found = self._api.get(attached.path, timeout=timeout)
        except NotFound:
            return True
        if attached.loss(found) is not None:
            return True
        try:
            # First: after ``apply`` the Lease may belong to the next master.
            attached.free_lease(timeout=timeout)
            version = found["metadata"]["resourceVersion"]
            attached.apply(self._replicas, master=False, resource_version=version, timeout=timeout)
        except Conflict:
            return False
        return True

    def _try_to_attach(self, cancel: threading.Event) -> bool:
        found = self._api.get(POOLS.path(self.namespace, self.name), cancel=cancel)
        there = found["spec"].get("master") or {}
        epoch = int(there.get("epoch") or 0)
        if there and identity_in(found) == self._master.identity:
            self._attached = self._as_master(found, epoch)
            return True  # by an attempt whose answer was lost
        if there:
            self._check_lost(found, there)
        self.displaced = str(there.get("identity") or there.get("host") or "")
        seen = int((found.get("status") or {}).get("masterEpoch") or 0)
        attached = self._as_master(found, 1 + max(epoch, seen))
        attached.relay = self._master.relay
        self._replicas = 0 if there else int(found["spec"].get("replicas") or 0)
        version = found["metadata"]["resourceVersion"]
        # First: if the call fails, ``detach`` checks whether it took effect.
        self._attached = attached
        try:
            attached.apply(self._replicas, resource_version=version, cancel=cancel)
        except Conflict:
            return False
        return True

    def _as_master(self, found: Body, epoch: int) -> AttachedPool:
        return AttachedPool(self._api, found, self._master, epoch, self._credentials)

    def _check_lost(self, found: Body, there: Body) -> None:
        """Raise FiberPoolError unless the operator says that the present master is lost."""
        status = found.get("status") or {}
        known = {entry["type"]: entry["status"] for entry in status.get("conditions") or ()}
        # An old status may be about an earlier master.
        current = status.get("observedGeneration", 0) >= found["metadata"]["generation"]
        if current and known.get(ConditionType.MASTER_ALIVE) == "False":
            return
        lease = self._lease_of(there)
        since = f" since {lease['acquireTime']}" if lease.get("acquireTime") else ""
        sign = (
            f", which last renewed its Lease at {lease['renewTime']}"
            if lease.get("renewTime")
            else ""
        )
        raise FiberPoolError(
            f"the FiberPool {self.name!r} in namespace {self.namespace!r} is in use: its master is "
            f"{there.get('identity') or there.get('host')}{since}{sign}. Wait until that program "
            "ends, or end it; a program that was killed counts as lost "
            f"{there.get('leaseDurationSeconds', 30)} s after its last renewal",
            pool=self.name,
            namespace=self.namespace,
            reason="InUse",
        )

    def _lease_of(self, master: Body) -> Body:
        name = master.get("leaseName")
        if not name:
            return {}
        try:
            spec = self._api.get(LEASES.path(self.namespace, name), timeout=0.0).get("spec")
        except ApiError:
            return {}  # the Lease only adds details to the message
        return spec or {}
