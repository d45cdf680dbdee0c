"""A FiberPool that this program makes for itself, and deletes when it ends."""

from __future__ import annotations

import threading

from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.api_errors import Body, Conflict, Forbidden, NotFound, Transient
from fiber._backends.kubernetes.attached_pool import AttachedPool, Master, identity_in
from fiber._backends.kubernetes.resources import POOLS, SECRETS
from fiber._backends.kubernetes.secret import secret_body
from fiber._transport.credentials import MasterCredentials
from fiber_api import names

_EPOCH = 1
"""Epoch of a program's own pool, which never has another master."""


class OwnPool:
    """Pool of this program alone, from before it is made until it is deleted.

    Its name must never have been used before.
    """

    def __init__(
        self,
        api: Api,
        namespace: str,
        body: Body,
        credentials: MasterCredentials,
        master: Master,
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
        self.doing = "make"
        self.displaced = ""
        self.remedy = f"kubectl delete fiberpool {self.name} -n {namespace}"
        """Command that removes the pool if ``detach`` cannot."""

    def attach(self, cancel: threading.Event) -> AttachedPool:
        """Make it, without pods; then its Secret and its Lease, which go when it goes.

        It has its master from the first moment: whoever dies between two of these calls leaves a
        pool whose master's Lease is absent or gets old, and that the operator deletes.
        """
        self._attached = AttachedPool(self._api, self._create(cancel), self._master, _EPOCH)
        self._make_secret(self._attached, cancel)
        try:
            self._attached.make_lease(cancel=cancel)
        except Conflict as error:
            if not (error.repeated and self._attached.has_lease(cancel=cancel)):
                raise
            # It was made by an attempt whose answer was lost.
        return self._attached

    def detach(self, timeout: float) -> None:
        """Delete it, if it may be there."""
        if self._attached is None and not self._may_exist:
            return
        uid = None if self._attached is None else self._attached.uid
        try:
            self._api.delete(POOLS.path(self.namespace, self.name), uid=uid, timeout=timeout)
        except (NotFound, Conflict):
            pass  # it is gone, or even its name is another's

    def _make_secret(self, pool: AttachedPool, cancel: threading.Event) -> None:
        name = names.secret_name(self.name)
        secret = secret_body(name, self._credentials, pool.owner, pool.labels)
        try:
            self._api.create(SECRETS.path(self.namespace), secret, cancel=cancel)
        except Conflict as error:
            if not error.repeated:
                raise  # somebody else was faster
            try:
                found = self._api.get(SECRETS.path(self.namespace, name), cancel=cancel)
            except Forbidden:
                return  # fiber-user reads no Secret. With another's keys no agent could join
            if found.get("data") != secret["data"]:
                raise
            # It was made by an attempt whose answer was lost.

    def _create(self, cancel: threading.Event) -> Body:
        metadata = dict(self._body["metadata"])
        if self._owner is not None:
            metadata["ownerReferences"] = [self._owner]
        spec = {
            **self._body["spec"],
            "replicas": 0,
            "master": self._master.spec(self.name, _EPOCH),
            "onLost": "Delete",
            "credentialsSecretName": names.secret_name(self.name),
        }
        body = {**self._body, "metadata": metadata, "spec": spec}
        try:
            return self._api.create(POOLS.path(self.namespace), body, strict=True, cancel=cancel)
        except Conflict as error:
            if not error.repeated:
                raise
            found = self._api.get(POOLS.path(self.namespace, self.name), cancel=cancel)
            if identity_in(found) != self._master.identity:
                raise
            return found  # made by an attempt whose answer was lost
        except Transient:
            self._may_exist = True
            raise
