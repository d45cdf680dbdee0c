"""The API of one cluster: kubectl for the commands of users, `kubectl proxy` for other calls.

The proxy knows how to log in, so that plain HTTP does here: calls take milliseconds, and watches
tell of a change when it happens.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from e2e.clusters import find_program

Body = dict[str, Any]

_GROUPS = {
    "": "/api/v1",
    "namespaces": "/api/v1",
    "fiberpools": "/apis/fiber.dev/v1alpha1",
    "deployments": "/apis/apps/v1",
    "endpointslices": "/apis/discovery.k8s.io/v1",
    "leases": "/apis/coordination.k8s.io/v1",
    "customresourcedefinitions": "/apis/apiextensions.k8s.io/v1",
    "clusterroles": "/apis/rbac.authorization.k8s.io/v1",
    "clusterrolebindings": "/apis/rbac.authorization.k8s.io/v1",
    "roles": "/apis/rbac.authorization.k8s.io/v1",
    "rolebindings": "/apis/rbac.authorization.k8s.io/v1",
    "networkpolicies": "/apis/networking.k8s.io/v1",
    "mutatingwebhookconfigurations": "/apis/admissionregistration.k8s.io/v1",
}
_PATIENCE = 60.0
_PAUSE = 0.1

MERGE = "application/merge-patch+json"
JSON_PATCH = "application/json-patch+json"
APPLY = "application/apply-patch+yaml"


class Failed(Exception):
    """Error of a program that failed.  The message is its output."""


class Refused(Exception):
    """The API server said no."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(f"HTTP {status}: {message}")
        self.status = status
        self.message = message


def path_of(resource: str, namespace: str = "", name: str = "", subresource: str = "") -> str:
    """The path of an object or, without a name, of all of its kind (in a namespace)."""
    group = _GROUPS.get(resource, _GROUPS[""])
    scope = f"namespaces/{namespace}" if namespace else ""
    return "/".join(part for part in (group, scope, resource, name, subresource) if part)


def run(program: str, *arguments: str | Path, stdin: str = "", seconds: float = _PATIENCE) -> str:
    """Return a program's output; raise Failed with its error."""
    command = [program, *map(str, arguments)]
    done = subprocess.run(command, input=stdin, capture_output=True, text=True, timeout=seconds)
    if done.returncode:
        raise Failed(f"{' '.join(command)}\n{done.stdout}{done.stderr}")
    return done.stdout


