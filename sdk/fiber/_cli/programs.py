"""Programs that ``fiber run`` has started: a Job each, with one pod.

``ProgramPod`` is what the API server says of the pod now.
"""

from __future__ import annotations

import http.client
import struct
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from fiber._backends.kubernetes.problems import pod_end
from fiber._backends.kubernetes.relay_client import state_of
from fiber._cli.failures import CommandError, explained, not_found
from fiber._cli.forward import open_socket
from fiber._cli.session import Session
from fiber.launcher import DROPPED, EXIT, RECORD
from fiber_api import names
from fiber_api.rest import JOBS, PODS, Body, NotFound

_SECONDS = 5.0
"""Seconds that the API server may take."""


class ProgramPod(NamedTuple):
    """Pod of a program."""

    name: str
    document: Mapping[str, Any]

    @property
    def phase(self) -> str:
        return str((self.document.get("status") or {}).get("phase", "Pending"))

    @property
    def runs(self) -> bool:
        return self.phase == "Running" and self.exit_status is None

    @property
    def exit_status(self) -> int | None:
        """Exit status of the program; None if it has not ended, or if that is not known."""
        for container in (self.document.get("status") or {}).get("containerStatuses") or ():
            ended = (container.get("state") or {}).get("terminated")
            if ended:
                return int(ended.get("exitCode", 1))
        return None

    @property
    def state(self) -> str:
        """Return what the pod does, in words that its name precedes."""
        return "runs" if self.runs else state_of(self.document)

    @property
    def disaster(self) -> str:
        """Return why the cluster ended the pod; empty if it did not."""
        for container in (self.document.get("status") or {}).get("containerStatuses") or ():
            ended = (container.get("state") or {}).get("terminated") or {}
            if ended.get("reason") == "OOMKilled":
                return "it needed more memory than its limit (OOMKilled)"
        end = pod_end(self.document)
        return "" if end is None or not end.disrupted else end.reason


def find_job(session: Session, name: str) -> Body:
    """Return the Job of a program; CommandError with the nearest name if there is none."""
    with explained(f"look for the program {name!r}"):
        try:
            job = session.api.get(JOBS.path(session.namespace, name), timeout=_SECONDS)
        except NotFound:
            job = {}
        if names.LABEL_PROGRAM in ((job.get("metadata") or {}).get("labels") or {}):
            return job
        existing = [str(job["metadata"]["name"]) for job in list_jobs(session)]
    raise not_found("program", name, existing, session.where)


def list_jobs(session: Session) -> list[Body]:
    """Return the Jobs of all programs of the namespace."""
    selector = {"labelSelector": names.LABEL_PROGRAM}
    with explained("list the programs"):
        listing = session.api.list(JOBS.path(session.namespace), selector, timeout=_SECONDS)
    return list(listing.get("items") or ())


def find_pod(session: Session, program: str) -> ProgramPod | None:
    """Return the newest pod of a program; None if there is none yet, or none any longer."""
    selector = {"labelSelector": f"{names.LABEL_PROGRAM}={program}"}
    with explained(f"look for the pod of {program!r}"):
        listing = session.api.list(PODS.path(session.namespace), selector, timeout=_SECONDS)
    pods = listing.get("items") or []
    if not pods:
        return None
    newest = max(pods, key=lambda pod: str(pod["metadata"]["creationTimestamp"]))
    return ProgramPod(str(newest["metadata"]["name"]), newest)


class Launcher:
    """Client of the launcher in a program's pod.  Its calls raise ``ApiError`` and OSError."""

    def __init__(self, session: Session, pod: str) -> None:
        self._session = session
        self._path = PODS.path(session.namespace, pod)

    def start(self, archive: bytes, layout: str) -> None:
        """Bring the program's files, and start it."""
        connection = self._connection()
        try:
            connection.request("PUT", "/program", archive, {"Fiber-Layout": layout})
            response = connection.getresponse()
            if response.status != 200:
                raise CommandError("the program did not start in its pod", response.reason)
        finally:
            connection.close()

    def signal(self, number: int) -> None:
        """Send a signal to the program."""
        connection = self._connection()
        try:
            connection.request("POST", f"/signal/{number}", b"")
            connection.getresponse()
        finally:
            connection.close()

    def output(self, position: int) -> Iterator[tuple[int, bytes]]:
        """Yield the kinds and contents of the output's records from ``position`` on.

        ConnectionError if the connection breaks before the end of the program.
        """
        connection = self._connection()
        try:
            connection.request("GET", f"/output/{position}")
            response = connection.getresponse()
            while True:
                kind, length = RECORD.unpack(_exactly(response, RECORD.size))
                yield kind, _exactly(response, length)
                if kind == EXIT:
                    return
        finally:
            connection.close()

    def _connection(self) -> http.client.HTTPConnection:
        forward = self._session.api.port_forward(self._path, names.LAUNCHER_PORT)
        connection = http.client.HTTPConnection("localhost")
        connection.sock = open_socket(forward)
        return connection


def _exactly(response: http.client.HTTPResponse, size: int) -> bytes:
    found = b""
    while len(found) < size:
        piece = response.read(size - len(found))
        if not piece:
            raise ConnectionResetError("the connection to the program's pod broke")
        found += piece
    return found


def number_in(kind: int, data: bytes) -> int:
    """Return the number in a DROPPED or EXIT record."""
    return int(struct.unpack(">I" if kind == DROPPED else ">i", data)[0])
