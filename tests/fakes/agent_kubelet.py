"""Nodes that run the worker container of each pod as a process of this machine: a real agent."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import os
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from fakes.store import Body, Failure, Store
from fiber._transport import credentials_file
from fiber_api import names
from patience import PATIENCE

_PROBED_EVERY = 0.05
"""Seconds."""


class AgentKubelet:
    """Runs what ``store`` says; the agents dial their pool's master directly.

    A pod waits for its Secret, as mounting does, and for a master, unless ``services`` says where
    its masters will be.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._folders: dict[str, Path] = {}
        """Files in place of a container's own, by pod."""
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self.grace = 4.0
        """Seconds that agents believe they have to end, once their pod is deleted."""
        self.told: set[str] = set()
        """Pods whose agents got SIGTERM."""
        self.forced: list[str] = []
        """Pods whose agents did not end after SIGTERM."""
        self.fails_with: tuple[str, str] | None = None
        """Reason and message of a container that cannot start, from now on."""
        self.processes: dict[str, asyncio.subprocess.Process] = {}
        """Agents by the names of their pods."""
        self.services: dict[str, str] = {}
        """Addresses (``host:port``) of all masters of a FiberPool, by its name."""
        self.cut_off = False
        """True if agents started from now on dial an address at which no master is."""
        store.pods_linger = True
        store.created = self._created

    def kill(self, pod: str, signum: int = signal.SIGKILL) -> None:
        """Kill an agent as the kernel does when memory is short."""
        self.processes[pod].send_signal(signum)

    async def close(self) -> None:
        """Wait for the end of those whose pods are gone, and end the others."""
        for name in list(self._tasks):
            for pod in self._store.list("pods"):
                if pod["metadata"]["name"] == name:
                    self._store.remove("pods", pod["metadata"]["namespace"], name)
        await asyncio.gather(*self._tasks.values())

    def _created(self, plural: str, pod: Body) -> None:
        if plural == "pods":
            name = pod["metadata"]["name"]
            self._tasks[name] = asyncio.ensure_future(self._run(pod["metadata"]["namespace"], name))

    async def _run(self, namespace: str, name: str) -> None:
        try:
            process = await self._start_if_there(namespace, name)
            if process is not None:
                await self._watch(namespace, name, process)
            with contextlib.suppress(KeyError):  # its pool took it along
                self._store.remove("pods", namespace, name)
        finally:
            process = self.processes.pop(name, None)
            if process is not None and process.returncode is None:
                process.kill()
                await process.wait()
            if name in self._folders:
                await _remove(self._folders.pop(name))

    async def _start_if_there(self, namespace: str, name: str) -> asyncio.subprocess.Process | None:
        try:
            return await self._start(namespace, name)
        except Failure as failure:
            if failure.status != 404:
                raise
            return None  # it was taken away meanwhile

    async def _start(self, namespace: str, name: str) -> asyncio.subprocess.Process | None:
        """The agent's process; None if the pod was deleted before."""
        if self.fails_with is not None:
            reason, message = self.fails_with
            state = {"waiting": {"reason": reason, "message": message}}
            self._set(namespace, name, "Pending", state)
        while True:
            if self._is_deleted(namespace, name):
                return None
            pod = self._store.get("pods", namespace, name)
            mounted = _secret(pod)
            secrets = self._store.list("secrets", namespace)
            secret = next((s for s in secrets if s["metadata"]["name"] == mounted), None)
            address = self._address(namespace, pod["metadata"]["labels"][names.LABEL_POOL])
            if secret is not None and address is not None and self.fails_with is None:
                break
            await self._store.changed()
        folder = self._mount(pod, secret["data"])
        environment = {
            **{key: value for key, value in os.environ.items() if not key.startswith("FIBER_")},
            **_environment(pod),
            names.ENV_ADDRESS: address,
            names.ENV_CREDENTIALS: str(folder / names.CREDENTIALS_FILE),
            names.ENV_TERMINATION_GRACE: str(self.grace),
            names.ENV_LINKED: str(folder / names.LINKED_FILE),
            "TMPDIR": str(folder),
        }
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "fiber.agent", env=environment, cwd=folder, process_group=0
        )
        self.processes[name] = process
        state = {"running": {"startedAt": self._store.now()}}
        self._set(namespace, name, "Running", state, started="startupProbe" not in _worker(pod))
        return process

    def _address(self, namespace: str, pool: str) -> str | None:
        """Return the address that the agents of the pool dial."""
        if self.cut_off:
            return "127.0.0.1:1"
        if pool in self.services:
            return self.services[pool]
        master = self._store.get("fiberpools", namespace, pool)["spec"].get("master")
        return None if master is None else names.address_of(master["host"], master["port"])

    def _mount(self, pod: Body, data: Body) -> Path:
        """The worker's files, after its init container."""
        name, uid = pod["metadata"]["name"], pod["metadata"]["uid"]
        told = {v["name"]: v.get("value") for v in pod["spec"]["initContainers"][0]["env"]}
        folder = self._folders[name] = Path(tempfile.mkdtemp(prefix="pod-"))
        with tempfile.TemporaryDirectory() as key:
            for entry, value in data.items():
                (Path(key) / entry).write_bytes(base64.b64decode(value))
            environment = {
                names.ENV_KEY: key,
                names.ENV_EPOCH: told[names.ENV_EPOCH],
                names.ENV_POOL_UID: told[names.ENV_POOL_UID],
                names.ENV_NAME: name,
                names.ENV_UID: uid,
                names.ENV_CREDENTIALS: str(folder / names.CREDENTIALS_FILE),
            }
            assert credentials_file.write(environment) == 0
        return folder

    async def _watch(self, namespace: str, name: str, process: asyncio.subprocess.Process) -> None:
        """Until the pod is to be gone."""
        ended = asyncio.ensure_future(process.wait())
        linked = asyncio.ensure_future(self._link(name))
        try:
            await self._follow(namespace, name, ended, linked)
        finally:
            linked.cancel()
        if not ended.done():
            process.terminate()
            self.told.add(name)
            await asyncio.wait([ended], timeout=PATIENCE)
            if not ended.done():
                self.forced.append(name)

    async def _link(self, name: str) -> None:
        """Wait as the startup probe does."""
        while not (self._folders[name] / names.LINKED_FILE).exists():
            await asyncio.sleep(_PROBED_EVERY)

    async def _follow(
        self,
        namespace: str,
        name: str,
        ended: asyncio.Future[int],
        linked: asyncio.Future[None],
    ) -> None:
        """Report the agent's link and its end, until its pod is deleted."""
        told = ready = False
        while not self._is_deleted(namespace, name):
            if linked.done() and not (ready or ended.done()):
                ready = True
                before = self._store.get("pods", namespace, name)["status"]["containerStatuses"][0]
                if not before["started"]:
                    self._set(namespace, name, "Running", before["state"])
            if ended.done() and not told:
                told = True
                code = ended.result() if ended.result() >= 0 else 128 - ended.result()
                state = {
                    "exitCode": code,
                    "reason": "OOMKilled" if code == 128 + signal.SIGKILL else "Error",
                    "startedAt": self._store.now(),
                    "finishedAt": self._store.now(),
                }
                phase = "Failed" if code else "Succeeded"
                self._set(namespace, name, phase, {"terminated": state})
            change = asyncio.ensure_future(self._store.changed())
            others = [] if told else [ended, *(() if ready else (linked,))]
            await asyncio.wait([change, *others], return_when=asyncio.FIRST_COMPLETED)
            change.cancel()

    def _is_deleted(self, namespace: str, name: str) -> bool:
        """Return whether the pod was deleted, alone or with its pool."""
        pods = {pod["metadata"]["name"]: pod for pod in self._store.list("pods", namespace)}
        if name not in pods or "deletionTimestamp" in pods[name]["metadata"]:
            return True
        owners = {owner["uid"] for owner in pods[name]["metadata"]["ownerReferences"]}
        pools = self._store.list("fiberpools", namespace)
        return owners.isdisjoint(pool["metadata"]["uid"] for pool in pools)

    def _set(
        self, namespace: str, name: str, phase: str, state: Body, *, started: bool = True
    ) -> None:
        if "nodeName" not in self._store.get("pods", namespace, name)["spec"]:
            self._store.merge("pods", namespace, name, {"spec": {"nodeName": "node-1"}})
        now, ready = self._store.now(), "running" in state and started
        condition = {
            "type": "Ready",
            "status": "True" if ready else "False",
            "lastTransitionTime": now,
        }
        container = {
            "name": names.WORKER_CONTAINER,
            "ready": ready,
            "started": ready,
            "restartCount": 0,
            "state": state,
        }
        status = {"phase": phase, "conditions": [condition], "containerStatuses": [container]}
        self._store.set_status("pods", namespace, name, status)


async def _remove(folder: Path) -> None:
    """Remove a pod's folder, in which processes of a killed agent may make files for a moment."""
    deadline = time.monotonic() + PATIENCE
    while folder.exists() and time.monotonic() < deadline:
        shutil.rmtree(folder, ignore_errors=True)
        await asyncio.sleep(0 if not folder.exists() else _PROBED_EVERY)


def _secret(pod: Body) -> str:
    """The Secret that its init container mounts."""
    volume = next(v for v in pod["spec"]["volumes"] if v["name"] == names.KEY_VOLUME)
    return str(volume["secret"]["secretName"])


def _worker(pod: Body) -> Any:
    return next(c for c in pod["spec"]["containers"] if c["name"] == names.WORKER_CONTAINER)


def _environment(pod: Body) -> dict[str, str]:
    container = _worker(pod)
    values = {names.ENV_UID: pod["metadata"]["uid"]}
    return values | {v["name"]: v["value"] for v in container["env"] if "value" in v}
