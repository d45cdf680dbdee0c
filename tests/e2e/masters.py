"""Masters for the tests: ``master.py`` as a process beside them, or as a pod in the cluster."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from e2e.accounts import ACCOUNT
from e2e.kube import Body, Stream, environment
from e2e.pools import Pool

PROGRAM = Path(__file__).with_name("master.py")


class Master:
    """Output of a master so far."""

    def __init__(self, pool: Pool) -> None:
        self.pool = pool
        self.said: list[Body] = []

    @property
    def joined(self) -> dict[str, float]:
        """Return when each agent dialled in, in seconds since the master attached."""
        return {said["name"]: said["at"] for said in self.said if said["event"] == "joined"}

    @property
    def address(self) -> str:
        """``host:port`` that it listens at; empty until it has attached."""
        found = (said["address"] for said in self.said if said["event"] == "attached")
        return next(found, "")

    def is_joined_by(self, *workers: str, seconds: float = 30.0) -> float:
        """Wait until all of these have dialled in; seconds that the last one took."""
        wanted = set(workers)
        self.pool.wait(f"{wanted} join", lambda: wanted <= set(self.joined), seconds)
        return max(self.joined[name] for name in wanted)

    def has_welcomed(self, worker: str) -> None:
        """Wait until the worker itself knows that it has joined."""
        welcome = {"event": "welcomed", "name": worker}
        self.pool.wait(
            f"{worker} is welcome", lambda: any(welcome.items() <= s.items() for s in self.said)
        )

    def _hear(self, line: str) -> None:
        if line.startswith("{"):
            self.said.append(json.loads(line))
            self.pool.scene.remark()


class Outside(Master):
    """A process beside the tests."""

    def __init__(self, pool: Pool, host: str, lost_grace: int | None = None) -> None:
        super().__init__(pool)
        grace = {} if lost_grace is None else {"MASTER_LOST_GRACE": str(lost_grace)}
        self._process = subprocess.Popen(
            [sys.executable, str(PROGRAM)],
            stdout=subprocess.PIPE,
            text=True,
            env=environment(
                MASTER_API=pool.scene.kube.url,
                MASTER_POOL=pool.name,
                MASTER_NAMESPACE=pool.scene.namespace,
                MASTER_HOST=host,
                **grace,
            ),
        )
        self._reader = threading.Thread(target=self._read, name="master's words", daemon=True)
        self._reader.start()

    def end(self) -> None:
        """Ask it to end, which detaches it, and wait for that."""
        self._process.terminate()
        self._finish()

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._finish()

    def _finish(self) -> None:
        self._process.wait(30)
        self._reader.join()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                self._hear(line)


class Inside(Master):
    """A pod with the rights of people who use pools."""

    def __init__(self, pool: Pool, image: str) -> None:
        super().__init__(pool)
        scene = pool.scene
        body = _pod(pool, image)
        created = scene.kube.create(scene.path("pods"), body)
        self._name = created["metadata"]["name"]
        self._log = Stream(scene.kube, self._begin, self._hear)

    def end(self) -> None:
        """Ask it to end, which detaches it, and wait until it has said so."""
        self._delete()
        self.pool.wait("the master detaches", lambda: self.said[-1]["event"] == "detached")
        self._log.close()

    def kill(self) -> None:
        """End it at once."""
        self._delete(gracePeriodSeconds=0)
        self._log.close()

    def _delete(self, **options: int) -> None:
        scene = self.pool.scene
        scene.kube.delete(scene.path("pods", self._name), options)

    def _begin(self) -> str | None:
        path = self.pool.scene.path("pods", self._name, "log")
        return None if self.said else f"{path}?follow=true"


@contextmanager
def outside(pool: Pool, host: str, lost_grace: int | None = None) -> Iterator[Outside]:
    """A master beside the tests, killed at the end if it still runs."""
    master = Outside(pool, host, lost_grace)
    try:
        yield master
    finally:
        master.kill()


def _pod(pool: Pool, image: str) -> Body:
    variables: list[Body] = [
        {"name": "MASTER_POOL", "value": pool.name},
        {"name": "MASTER_NAMESPACE", "value": pool.scene.namespace},
        {"name": "MASTER_HOST", "valueFrom": {"fieldRef": {"fieldPath": "status.podIP"}}},
    ]
    container = {
        "name": "master",
        "image": image,
        "command": ["python", "-c", PROGRAM.read_text(encoding="utf-8")],
        "env": variables,
        "resources": {"requests": {"cpu": "5m", "memory": "16Mi"}},
    }
    spec = {"serviceAccountName": ACCOUNT, "restartPolicy": "Never", "containers": [container]}
    return {"metadata": {"generateName": f"{pool.name}-master-"}, "spec": spec}
