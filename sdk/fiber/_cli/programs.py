"""Programs that ``fiber run`` has started: a Job each, with one pod.

``ProgramPod`` is what the API server says of the pod now.
"""

from __future__ import annotations

import contextlib
import http.client
import io
import json
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from typing import IO, Any, NamedTuple

from fiber._backends.kubernetes.problems import pod_end
from fiber._backends.kubernetes.relay_client import state_of
from fiber._cli.failures import explained, not_found
from fiber._cli.forward import open_socket
from fiber._cli.session import SECONDS, Session, check_name
from fiber.launcher import (
    ALIVE,
    DROPPED,
    EXIT,
    FAILURE,
    FOLLOWS,
    HEARTBEAT,
    LAYOUT,
    NUMBER,
    RECORD,
    STATUS,
)
from fiber_api import names
from fiber_api.rest import JOBS, PODS, Body, Conflict, NotFound
from fiber_api.times import parse_time

_SILENCE = 3 * HEARTBEAT
"""Seconds without a byte after which a connection counts as broken."""

_STARTS_WITHIN = 300.0
"""Seconds in which the launcher unpacks the program's files."""

_LOST_AFTER = 60.0
"""Seconds after the end of a pod's grace, at which its node counts as lost."""


class ProgramPod(NamedTuple):
    """Pod of a program."""

    name: str
    document: Mapping[str, Any]

    @property
    def program(self) -> str:
        return str(self.document["metadata"]["labels"][names.LABEL_PROGRAM])

    @property
    def phase(self) -> str:
        return str((self.document.get("status") or {}).get("phase", "Pending"))

    @property
    def runs(self) -> bool:
        """True while the program's container runs."""
        return self.phase == "Running" and "waiting" not in self._state and not self.has_ended

    @property
    def has_ended(self) -> bool:
        return "terminated" in self._state or self.phase in ("Failed", "Succeeded")

    @property
    def is_lost(self) -> bool:
        """True if the pod should have ended, and its node has not said so."""
        deadline = self.document["metadata"].get("deletionTimestamp")
        return bool(deadline) and parse_time(deadline) + _LOST_AFTER < time.time()

    @property
    def progress(self) -> str | None:
        """Return running, succeeded or failed; None if it has not started, or if it is lost."""
        if self.runs:
            return "running"
        if not self.has_ended or self.is_lost:
            return None
        return "failed" if self.exit_status or self.phase == "Failed" else "succeeded"

    @property
    def exit_status(self) -> int | None:
        """Exit status of the program; None if it has not ended, or if that is not known."""
        ended = self._state.get("terminated")
        if not ended or ended.get("reason") in names.LOST_CONTAINERS:
            return None
        return int(ended.get("exitCode", 1))

    @property
    def state(self) -> str:
        """Return what the pod does, in words that its name precedes."""
        return "runs" if self.runs else " ".join(state_of(self.document).split())

    @property
    def disaster(self) -> str:
        """Return why the cluster ended the pod; empty if it did not."""
        end = pod_end(self.document, names.PROGRAM_CONTAINER)
        if end is None:
            return ""
        own = end.reason.partition(":")[0] in ("OOMKilled", "Evicted")
        return " ".join(end.reason.split()) if own or end.disrupted else ""

    @property
    def _state(self) -> Mapping[str, Any]:
        """State of the program's container; others are beside it if the template adds them."""
        for container in (self.document.get("status") or {}).get("containerStatuses") or ():
            if container.get("name") == names.PROGRAM_CONTAINER:
                return container.get("state") or {}
        return {}


def find_job(session: Session, name: str) -> Body:
    """Return the Job of a program; CommandError with the nearest name if there is none."""
    check_name("program", name)
    with explained(f"look for the program {name!r}"):
        try:
            job = session.api.get(JOBS.path(session.namespace, name), timeout=SECONDS)
        except NotFound:
            job = {}
        if names.LABEL_PROGRAM in ((job.get("metadata") or {}).get("labels") or {}):
            return job
        existing = [str(job["metadata"]["name"]) for job in list_jobs(session)]
    raise not_found("program", name, existing, session.where)


