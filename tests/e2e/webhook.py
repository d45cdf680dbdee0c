"""An admission webhook that adds a container to each pod of a namespace, as service meshes do."""

from __future__ import annotations

import base64
import json
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from cluster.pki import Pki
from e2e.kube import Body, path_of
from e2e.scene import Scene

SIDECAR = "proxy"
_UNTIL_SIGTERM = """
import signal
# A first process hears no signal that it neither handles nor blocks.
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
signal.sigwait({signal.SIGTERM})
"""


@contextmanager
def sidecars(scene: Scene, host: str, image: str, folder: Path) -> Iterator[None]:
    """Give each pod that is made meanwhile a first container, which runs until the pod is deleted.

    ``host`` is an address of this machine that the API server reaches.
    """
    container = {
        "name": SIDECAR,
        "image": image,
        "command": ["python", "-c", _UNTIL_SIGTERM],
        "resources": {"requests": {"cpu": "5m", "memory": "16Mi"}},
    }
    pki = Pki(folder)
    with _served(host, pki, container) as port:
        authority = base64.b64encode(pki.authority.certificate.read_bytes()).decode()
        client = {"url": f"https://{host}:{port}/", "caBundle": authority}
        webhooks = path_of("mutatingwebhookconfigurations")
        scene.kube.create(webhooks, _configuration(scene.namespace, client))
        try:
            scene.wait("the webhook is asked", lambda: _adds(scene, image), poll=0.2)
            yield
        finally:
            scene.kube.delete(f"{webhooks}/{scene.namespace}")


def _adds(scene: Scene, image: str) -> bool:
    """Return whether a pod of one container would get another."""
    spec = {"containers": [{"name": "only", "image": image}]}
    pod = {"metadata": {"name": "probe"}, "spec": spec}
    made = scene.kube.create(scene.path("pods"), pod, dryRun="All")
    return len(made["spec"]["containers"]) == 2


def _configuration(namespace: str, client: Body) -> Body:
    pods = {"apiGroups": [""], "apiVersions": ["v1"], "resources": ["pods"]}
    webhook = {
        "name": "sidecar.fiber.test",
        "clientConfig": client,
        "rules": [{**pods, "operations": ["CREATE"]}],
        "namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": namespace}},
        "admissionReviewVersions": ["v1"],
        "sideEffects": "None",
    }
    return {"metadata": {"name": namespace}, "webhooks": [webhook]}


@contextmanager
def _served(host: str, pki: Pki, container: Body) -> Iterator[int]:
    """Answer the API server on a port of ``host``, which is yielded."""
    patch = [{"op": "add", "path": "/spec/containers/0", "value": container}]
    answer = {"allowed": True, "patchType": "JSONPatch", "patch": _encoded(patch)}

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            review = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            response = {**answer, "uid": review["request"]["uid"]}
            body = json.dumps({**review, "request": None, "response": response}).encode()
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            """Log no requests."""

    pair = pki.issue("webhook", "webhook", addresses=f"IP:{host}")
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(pair.certificate, pair.key)
    with ThreadingHTTPServer((host, 0), Handler) as server:
        server.socket = context.wrap_socket(server.socket, server_side=True)
        thread = threading.Thread(target=server.serve_forever, name="webhook", daemon=True)
        thread.start()
        try:
            yield server.server_address[1]
        finally:
            server.shutdown()
            thread.join()


def _encoded(document: object) -> str:
    return base64.b64encode(json.dumps(document).encode()).decode()
