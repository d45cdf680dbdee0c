"""Nodes that run programs of ``fiber run``: Jobs, pods with real launchers, logs, port-forwards.

The launchers are processes of this machine.  Each has a port and a folder of its own.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from aiohttp import WSMsgType, web

from fakes.kubernetes_api import Call
from fakes.served import Served
from fakes.store import Body, Failure
from fiber.launcher import LISTENS
from fiber_api import names
from patience import PATIENCE

_PIECE = 4096
_DATA, _ERROR = b"\0", b"\1"
_AS_PROCESS_1 = """
import ctypes, os, sys
from fiber import launcher
PR_SET_CHILD_SUBREAPER = 36
assert ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1) == 0
status = launcher.main(*map(float, sys.argv[1:]))
sys.stderr.flush()
os._exit(status)
"""


class Launched:
    """Launcher of one pod."""

    def __init__(self, body: Body, folder: Path, linger: float | None = None) -> None:
        folder.mkdir()
        self._log = folder / "log"
        container = next(c for c in body["spec"]["containers"] if c["name"] == "program")
        given = {each["name"]: each["value"].replace("$$", "$") for each in container["env"]}
        place = given["FIBER_LAUNCHER_FOLDER"]
        command = json.loads(given["FIBER_LAUNCHER_COMMAND"])
        command = [word.replace(place, str(folder / "program")) for word in command]
        if command[0] == "python":
            command[0] = sys.executable
        given |= {
            "FIBER_LAUNCHER_FOLDER": str(folder / "program"),
            "FIBER_LAUNCHER_PORT": "0",
            "FIBER_LAUNCHER_COMMAND": json.dumps(command),
        }
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-c", _AS_PROCESS_1, *([] if linger is None else [str(linger)])],
                env={**os.environ, **given},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    @property
    def port(self) -> int | None:
        """Port at which the launcher listens; None before it listens."""
        first = self._lines()[0]
        listens = first.startswith(LISTENS) and first.endswith("\n")
        return int(first.removeprefix(LISTENS)) if listens else None

    @property
    def log(self) -> bytes:
        """Log of the pod, without the line about the port."""
        first, rest = self._lines()
        return rest if first.startswith(LISTENS) else first.encode() + rest

    def _lines(self) -> tuple[str, bytes]:
        """Return the first line, and what follows it."""
        first, newline, rest = self._log.read_bytes().partition(b"\n")
        return (first + newline).decode(errors="replace"), rest


class ProgramNodes:
    """Controller of Jobs, and kubelet of their pods."""

    def __init__(self, server: Served, folder: Path) -> None:
        self._server, self._store = server, server.store
        self._folder = folder
        self.auto = True
        """Setting: each pod runs at once."""
        self.linger: float | None = None
        """Setting: seconds that a launcher waits for its readers.  None: as many as in a pod."""
        self.cuts: list[int] = []
        """Bytes from a pod after which each of the next port-forwards breaks."""
        self.at_forward: Callable[[], object] = lambda: None
        """Called before a port-forward is answered."""
        self.also_after: Callable[[Call], object] = lambda call: None
        """Told of each call, as ``KubernetesApi.after`` is."""
        self.forwards = 0
        """Port-forwards that were opened."""
        self.launched: dict[str, Launched] = {}
        self.logs: list[list[bytes | None]] = []
        """Pieces of the next logs, instead of those of launchers; None breaks the connection."""
        self.queries: list[dict[str, str]] = []
        """Queries for logs."""
        self._watchers: list[threading.Thread] = []
        self._number = 0
        server.store.created = self._created
        server.api.after = self._after
        server.api.subresources |= {"log": self._log, "portforward": self._forward}

    # -- What a test does

    def start(self, name: str) -> None:
        """Run a pod."""
        self._server.do(self._start, name)

    def kill(self, pod: str, container_reason: str = "Error", **status: str) -> None:
        """Kill the launcher and its program without a word; ``status`` is the pod's, too."""
        self._server.do(self._set_end, pod, 137, container_reason, "Failed", status)
        kill(self.launched[pod])

    def pods(self) -> list[str]:
        return [str(pod["metadata"]["name"]) for pod in self._server.objects("pods")]

    def jobs(self) -> list[Body]:
        return self._server.objects("jobs")

    def wait(self, condition: Callable[[], object]) -> None:
        """Wait until it holds."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def log_of(self, pod: str) -> bytes:
        return self.launched[pod].log

    def close(self) -> None:
        for launched in self.launched.values():
            kill(launched)
        for watcher in self._watchers:
            watcher.join(PATIENCE)

    # -- The cluster's part, on the server's thread

    def _created(self, plural: str, body: Body) -> None:
        if plural != "jobs":
            return
        self._number += 1
        metadata, template = body["metadata"], body["spec"]["template"]
        name = f"{metadata['name']}-{self._number:05}"
        owner = {"kind": "Job", "name": metadata["name"], "uid": metadata["uid"]}
        pod = {**template, "metadata": {**template["metadata"], "name": name}}
        pod["metadata"]["ownerReferences"] = [owner]
        self._store.create("pods", metadata["namespace"], pod)
        if self.auto:
            self._start(name)

    def _start(self, name: str) -> None:
        pod = next(p for p in self._store.list("pods") if p["metadata"]["name"] == name)
        launched = Launched(pod, self._folder / name, self.linger)
        self.launched[name] = launched
        self._set(name, "Running", {"running": {}})
        self._set_job(name, {"active": 1, "ready": 1})
        watcher = threading.Thread(target=self._watch, args=(name, launched), name="fake kubelet")
        watcher.start()
        self._watchers.append(watcher)

    def _watch(self, name: str, launched: Launched) -> None:
        status = launched.process.wait()
        with contextlib.suppress(Failure, RuntimeError):  # the pod or the server is gone
            self._server.do(
                self._set_end, name, 128 - status if status < 0 else status, "Error", "", {}
            )

    def _set_end(self, name: str, code: int, reason: str, phase: str, more: Body) -> None:
        pod = self._store.get("pods", _namespace(self._store.list("pods"), name), name)
        if pod["status"]["phase"] in ("Failed", "Succeeded"):
            return
        phase = phase or ("Failed" if code else "Succeeded")
        ended = {"exitCode": code, "reason": reason}
        self._set(name, phase, {"terminated": ended}, more)
        kind = "Complete" if phase == "Succeeded" else "Failed"
        self._set_job(name, {"conditions": [{"type": kind, "status": "True"}]})

    def _set(self, name: str, phase: str, state: Body, more: Body | None = None) -> None:
        container = {"name": names.PROGRAM_CONTAINER, "state": state}
        sidecar = {"name": "sidecar", "state": {"terminated": {"exitCode": 3}}}
        status = {"phase": phase, "containerStatuses": [sidecar, container], **(more or {})}
        namespace = _namespace(self._store.list("pods"), name)
        self._store.set_status("pods", namespace, name, status)

    def _set_job(self, pod: str, status: Body) -> None:
        namespace = _namespace(self._store.list("pods"), pod)
        job = self._store.get("pods", namespace, pod)["metadata"]["labels"][names.LABEL_PROGRAM]
        current = self._store.get("jobs", namespace, job)
        if not (current.get("status") or {}).get("conditions"):
            self._store.set_status("jobs", namespace, job, status)

    def _after(self, call: Call) -> None:
        self.also_after(call)
        if call.verb != "delete" or call.plural != "jobs":
            return
        present = {pod["metadata"]["name"] for pod in self._store.list("pods")}
        for name, launched in self.launched.items():
            if name not in present and launched.process.poll() is None:
                launched.process.send_signal(signal.SIGTERM)

    async def _log(self, request: web.Request, call: Call) -> web.StreamResponse:
        self.queries.append(dict(request.query))
        response = web.StreamResponse()
        if self.logs:
            await response.prepare(request)
            for piece in self.logs.pop(0):
                if piece is None:
                    assert request.transport is not None
                    request.transport.abort()
                    return response
                await response.write(piece)
        elif call.name in self.launched:
            await response.prepare(request)
            await response.write(self.log_of(call.name))
        else:
            raise Failure(400, "BadRequest", f"container in pod {call.name} is waiting to start")
        return response

    async def _forward(self, request: web.Request, call: Call) -> web.StreamResponse:
        self.forwards += 1
        self.at_forward()
        response = web.WebSocketResponse(protocols=("v4.channel.k8s.io",), max_msg_size=0)
        await response.prepare(request)
        port = (names.LAUNCHER_PORT).to_bytes(2, "little")
        await response.send_bytes(_DATA + port)
        await response.send_bytes(_ERROR + port)
        found = await _connect(self.launched.get(call.name))
        if found is None:
            await response.send_bytes(_ERROR + b"connection refused")
            return response
        reader, writer = found
        cut = self.cuts.pop(0) if self.cuts else sys.maxsize
        up = asyncio.ensure_future(_send(response, writer))
        try:
            while data := await reader.read(min(_PIECE, cut)):
                await response.send_bytes(_DATA + data)
                cut -= len(data)
                if not cut:
                    assert request.transport is not None
                    request.transport.abort()
                    break
        except ConnectionError:
            pass
        finally:
            up.cancel()
            writer.close()
        return response


async def _send(response: web.WebSocketResponse, writer: asyncio.StreamWriter) -> None:
    async for message in response:
        if message.type is WSMsgType.BINARY and message.data[:1] == _DATA:
            writer.write(message.data[1:])
            await writer.drain()
    writer.close()


async def _connect(
    launched: Launched | None,
) -> tuple[asyncio.StreamReader, asyncio.StreamWriter] | None:
    """Connect to the launcher as soon as it listens; None if it has ended."""
    while launched is not None and launched.process.poll() is None:
        if (port := launched.port) is not None:
            with contextlib.suppress(ConnectionError):
                return await asyncio.open_connection("127.0.0.1", port)
        await asyncio.sleep(0.01)
    return None


def _namespace(pods: list[Body], name: str) -> str:
    found = [str(p["metadata"]["namespace"]) for p in pods if p["metadata"]["name"] == name]
    if not found:
        raise Failure(404, "NotFound", f"pod {name} is gone")
    return found[0]


def kill(launched: Launched) -> None:
    """Kill a launcher and its program, if the launcher runs; else its number may be another's."""
    if launched.process.poll() is not None:
        return
    children = list(_children(launched.process.pid))
    launched.process.kill()
    for child in children:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)


def _children(pid: int) -> Iterator[int]:
    with contextlib.suppress(OSError):
        for task in os.listdir(f"/proc/{pid}/task"):
            text = Path(f"/proc/{pid}/task/{task}/children").read_text()
            yield from map(int, text.split())