class Kube:
    """API of one cluster. Every method may be called from any thread."""

    def __init__(self, kubeconfig: Path) -> None:
        self.kubeconfig = kubeconfig
        self._kubectl = find_program("kubectl")
        self._proxy = subprocess.Popen(
            [self._kubectl, "--kubeconfig", str(kubeconfig), "proxy", "--port=0"],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._proxy.stdout is not None
        line = self._proxy.stdout.readline()
        self.host, _, port = line.strip().rpartition(" ")[2].partition(":")
        if not port:
            self.close()
            raise Failed(f"kubectl proxy does not serve: it said {line!r}")
        self.port = int(port)

    @property
    def url(self) -> str:
        """Address where the API is served without a login."""
        return f"http://{self.host}:{self.port}"

    def close(self) -> None:
        """End the proxy."""
        self._proxy.kill()
        self._proxy.communicate()

    def kubectl(self, *arguments: str, stdin: str = "", seconds: float = _PATIENCE) -> str:
        """Return kubectl's output."""
        login = ("--kubeconfig", self.kubeconfig)
        return run(self._kubectl, *login, *arguments, stdin=stdin, seconds=seconds)

    def delete_namespaces(self, *which: str) -> None:
        """Delete the namespaces, and wait until they are gone."""
        self.kubectl(
            "delete", "namespaces", *which, "--ignore-not-found", "--timeout=120s", seconds=180
        )

    def apply(self, manifest: Body, *arguments: str) -> str:
        """``kubectl apply -f``."""
        return self.kubectl("apply", *arguments, "-f", "-", stdin=json.dumps(manifest))

    def get(self, path: str, **query: str) -> Body | None:
        """The object, or None."""
        try:
            return self.call("GET", path, query=query)
        except Refused as refused:
            if refused.status == 404:
                return None
            raise

    def items(self, path: str, **query: str) -> list[Body]:
        """All objects there."""
        found: list[Body] = self.call("GET", path, query=query)["items"]
        return found

    def create(self, path: str, body: Body, **query: str) -> Body:
        """Create an object in the list at ``path``."""
        return self.call("POST", path, body, query=query)

    def patch(self, path: str, body: Body, kind: str = MERGE, **query: str) -> Body:
        """A merge patch, or server-side apply."""
        return self.call("PATCH", path, body, kind=kind, query=query)

    def delete(self, path: str, body: Body | None = None) -> None:
        """Delete an object if it exists."""
        try:
            self.call("DELETE", path, body)
        except Refused as refused:
            if refused.status != 404:
                raise

    def text(self, path: str, **query: str) -> str:
        """Return the text at a path, a log for example."""
        return self._send("GET", path, None, "", query).decode(errors="replace")

    def call(
        self,
        method: str,
        path: str,
        body: Body | list[Body] | None = None,
        *,
        kind: str = "application/json",
        query: Mapping[str, str] | None = None,
    ) -> Body:
        """Send one request and return the document in its answer."""
        answer: Body = json.loads(self._send(method, path, body, kind, query or {}))
        return answer

    def _send(
        self,
        method: str,
        path: str,
        body: Body | list[Body] | None,
        kind: str,
        query: Mapping[str, str],
    ) -> bytes:
        connection = http.client.HTTPConnection(self.host, self.port, timeout=_PATIENCE)
        try:
            content = None if body is None else json.dumps(body)
            headers = {"Content-Type": kind} if body is not None else {}
            connection.request(method, _with(path, query), content, headers)
            response = connection.getresponse()
            data = response.read()
        finally:
            connection.close()
        if response.status >= 300:
            raise Refused(response.status, _message(data))
        return data


class Stream:
    """Lines of a long answer, which a thread passes to ``tell`` until ``close``.

    ``begin`` returns the request of each new connection, or None to end.
    """

    def __init__(
        self, kube: Kube, begin: Callable[[], str | None], tell: Callable[[str], None]
    ) -> None:
        self._kube = kube
        self._begin = begin
        self._tell = tell
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._socket: socket.socket | None = None
        self._thread = threading.Thread(target=self._run, name="stream", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the calls of ``tell``, and end the thread."""
        with self._lock:
            self._closed.set()
            if self._socket is not None:
                with contextlib.suppress(OSError):  # the other side was quicker
                    self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                path = self._begin()
                if path is None:
                    return
                for line in self._lines(path):
                    self._tell(line)
            except (OSError, http.client.HTTPException, Refused):
                pass  # the API server may be away; the next request gets the same lines
            self._closed.wait(_PAUSE)

    def _lines(self, path: str) -> Iterator[str]:
        connection = http.client.HTTPConnection(self._kube.host, self._kube.port)
        try:
            connection.connect()
            with self._lock:
                if self._closed.is_set():
                    return
                self._socket = connection.sock
            connection.request("GET", path)
            response = connection.getresponse()
            if response.status >= 300:
                raise Refused(response.status, _message(response.read()))
            while not self._closed.is_set() and (line := response.readline()):
                yield line.decode(errors="replace")
        finally:
            with self._lock:
                self._socket = None
                connection.close()


def _with(path: str, query: Mapping[str, str]) -> str:
    return f"{path}?{urlencode(query)}" if query else path


def _message(data: bytes) -> str:
    try:
        return str(json.loads(data)["message"])
    except (ValueError, KeyError, TypeError):
        return data.decode(errors="replace")


def environment(**more: str) -> dict[str, str]:
    """Return this process's environment with some variables set."""
    return {**os.environ, **more}
