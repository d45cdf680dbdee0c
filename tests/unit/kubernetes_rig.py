"""A program's side of a FiberPool, against an API server in this process."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import yaml

from fakes.kubernetes_api import Call
from fakes.served import Served, served
from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.attached_pool import AttachedPool, OwnPool, PoolMaster, WarmPool
from fiber._backends.kubernetes.fiber_pool import FiberPoolClient
from fiber._transport.credentials import make_certificate, make_credentials
from fiber._transport.loop import Loop
from fiber.errors import FiberPoolError
from fiber_api import names
from patience import PATIENCE
from warm_key import WarmKey

NAMESPACE = "lab"
CERTIFICATE = make_certificate()
MASTER = PoolMaster("10.0.0.7", 41337, "laptop-7:4711", CERTIFICATE.hash.hex())
OTHER = PoolMaster("10.0.0.8", 41338, "laptop-8:4712", CERTIFICATE.hash.hex())
Body = dict[str, Any]


def kubeconfig(folder: Path, url: str, user: Body | None = None, /, **cluster: str) -> Path:
    """A file for ``KUBECONFIG`` whose current context is ``here``, with the namespace lab."""
    path = folder / "kubeconfig"
    contexts = {"here": {"namespace": NAMESPACE}, "bare": {}}
    document = {
        "apiVersion": "v1",
        "kind": "Config",
        "current-context": "here",
        "clusters": [{"name": "test", "cluster": {"server": url, **cluster}}],
        "users": [{"name": "me", "user": user or {"token": "one"}}],
        "contexts": [
            {"name": name, "context": {"cluster": "test", "user": "me", **more}}
            for name, more in contexts.items()
        ],
    }
    path.write_text(yaml.safe_dump(document))
    return path


def pool_body(name: str = "es-1") -> Body:
    """A FiberPool without what the master writes."""
    template = {"spec": {"containers": [{"name": names.WORKER_CONTAINER, "image": "worker"}]}}
    return {
        "apiVersion": names.API_VERSION,
        "kind": names.KIND,
        "metadata": {"name": name},
        "spec": {"template": template},
    }


@dataclass
class Told:
    """An observer that remembers."""

    attached: list[bool] = field(default_factory=list)
    statuses: list[Body] = field(default_factory=list)
    pods: list[tuple[str, Body | None]] = field(default_factory=list)
    expiries: list[bool] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    errors: list[FiberPoolError] = field(default_factory=list)
    ended: bool = False
    agents: int = 0
    _changed: threading.Condition = field(default_factory=threading.Condition)

    def connected(self) -> int:
        return self.agents

    def on_attached(self, pool: AttachedPool) -> None:
        self._note(self.attached, True)

    def on_status(self, status: Body) -> None:
        self._note(self.statuses, status)

    def on_pod(self, name: str, pod: Body | None) -> None:
        self._note(self.pods, (name, pod))

    def on_lease_expired(self) -> None:
        self._note(self.expiries, True)

    def on_warning(self, message: str) -> None:
        self._note(self.warnings, message)

    def on_error(self, error: FiberPoolError) -> None:
        self._note(self.errors, error)

    def on_end(self) -> None:
        with self._changed:
            self.ended = True
            self._changed.notify_all()

    def wait(self, what: Callable[[], object], timeout: float = PATIENCE) -> None:
        """Wait until the condition holds; check it after each notice."""
        with self._changed:
            assert self._changed.wait_for(what, timeout), self

    def error(self) -> FiberPoolError:
        """The one that is told, waited for."""
        self.wait(lambda: self.errors)
        return self.errors[0]

    def _note(self, where: list[Any], what: object) -> None:
        with self._changed:
            where.append(what)
            self._changed.notify_all()


class Operator:
    """Does as much as a program waits for: it looks at each pool that is written to."""

    def __init__(self, server: Served) -> None:
        self._store = server.store
        self.mute = False
        self.key = WarmKey()
        server.api.after = self._after

    def _after(self, call: Call) -> None:
        if call.plural == names.PLURAL and call.verb in ("create", "patch") and not self.mute:
            for pool in self._store.list(names.PLURAL, call.namespace):
                self._look(pool)

    def _look(self, pool: Body) -> None:
        metadata = pool["metadata"]
        status = {**(pool.get("status") or {}), "observedGeneration": metadata["generation"]}
        if master := pool["spec"].get("master"):
            status["masterEpoch"] = master["epoch"]
            status["masterSignature"] = self.key.signature(master["epoch"], CERTIFICATE).hex()
        self._store.set_status(names.PLURAL, metadata["namespace"], metadata["name"], status)


class Rig:
    """A program, the API server that it uses, and what it was told."""

    def __init__(self, server: Served, api: Api, loop: Loop) -> None:
        self.server = server
        self.api = api
        self.loop = loop
        self.operator = Operator(server)
        self._clients: list[FiberPoolClient] = []

    def own(
        self,
        told: Told,
        name: str = "es-1",
        owner: Body | None = None,
        master: PoolMaster = MASTER,
    ) -> FiberPoolClient:
        """A client that makes a pool."""
        credentials = make_credentials()
        attachment = OwnPool(self.api, NAMESPACE, pool_body(name), credentials, master, owner)
        return self._client(attachment, told)

    def warm(self, told: Told, master: PoolMaster = MASTER, name: str = "warm") -> FiberPoolClient:
        """A client that attaches to one."""
        credentials = self.operator.key.unsigned(CERTIFICATE)
        return self._client(WarmPool(self.api, NAMESPACE, name, master, credentials), told)

    def pool(self, name: str = "es-1") -> Body:
        """The pool as it is now."""
        return self.get(names.PLURAL, name)

    def spec(self, name: str = "es-1") -> Body:
        """Return its spec, empty if there is no pool."""
        pools = self.server.objects(names.PLURAL)
        return next((pool["spec"] for pool in pools if pool["metadata"]["name"] == name), {})

    def get(self, plural: str, name: str) -> Body:
        """An object as it is now."""
        return self.server.do(self.server.store.get, plural, NAMESPACE, name)

    def add_pod(self, name: str, pool: str = "es-1") -> None:
        labels = {names.LABEL_POOL_UID: self.pool(pool)["metadata"]["uid"]}
        body = {"metadata": {"name": name, "labels": labels}, "spec": {}}
        self.server.do(self.server.store.create, "pods", NAMESPACE, body)

    def remove(self, plural: str, name: str) -> None:
        self.server.do(self.server.store.remove, plural, NAMESPACE, name)

    def close(self) -> None:
        self.server.api.faults.clear()
        self.server.api.down = False
        for client in self._clients:
            client.close()
        self.api.close()

    def _client(self, attachment: OwnPool | WarmPool, told: Told) -> FiberPoolClient:
        client = FiberPoolClient(self.api, self.loop, attachment, told)
        self._clients.append(client)
        client.start()
        return client


@contextlib.contextmanager
def rig(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    """Yield a rig that ends with the test."""
    with served() as server:
        monkeypatch.setenv("KUBECONFIG", str(kubeconfig(folder, server.api.url)))
        loop = Loop()
        loop.start_thread("test-io")
        made = Rig(server, Api.connect(), loop)
        try:
            yield made
        finally:
            made.close()
            loop.stop()
