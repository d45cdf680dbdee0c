"""Launchers of programs as processes of this machine, and requests to them."""

from __future__ import annotations

import http.client
import io
import json
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path

from fakes.program_nodes import Launched, kill
from fiber.launcher import (
    EXIT,
    FAILURE,
    FOLLOWS,
    LAYOUT,
    RECORD,
    STATUS,
    STDERR,
    STDOUT,
)
from patience import PATIENCE

Records = list[tuple[int, bytes]]


def archive(**files: str) -> bytes:
    """An archive of these files."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as made:
        for name, text in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(text.encode())
            made.addfile(member, io.BytesIO(text.encode()))
    return buffer.getvalue()


class Pod:
    """A launcher that waits for its program."""

    def __init__(self, folder: Path, *command: str, wait: float = PATIENCE) -> None:
        given = {
            "FIBER_LAUNCHER_COMMAND": json.dumps(command),
            "FIBER_LAUNCHER_FOLDER": "FOLDER",
            "FIBER_LAUNCHER_WAIT": str(wait),
        }
        env = [{"name": k, "value": v.replace("$", "$$")} for k, v in given.items()]
        self.launched = Launched(
            {"spec": {"containers": [{"name": "program", "env": env}]}}, folder / "pod"
        )

    def connect(self) -> http.client.HTTPConnection:
        """A connection, as soon as the launcher listens."""
        while (port := self.launched.port) is None:
            assert self.launched.process.poll() is None, self.log()
        connection = http.client.HTTPConnection("127.0.0.1", port, PATIENCE)
        connection.connect()
        return connection

    def ask(
        self, method: str, path: str, body: bytes | None = None, **headers: str
    ) -> http.client.HTTPResponse:
        connection = self.connect()
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, body, named)
        response = connection.getresponse()
        connection.close()
        return response

    def start(self, files: bytes | None = None, layout: str = "{}") -> str | None:
        """Bring the files; return the failure."""
        headers = {LAYOUT: layout, FOLLOWS: "yes"}
        with self.ask("PUT", "/program", files or archive(), **headers) as response:
            assert response.status == 200
            return response.getheader(FAILURE)

    def read(
        self,
        position: int = 0,
        until: bytes | None = None,
        told: Callable[[], object] = lambda: None,
        begun: Callable[[], object] = lambda: None,
    ) -> Records:
        """Read the output to its end, or until it contains these bytes; tell of each record.

        ``begun`` is called once the pod knows this reader, and so waits for it at its end.
        """
        found: Records = []
        with self.ask("GET", f"/output/{position}") as response:
            begun()
            while not found or found[-1][0] != EXIT:
                kind, length = RECORD.unpack(response.read(RECORD.size))
                found.append((kind, response.read(length)))
                told()
                if until is not None and until in text(found, STDOUT) + text(found, STDERR):
                    break
        return found

    def signal(self, number: int) -> int:
        with self.ask("POST", f"/signal/{number}") as response:
            return response.status

    def end(self) -> int:
        return self.launched.process.wait(PATIENCE)

    def log(self) -> str:
        return self.launched.log.decode()


def text(records: Records, kind: int = STDOUT) -> bytes:
    return b"".join(data for found, data in records if found == kind)


def status_in(records: Records) -> int:
    kind, data = records[-1]
    assert kind == EXIT
    return int(STATUS.unpack(data)[0])


class Site:
    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._pods: list[Pod] = []

    def pod(self, *command: str, wait: float = PATIENCE) -> Pod:
        self._pods.append(Pod(self._folder, *command, wait=wait))
        return self._pods[-1]

    def python(self, program: str) -> Pod:
        """A pod whose Python program has started."""
        pod = self.pod(sys.executable, "-c", program)
        assert pod.start() is None
        return pod

    def shell(self, program: str) -> Pod:
        pod = self.pod("sh", "-c", program)
        assert pod.start() is None
        return pod

    def close(self) -> None:
        for pod in self._pods:
            kill(pod.launched)
            pod.end()
