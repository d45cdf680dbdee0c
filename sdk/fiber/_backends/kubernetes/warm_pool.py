"""A FiberPool that somebody else keeps, which this program is the master of for a while."""

from __future__ import annotations

import json
import threading
import time

from fiber._backends.kubernetes.api import TIMEOUT, Api
from fiber._backends.kubernetes.api_errors import ApiError, Body, Conflict, Forbidden, NotFound
from fiber._backends.kubernetes.attached_pool import AttachedPool, Master, identity_in
from fiber._backends.kubernetes.resources import LEASES, POOLS, SECRETS
from fiber._backends.kubernetes.secret import pool_key_of
from fiber.errors import FiberPoolError
from fiber_api import names
from fiber_api.identity import InvalidKey
from fiber_api.names import ConditionType

_PAUSE = 0.05
"""Seconds until the next attempt after somebody else has written to the pool."""


def read_pool_key(
    api: Api, namespace: str, pool: str, spec: Body, cancel: threading.Event | None = None
) -> str:
    """Read the key of the pool with this ``spec`` from its Secret.  Blocks; ``ApiError``,
    FiberPoolError.
    """
    name = spec.get("credentialsSecretName") or names.secret_name(pool)
    what = f"the Secret {name!r} of the FiberPool {pool!r} in namespace {namespace!r}"
    try:
        secret = api.get(SECRETS.path(namespace, name), cancel=cancel)
        return pool_key_of(secret)
    except InvalidKey as error:
        raise FiberPoolError(
            f"{what} cannot serve: {error}. If the operator made it, delete it: it makes a new "
            "one; then delete the pool's pods, which hold the old one",
            pool=pool,
            namespace=namespace,
            reason=names.Reason.INVALID_CREDENTIALS,
        ) from None
    except Forbidden as error:
        raise FiberPoolError(
            f"cannot read {what}, whose credentials its master needs: {error.message}. The role "
            f"fiber-user reads no Secret; give this one: `kubectl create role NAME -n {namespace} "
            f"--verb=get --resource=secrets --resource-name={name}`, and bind it",
            pool=pool,
            namespace=namespace,
            reason=names.Reason.FORBIDDEN,
        ) from None


class WarmPool:
    """Pool of another owner, from before this program is its master until after that."""

    def __init__(self, api: Api, namespace: str, name: str, master: Master) -> None:
        self._api = api
        self._master = master
        self._attached: AttachedPool | None = None
        self._replicas = 0
        """Replicas of the pool before, which it gets again."""
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
        """Be its master from now on; FiberPoolError if it has one."""
        deadline = time.monotonic() + TIMEOUT
        while not self._try_to_attach(cancel):
            # Its status was written meanwhile, or another program was faster.
            if time.monotonic() > deadline or cancel.wait(_PAUSE):
                raise Conflict("it changes faster than it can be attached to", status=409)
        assert self._attached is not None
        try:
            self._attached.make_lease(cancel=cancel)
        except Conflict:
            self._attached.take_lease(cancel=cancel)  # the master before left it
        return self._attached

    def detach(self, timeout: float) -> None:
        """Leave it as it was, if this program still is its master."""
        attached = self._attached
        if attached is None:
            return
        deadline = time.monotonic() + timeout
        while not self._try_to_detach(attached, left := max(deadline - time.monotonic(), 0.0)):
            if not left:
                raise Conflict("it changes faster than it can be detached from", status=409)
            time.sleep(min(_PAUSE, left))

    def _try_to_detach(self, attached: AttachedPool, timeout: float) -> bool:
        try:
            found = self._api.get(attached.path, timeout=timeout)
        except NotFound:
            return True
        if attached.loss(found) is not None:
            return True
        try:
            # While it is ours: afterwards it may be the next master's.
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
        self._replicas = 0 if there else int(found["spec"].get("replicas") or 0)
        version = found["metadata"]["resourceVersion"]
        # Whatever becomes of the call, `detach` looks whether the pool is ours.
        self._attached = attached
        try:
            attached.apply(self._replicas, resource_version=version, cancel=cancel)
        except Conflict:
            return False
        return True

    def _as_master(self, found: Body, epoch: int) -> AttachedPool:
        return AttachedPool(self._api, found, self._master, epoch, kept_by_others=True)

    def _check_lost(self, found: Body, there: Body) -> None:
        """Raise unless the operator says that the master that is there is gone."""
        status = found.get("status") or {}
        known = {entry["type"]: entry["status"] for entry in status.get("conditions") or ()}
        # A status of before may be about the master before.
        current = status.get("observedGeneration", 0) >= found["metadata"]["generation"]
        if current and known.get(ConditionType.MASTER_ALIVE) == "False":
            return
        lease = self._lease_of(there)
        since = f" since {lease['acquireTime']}" if lease.get("acquireTime") else ""
        sign = f", last heard of at {lease['renewTime']}" if lease.get("renewTime") else ""
        raise FiberPoolError(
            f"the FiberPool {self.name!r} in namespace {self.namespace!r} is in use: its master is "
            f"{there.get('identity') or there.get('host')}{since}{sign}. Wait until that program "
            "ends, or end it; one that was killed counts as gone "
            f"{there.get('leaseDurationSeconds', 30)} s after its last sign of life",
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
            return {}  # it only makes the message better
        return spec or {}