def list_jobs(session: Session) -> list[Body]:
    """Return the Jobs of all programs of the namespace."""
    with explained("list the programs"):
        return session.items(JOBS, names.LABEL_PROGRAM)


def find_pod(session: Session, program: str) -> ProgramPod | None:
    """Return the newest pod of a program; None if there is none yet, or none any longer."""
    with explained(f"look for the pod of {program!r}"):
        return read_pod(session, program)


def read_pod(session: Session, program: str) -> ProgramPod | None:
    """Return the newest pod of a program as ``find_pod`` does; ``ApiError``."""
    pods = session.items(PODS, f"{names.LABEL_PROGRAM}={program}")
    if not pods:
        return None
    newest = max(pods, key=lambda pod: str(pod["metadata"]["creationTimestamp"]))
    return ProgramPod(str(newest["metadata"]["name"]), newest)


def stop(session: Session, job: Body) -> None:
    """Delete the Job of a program, and with it its pod; a newer Job of the name stays."""
    name, uid = str(job["metadata"]["name"]), str(job["metadata"]["uid"])
    with contextlib.suppress(NotFound, Conflict):
        session.api.delete(JOBS.path(session.namespace, name), uid=uid, timeout=SECONDS)


class LauncherClient:
    """Client of the launcher in a program's pod.  Its calls raise ``ApiError`` and OSError."""

    def __init__(self, session: Session, pod: str) -> None:
        self._session = session
        self._path = PODS.path(session.namespace, pod)

    def start(self, archive: bytes, layout: str, *, follows: bool) -> str:
        """Bring the program's files, and start it; return why it cannot be started, or nothing."""
        headers = {LAYOUT: layout, "Content-Length": str(len(archive))}
        if follows:
            headers[FOLLOWS] = "yes"
        # As a file, it is sent in parts that have a deadline each.
        with self._asking("PUT", "/program", io.BytesIO(archive), headers) as (sock, get_response):
            sock.settimeout(_STARTS_WITHIN)
            return get_response().getheader(FAILURE) or ""

    def signal(self, number: int) -> None:
        """Send a signal to the program."""
        with self._asking("POST", f"/signal/{number}") as (_, get_response):
            get_response()

    def monitor(self, request: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
        """Yield the answers of the monitors of the program's processes."""
        body = json.dumps(request).encode()
        headers = {"Content-Length": str(len(body))}
        with self._asking("POST", "/monitor", io.BytesIO(body), headers) as (_, get_response):
            for line in get_response():
                yield json.loads(line)

    def output(self, position: int) -> Iterator[tuple[int, bytes]]:
        """Yield the kinds and contents of the output's records from ``position`` on.

        ConnectionError if the connection breaks before the end of the program.
        """
        with self._asking("GET", f"/output/{position}") as (_, get_response):
            response = get_response()
            kind = ALIVE
            while kind != EXIT:
                kind, length = RECORD.unpack(_exactly(response, RECORD.size))
                yield kind, _exactly(response, length)

    @contextlib.contextmanager
    def _asking(
        self, method: str, path: str, body: IO[bytes] | None = None, headers: Mapping[str, str] = {}
    ) -> Iterator[tuple[socket.socket, Callable[[], http.client.HTTPResponse]]]:
        """Send a request; yield its socket, and the function that waits for the response."""
        forward = self._session.api.port_forward(self._path, names.LAUNCHER_PORT)
        with contextlib.ExitStack() as stack:
            sock = stack.enter_context(open_socket(forward))
            sock.settimeout(_SILENCE)
            connection = http.client.HTTPConnection("localhost", blocksize=64 << 10)
            connection.sock = sock
            connection.request(method, path, body, headers)

            def get_response() -> http.client.HTTPResponse:
                response = stack.enter_context(connection.getresponse())
                if response.status != 200:
                    raise ConnectionError(f"the launcher answers {response.status}")
                return response

            yield sock, get_response


def _exactly(response: http.client.HTTPResponse, size: int) -> bytes:
    found = response.read(size) if size else b""
    if len(found) < size:
        raise ConnectionResetError("the connection to the program's pod broke")
    return found


def number_in(kind: int, data: bytes) -> int:
    """Return the number in a DROPPED or EXIT record."""
    return int((NUMBER if kind == DROPPED else STATUS).unpack(data)[0])
