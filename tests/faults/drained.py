"""Hosts that are drained while a program works on them: agents on loopback, and pods.

A test module takes the fixtures from here by name: ``site = drained.site`` and so on.
"""

from __future__ import annotations

import contextlib
import os
import signal
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fakes.cluster import FakeCluster, fake_cluster
from faults.program import wait_for
from faults.runtime import running
from fiber._backends.loopback import LoopbackBackend
from fiber._backends.remote import RemoteAgent
from patience import PATIENCE
from unit.kubernetes_rig import kubeconfig

PATIENT, HASTY = 2 * PATIENCE, 1.0
"""Seconds that a drained host has to end: more than any test takes, and less than a task that
blocks."""


class Site(ABC):
    """The hosts of the program that runs in this process."""

    @abstractmethod
    def agents(self) -> list[RemoteAgent]:
        """Return the existing ones."""

    @abstractmethod
    def tell(self, host: str) -> None:
        """Send SIGTERM to the host."""

    def drain(self, host: str) -> RemoteAgent:
        """Send SIGTERM to a host, and wait until the program has received its agent's notice.

        A deleted pod is known to the program earlier, while its workers still begin tasks.
        """
        (agent,) = (agent for agent in self.agents() if agent.host == host)
        reasons: list[str] = []
        leave = agent.leave

        def note(reason: str) -> None:
            leave(reason)
            reasons.append(reason)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(agent, "leave", note)
            self.tell(host)
            wait_for(lambda: any(reason.startswith("Drained") for reason in reasons))
        return agent

    def busy(self) -> list[str]:
        """Hosts with children, and which stay."""
        return [agent.host for agent in self.agents() if agent._children and not agent.leaving]


class LoopbackSite(Site):
    """Site with two agents; SIGTERM is the signal that a drained pod's agent gets."""

    def __init__(self, backend: LoopbackBackend) -> None:
        self._backend = backend

    def agents(self) -> list[RemoteAgent]:
        return list(self._backend.agents.agents.values())

    def tell(self, host: str) -> None:
        (slot,) = (slot for slot in self._backend._slots if slot.name == host)
        assert slot.process.pid is not None
        os.kill(slot.process.pid, signal.SIGTERM)


class PodSite(Site):
    """Pods that come with the work; a drain deletes them."""

    def __init__(self, backend: Any, cluster: FakeCluster) -> None:
        self._backend = backend
        self._cluster = cluster

    def agents(self) -> list[RemoteAgent]:
        pools = list(self._backend._pods.values())
        return [agent for pods in pools for agent in list(pods.agents.agents.values())]

    def tell(self, host: str) -> None:
        cluster = self._cluster
        cluster.do(cluster.world.store.delete, "pods", "lab", host)
        cluster.wait(lambda: host in cluster.nodes.told)

    def preempt(self, host: str) -> RemoteAgent:
        """Drain a pod as the scheduler does for one of a higher priority."""
        self._cluster.do(self._note_preemption, host)
        return self.drain(host)

    def _note_preemption(self, host: str) -> None:
        store = self._cluster.world.store
        status = store.get("pods", "lab", host)["status"]
        condition = {"type": "DisruptionTarget", "status": "True"}
        condition |= {"reason": "PreemptionByScheduler", "message": "a higher priority"}
        conditions = [*status["conditions"], condition]
        store.set_status("pods", "lab", host, status | {"conditions": conditions})


@contextlib.contextmanager
def on_loopback(grace: float, settings: dict[str, Any]) -> Iterator[LoopbackSite]:
    """Two agents, whose hosts give them ``grace`` seconds after SIGTERM."""
    usual = LoopbackBackend._environment
    told = {"FIBER_AGENT_TERMINATION_GRACE": str(grace)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LoopbackBackend, "_environment", lambda self, name: usual(self, name) | told)
        with running(backend="loopback", agents=2, **settings) as runtime:
            loopback = runtime.backend
            assert isinstance(loopback, LoopbackBackend)
            wait_for(lambda: len(loopback.agents.agents) == 2)
            yield LoopbackSite(loopback)


@contextlib.contextmanager
def on_pods(cluster: FakeCluster, grace: float, settings: dict[str, Any]) -> Iterator[PodSite]:
    """Pods whose nodes give them ``grace`` seconds after SIGTERM."""
    cluster.nodes.grace = grace
    with running(backend="kubernetes", **settings) as runtime:
        yield PodSite(runtime.backend, cluster)


@pytest.fixture(scope="module")
def played_cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakeCluster]:
    """A cluster that is played in this process, for the tests of one module."""
    folder = tmp_path_factory.mktemp("cluster")
    with fake_cluster() as cluster, pytest.MonkeyPatch.context() as patch:
        patch.setenv("KUBECONFIG", str(kubeconfig(folder, cluster.url)))
        yield cluster


@pytest.fixture
def grace() -> float:
    """Seconds that a drained host has to end, unless the test says how many."""
    return HASTY


@pytest.fixture
def settings() -> dict[str, Any]:
    """Return the settings of the program besides its backend."""
    return {}


@pytest.fixture(params=["loopback", "pods"])
def site(request: pytest.FixtureRequest, grace: float, settings: dict[str, Any]) -> Iterator[Site]:
    """Hosts that the test can drain."""
    if request.param == "loopback":
        with on_loopback(grace, settings) as loopback:
            yield loopback
    else:
        cluster = request.getfixturevalue("played_cluster")
        with on_pods(cluster, grace, settings) as pods:
            yield pods
        assert cluster.take_forced() == []


patient = pytest.mark.parametrize("grace", [PATIENT])
played = pytest.mark.parametrize("site", ["pods"], indirect=True)


def note(directory: Path, word: str) -> None:
    """Write a word where the test and all processes find it."""
    with open(directory / "log", "a") as log:
        log.write(f"{word}\n")


def notes(directory: Path) -> list[str]:
    """Return the words that were written so far."""
    log = directory / "log"
    return log.read_text().split() if log.exists() else []
