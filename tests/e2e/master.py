"""A master that gives no work: it attaches to a pool and says who dials in.

A program of its own, which runs beside the tests or, in the worker's image, in the cluster.  It
takes what it needs from its environment:

``MASTER_POOL``, ``MASTER_NAMESPACE``   the pool
``MASTER_HOST``                         where the workers can reach it
``MASTER_API``                          the API server without a login; absent within a pod, which
                                        has an account
``MASTER_LOST_GRACE``                   its lostGraceSeconds; the default if absent

and prints a JSON object a line: ``{"event": "joined", "name": "es-…", "at": 0.4}``, and the same
with ``welcomed`` when the agent knows it.  ``at`` is in seconds since just before it wrote itself
into the pool.
"""

from __future__ import annotations

import http
import json
import os
import signal
import socket
import ssl
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fiber._transport.credentials import WarmCredentials, make_certificate
from fiber._transport.link import Link
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop
from fiber._wire.messages import Recall
from fiber_api import names

ACCOUNT = Path("/var/run/secrets/kubernetes.io/serviceaccount")
IDENTITY = f"{socket.gethostname()}:{os.getpid()}"
_LOOK = 0.05  # seconds between two looks at the pool


class Api:
    """Client for a master's requests to the API server."""

    def __init__(self, namespace: str, pool: str) -> None:
        self._token = ""
        self._context: ssl.SSLContext | None = None
        self._url = os.environ.get("MASTER_API", "")
        if not self._url:
            host, port = (os.environ[f"KUBERNETES_SERVICE_{part}"] for part in ("HOST", "PORT"))
            self._url = f"https://{names.address_of(host, int(port))}"
            self._token = (ACCOUNT / "token").read_text()
            self._context = ssl.create_default_context(cafile=str(ACCOUNT / "ca.crt"))
        self._pool = f"/apis/{names.API_VERSION}/namespaces/{namespace}/{names.PLURAL}/{pool}"

    def status(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Wait until the pool's status is as wanted, and return it."""
        while True:
            status: dict[str, Any] = self._call("GET", self._pool).get("status", {})
            if wanted(status):
                return status
            time.sleep(_LOOK)

    def credentials(self) -> WarmCredentials:
        """The master's, with which it knows the agents of the pool."""
        status = self.status(lambda status: "publicKey" in status)
        return WarmCredentials(bytes.fromhex(status["publicKey"]), make_certificate())

    def attach(self, master: dict[str, Any]) -> int:
        """Be the pool's master, with an epoch above those of all before; which that is."""
        epoch = 0

        def next_one(pool: dict[str, Any]) -> dict[str, Any]:
            nonlocal epoch
            there = pool["spec"].get("master", {}).get("epoch", 0)
            epoch = 1 + int(max(there, pool.get("status", {}).get("masterEpoch", 0)))
            return {"master": {**master, "epoch": epoch}}

        self._apply(next_one)
        return epoch

    def sign(self, credentials: WarmCredentials, epoch: int) -> None:
        """Wait for the operator's signature for this master, and take it."""
        status = self.status(
            lambda status: "masterSignature" in status and status.get("masterEpoch") == epoch
        )
        assert credentials.take_signature(epoch, bytes.fromhex(status["masterSignature"]))

    def detach(self, epoch: int) -> None:
        """Leave the pool without a master, unless it has another one by now."""

        def nobody(pool: dict[str, Any]) -> dict[str, Any] | None:
            master = pool["spec"].get("master", {})
            ours = (master.get("epoch"), master.get("identity")) == (epoch, IDENTITY)
            return {} if ours else None

        self._apply(nobody)

    def _apply(self, change: Callable[[dict[str, Any]], dict[str, Any] | None]) -> None:
        """Write the master's part of the spec, and remove other fields of this part.

        Only into the pool as it was read: of two masters that come at once the second one sees
        the first.  The operator writes too, so that it may take more than one reading.
        """
        query = f"fieldManager={names.SDK_MANAGER}&force=true"
        while True:
            pool = self._call("GET", self._pool)
            spec = change(pool)
            if spec is None:
                return
            body = {
                "apiVersion": names.API_VERSION,
                "kind": names.KIND,
                "metadata": {"resourceVersion": pool["metadata"]["resourceVersion"]},
                "spec": spec,
            }
            try:
                self._call("PATCH", f"{self._pool}?{query}", body)
                return
            except urllib.error.HTTPError as error:
                if error.code != http.HTTPStatus.CONFLICT:
                    raise

    def _call(self, method: str, path: str, body: object = None) -> dict[str, Any]:
        request = urllib.request.Request(self._url + path, method=method)
        request.add_header("Content-Type", "application/apply-patch+yaml")
        if self._token:
            request.add_header("Authorization", f"Bearer {self._token}")
        request.data = None if body is None else json.dumps(body).encode()
        with urllib.request.urlopen(request, context=self._context, timeout=30) as answer:
            document: dict[str, Any] = json.load(answer)
        return document


class Agent:
    """Observer of one agent."""

    def __init__(self, link: Link, loop: Loop, say: Any) -> None:
        self._name, self._loop, self._link, self._say = link.peer.name, loop, link, say
        link.attach(self)
        say("joined", name=self._name)
        link.send(Recall(0).encode())  # something harmless, to see it acknowledged
        self._tell_when_welcomed()

    def _tell_when_welcomed(self) -> None:
        statistics = self._link.statistics()
        waits = statistics.queued_frames or statistics.unacknowledged_datagrams
        if statistics.frames_sent and not waits:
            self._say("welcomed", name=self._name)
        else:
            self._loop.call_later(0.01, self._tell_when_welcomed)

    def on_frame(self, frame: object) -> None: ...
    def on_suspect(self) -> None: ...
    def on_trusted(self) -> None: ...

    def on_lost(self, reason: str) -> None:
        self._say("lost", name=self._name, reason=reason)


def main() -> None:
    """Attach, stay until SIGTERM, and detach."""
    api = Api(os.environ["MASTER_NAMESPACE"], os.environ["MASTER_POOL"])
    host = os.environ["MASTER_HOST"]
    grace = os.environ.get("MASTER_LOST_GRACE")
    lost_grace = None if grace is None else int(grace)
    started = time.monotonic()

    def say(event: str, **facts: object) -> None:
        at = round(time.monotonic() - started, 3)
        line = json.dumps({"event": event, "at": at, **facts})
        print(line + "\n", end="", flush=True)  # in one write, as two threads print

    loop = Loop()
    loop.start_thread("master-io")
    agents: list[Agent] = []
    credentials = api.credentials()
    listener = MasterListener(
        loop,
        names.address_of(host, 0),
        credentials,
        on_agent=lambda link: agents.append(Agent(link, loop, say)),
        on_refused=lambda reason: say("refused", reason=reason),
        lost_grace=lost_grace,
    )
    port = int(listener.address.rpartition(":")[2])
    certificate = credentials.certificate.hash.hex()
    master: dict[str, Any] = {
        "host": host,
        "port": port,
        "identity": IDENTITY,
        "certificate": certificate,
    }
    if lost_grace is not None:
        master["lostGraceSeconds"] = lost_grace
    started = time.monotonic()
    epoch = api.attach(master)
    api.sign(credentials, epoch)
    say("attached", address=listener.address, epoch=epoch)
    loop.call_soon(listener.look_again)
    told = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: told.set())
    told.wait()
    closed = threading.Event()
    listener.close("the master ends", then=closed.set)
    closed.wait(10)
    api.detach(epoch)
    say("detached")
    loop.stop()


if __name__ == "__main__":
    main()
