"""Programs that use Fiber on pods: beside the tests as processes, or in the cluster as pods.

Neither has more rights than the chart's role fiber-user, in the namespace of its test alone.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from cluster.laptop import Laptop
from e2e.accounts import ACCOUNT, kubeconfig_of
from e2e.clusters import Cluster
from e2e.kube import Body, Stream
from e2e.scene import Scene

PLACES = ("inside", "outside")
"""Places of a program: in a pod, with an account, or beside the tests, with a kubeconfig."""
PROGRAMS = Path(__file__).with_name("programs")
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
CONTAINER = "program"
_MOUNT = "/program"


class Program:
    """Program with its output so far, and how it ended. Standard output and errors are one."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.lines: list[str] = []

    @property
    def output(self) -> str:
        return "\n".join(self.lines)

    @property
    def status(self) -> int | None:
        """Exit status, negative for a signal; None while it runs or its output is read."""
        raise NotImplementedError

    @property
    def pod(self) -> str | None:
        """The name of the pod that it runs in, if it does."""
        return None

    @property
    def said(self) -> list[Body]:
        """The lines that are JSON objects."""
        return [json.loads(line) for line in list(self.lines) if line.startswith('{"')]

    def says(self, event: str, seconds: float = 60.0) -> Body:
        """Wait until it has said this, which must be before it ends."""

        def heard() -> Body | None:
            has_ended = self.status is not None  # read first, so that later output is not missed
            if found := [said for said in self.said if said["event"] == event]:
                return found[-1]
            assert not has_ended, f"ended with {self.status}:\n{self.output}"
            return None

        said: Body = self._wait(f"it says {event}", heard, seconds)
        return said

    def prints(self, words: str, seconds: float = 60.0) -> None:
        """Wait until the program has printed these."""
        self._wait(f"it prints {words!r}", lambda: words in self.output, seconds)

    def ends(self, status: int = 0, seconds: float = 60.0) -> str:
        """Wait until it ends, which must be with this status; all that it printed."""
        self._wait("it ends", lambda: self.status is not None, seconds)
        assert self.status == status, f"ended with {self.status}, not {status}:\n{self.output}"
        return self.output

    def kill(self) -> None:
        """Send SIGKILL unless the program has ended."""
        raise NotImplementedError

    def interrupt(self) -> None:
        """Interrupt it as Ctrl-C does."""
        raise NotImplementedError

    def close(self) -> None:
        """Kill it if it runs, and stop reading its output."""
        raise NotImplementedError

    def _wait(self, what: str, condition: Callable[[], Any], seconds: float) -> Any:
        try:
            return self.scene.wait(what, condition, seconds)
        except AssertionError as error:
            raise AssertionError(f"{error}\nIt printed:\n{self.output}") from None

    def _hear(self, line: str) -> None:
        self.lines.append(line.rstrip("\n"))
        self.scene.remark()


class Outside(Program):
    """Process beside the tests, in a separate process group."""

    def __init__(
        self,
        scene: Scene,
        script: Path,
        arguments: Sequence[str],
        environment: dict[str, str],
        prefix: Sequence[str] = (),
    ) -> None:
        super().__init__(scene)
        self._status: int | None = None
        # A private folder, because a killed program leaves its temporary files.
        self._temporary = tempfile.TemporaryDirectory(prefix="program-")
        self._process = subprocess.Popen(
            [*prefix, sys.executable, str(script), *arguments],
            # Unbuffered, ``print`` writes the end of a line by itself.  Output of a worker may come
            # between the two, so that programs print a line of JSON together with its end.
            env={**environment, "PYTHONUNBUFFERED": "1", "TMPDIR": self._temporary.name},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, name="program's words", daemon=True)
        self._reader.start()

    @property
    def status(self) -> int | None:
        return self._status

    def kill(self) -> None:
        self._process.kill()

    def interrupt(self) -> None:
        os.killpg(self._process.pid, signal.SIGINT)

    def pause(self) -> None:
        """SIGSTOP, until `resume`."""
        self._process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        self._process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        self._process.kill()
        self._reader.join()
        self._temporary.cleanup()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                self._hear(line)
        self._status = self._process.wait()
        self.scene.remark()


class Inside(Program):
    """A pod whose one container runs it, with its files mounted from a ConfigMap."""

    def __init__(
        self,
        scene: Scene,
        script: Path,
        arguments: Sequence[str],
        environment: dict[str, str],
        image: str,
        cluster: Cluster,
        node: str | None,
        claims: Sequence[str],
    ) -> None:
        super().__init__(scene)
        self._cluster = cluster
        self._heard = 0
        self._has_ended = False
        self._is_read = False
        files = {path.name: path.read_text(encoding="utf-8") for path in script.parent.glob("*.py")}
        body = {"metadata": {"generateName": "program-"}, "data": files}
        config = scene.kube.create(scene.path("configmaps"), body)["metadata"]["name"]
        command = ["python", f"{_MOUNT}/{script.name}", *arguments]
        pod = _pod(command, environment, image, config, claims)
        pod["spec"]["nodeName"] = node
        self._name = str(scene.kube.create(scene.path("pods"), pod)["metadata"]["name"])
        self._log = Stream(scene.kube, self._begin, self._repeat)

    @property
    def pod(self) -> str | None:
        return self._name

    @property
    def status(self) -> int | None:
        status = self._terminated.get("exitCode")
        return int(status) if status is not None and self._is_read else None

    @property
    def _body(self) -> Body:
        return self.scene.now["pods"].get(self._name, {})

    @property
    def _terminated(self) -> Body:
        statuses = self._body.get("status", {}).get("containerStatuses", [])
        states: list[Body] = [each["state"] for each in statuses if each["name"] == CONTAINER]
        found: Body = states[0].get("terminated", {}) if states else {}
        return found

    def kill(self) -> None:
        self._cluster.kill(self._body, CONTAINER)

    def interrupt(self) -> None:
        # Process 1 has Python's handler, or the signal would be ignored.
        kill = ("--container", CONTAINER, "--", "sh", "-c", "kill -INT 1")
        self.scene.kube.kubectl("--namespace", self.scene.namespace, "exec", self._name, *kill)

    def close(self) -> None:
        self.scene.kube.delete(self.scene.path("pods", self._name), {"gracePeriodSeconds": 0})
        self._log.close()

    def _begin(self) -> str | None:
        """The log from its beginning, since there is no other place to go on at."""
        if self._has_ended and self._heard >= len(self.lines):
            self._is_read = True
            self.scene.remark()
            return None
        self._heard, self._has_ended = 0, bool(self._terminated)
        return f"{self.scene.path('pods', self._name, 'log')}?follow=true&container={CONTAINER}"

    def _repeat(self, line: str) -> None:
        """Append a line that was missed when the connection broke."""
        self._heard += 1
        if self._heard > len(self.lines) and line.endswith("\n"):
            self._hear(line)


def _pod(
    command: list[str],
    environment: dict[str, str],
    image: str,
    config: str,
    claims: Sequence[str],
) -> Body:
    mounts = [{"name": claim, "mountPath": f"/claims/{claim}"} for claim in claims]
    container = {
        "name": CONTAINER,
        "image": image,
        "command": command,
        "env": [{"name": name, "value": value} for name, value in environment.items()],
        "volumeMounts": [{"name": "program", "mountPath": _MOUNT}, *mounts],
        "resources": {"requests": {"cpu": "5m", "memory": "16Mi"}},
        # Fields that the restricted standard of pod security requires.  The workers get them too.
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "capabilities": {"drop": ["ALL"]},
            "runAsNonRoot": True,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
    }
    volumes = [{"name": c, "persistentVolumeClaim": {"claimName": c}} for c in claims]
    spec = {
        "serviceAccountName": ACCOUNT,
        "restartPolicy": "Never",
        "containers": [container],
        "volumes": [{"name": "program", "configMap": {"name": config}}, *volumes],
    }
    return {"metadata": {"generateName": "program-"}, "spec": spec}


class Programs:
    """Starts them in one namespace, and closes what still runs at the end."""

    def __init__(self, scene: Scene, cluster: Cluster, home: Path) -> None:
        self.scene = scene
        self._cluster = cluster
        self.kubeconfig = kubeconfig_of(scene, home)
        """Kubeconfig of later programs beside the tests."""
        self.node: str | None = None
        """Node on which later programs inside run; None: any."""
        self.claims: tuple[str, ...] = ()
        """PersistentVolumeClaims that programs started inside from now on mount."""
        self.image: str | None = None
        """Image of later programs inside; None: one of the project's."""
        self.laptop: Laptop | None = None
        """Laptop of the programs that ``on_laptop`` starts."""
        self._started: list[Program] = []

    def start(self, place: str, script: str, *arguments: object, **settings: object) -> Program:
        """Start one of ``programs`` or, with a folder in its name, an example; see `PLACES`.

        The settings are keys of Fiber's configuration.
        """
        words = [str(argument) for argument in arguments]
        ours = self._cluster.images["fiber-worker-rl" if "/" in script else "fiber-worker"]
        image = self.image or ours
        start = self._outside if place == "outside" else self._inside
        program = start(path_to(script), words, image, settings)
        self._started.append(program)
        return program

    def outside(self, script: str, *arguments: object, **settings: object) -> Outside:
        """Start it beside the tests, with options that are only possible there."""
        program = self.start("outside", script, *arguments, **settings)
        assert isinstance(program, Outside)
        return program

    def on_laptop(self, script: str, *arguments: object, **settings: object) -> Outside:
        """Start it on the laptop."""
        assert self.laptop is not None
        return self.outside(script, *arguments, **settings)

    def close(self) -> None:
        for program in self._started:
            program.close()

    def _outside(
        self, script: Path, words: list[str], image: str, settings: dict[str, object]
    ) -> Outside:
        if self._cluster.outside is None:
            pytest.skip(f"{self._cluster.description}: pods cannot reach a program outside of it")
        prefix = () if self.laptop is None else self.laptop.command
        all_settings = {
            "backend": "kubernetes",
            "namespace": self.scene.namespace,
            "image": image,
            **settings,
        }
        environment = {**_without_fiber(), "KUBECONFIG": str(self.kubeconfig)}
        environment |= _variables(all_settings)
        return Outside(self.scene, script, words, environment, prefix)

    def _inside(
        self, script: Path, words: list[str], image: str, settings: dict[str, object]
    ) -> Inside:
        # No setting is needed: in a pod whose account may make FiberPools, pods are the default.
        variables = _variables(settings)
        cluster, node, claims = self._cluster, self.node, self.claims
        return Inside(self.scene, script, words, variables, image, cluster, node, claims)


def local(script: str, *arguments: object) -> list[str]:
    """Return the output of a script with the local backend."""
    command = [sys.executable, str(path_to(script)), *map(str, arguments)]
    environment = {**_without_fiber(), "FIBER_BACKEND": "local"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def path_to(script: str) -> Path:
    return EXAMPLES / script if "/" in script else PROGRAMS / script


def _variables(settings: dict[str, object]) -> dict[str, str]:
    return {f"FIBER_{key.upper()}": str(value) for key, value in settings.items()}


def _without_fiber() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith("FIBER_")}
