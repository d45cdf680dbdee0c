"""A master that is cut off from the API server alone, and the master that may come after it.

The pool is a warm one, on a cluster played in this process.  A proxy is its Service, and another
one is the way from the first master to the API server.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

import fiber
from fakes.cluster import FakeCluster
from faults import test_pods
from faults.program import Program, wait_for
from faults.proxy import Proxy
from faults.runtime import running
from faults.test_pods import pods_of
from fiber._backends.kubernetes import provisioner
from fiber._backends.kubernetes.attached_pool import PoolMaster
from fiber.errors import FiberPoolError
from fiber_api import names
from fiber_api.names import ConditionType
from patience import PATIENCE
from unit.kubernetes_rig import kubeconfig

pytestmark = [
    pytest.mark.may_leak("the operator's connections, for as long as the cluster is there"),
    pytest.mark.timeout(300),  # Leases expire meanwhile
]

cluster = test_pods.cluster
_nothing_is_left = test_pods._nothing_is_left


@dataclass(frozen=True)
class ShortLived(PoolMaster):
    """A master whose Lease lasts as short as the API allows."""

    lease_duration: int = 5


NEXT_MASTER = """
    import os
    import sys

    import fiber

    def own_pod():
        return os.environ["FIBER_AGENT_NAME"]

    if __name__ == "__main__":
        with fiber.Pool(1, pool="warm") as pool:
            print(pool.apply(own_pod), flush=True)
            sys.stdin.read()
"""


class Warm:
    """A FiberPool ``warm`` with one pod, and the path to its masters."""

    def __init__(self, cluster: FakeCluster, service: Proxy, way: Proxy) -> None:
        self.cluster = cluster
        self.service = service
        self.way = way
        """Proxy between the first master and the API server."""
        (self.pod,) = pods_of(cluster)

    def lead_to_master(self, epoch: int) -> None:
        """Have the Service lead to the master of this epoch, once it is there."""

        def master() -> dict[str, object]:
            pool = self.cluster.world.store.get(names.PLURAL, "lab", "warm")
            found: dict[str, object] = pool["spec"].get("master") or {}
            return found

        self.cluster.wait(lambda: master().get("epoch") == epoch)
        found = self.cluster.do(master)
        self.service.lead_to(f"{found['host']}:{found['port']}")

    def wait_until_master_is_lost(self) -> None:
        """Wait until the operator says so, and another program may attach."""

        def lost() -> bool:
            conditions = self.cluster.world.status("warm", "lab").get("conditions", ())
            known = {entry["type"]: entry["status"] for entry in conditions}
            return known.get(ConditionType.MASTER_ALIVE) == "False"

        self.cluster.wait(lost)


@pytest.fixture
def warm(cluster: FakeCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Warm]:
    template = {"spec": {"containers": [{"name": names.WORKER_CONTAINER, "image": "worker"}]}}
    monkeypatch.setattr(provisioner, "PoolMaster", ShortLived)
    with (
        Proxy("127.0.0.1:1") as service,
        Proxy(cluster.url.removeprefix("http://")) as way,
    ):
        cluster.do(cluster.nodes.services.__setitem__, "warm", service.address)
        cluster.do(lambda: cluster.world.make_pool("warm", "lab", minReplicas=1, template=template))
        cluster.wait(lambda: len(cluster.world.pods("lab")) == 1)
        monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, f"http://{way.address}")))
        yield Warm(cluster, service, way)
        cluster.do(cluster.world.store.delete, names.PLURAL, "lab", "warm")
        cluster.wait(lambda: not cluster.nodes.processes)
        cluster.do(cluster.nodes.services.pop, "warm")


def note_and_wait(folder: Path, number: int) -> int:
    with (folder / "ran").open("a") as ran:
        ran.write(f"{number}\n")
    deadline = time.monotonic() + PATIENCE
    while not (folder / "go").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    return number


def ran(folder: Path) -> list[str]:
    path = folder / "ran"
    return path.read_text().split() if path.exists() else []


def test_agents_return_to_a_master_that_was_cut_off_without_loss(
    warm: Warm, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with running(backend="kubernetes", lost_after=PATIENCE), fiber.Pool(1, pool="warm") as pool:
        result = pool.map_async(partial(note_and_wait, tmp_path), range(3), chunksize=1)
        warm.lead_to_master(1)
        wait_for(lambda: ran(tmp_path) == ["0"])
        warm.way.sever()
        dialled = warm.service.connections
        wait_for(lambda: warm.service.connections > dialled + 1, what="two more connections")
        warm.way.heal()
        (tmp_path / "go").touch()
        assert result.get(PATIENCE) == [0, 1, 2]
        assert ran(tmp_path) == ["0", "1", "2"]
        assert {info.host for info in pool.workers()} == {warm.pod}
    assert "may get another master" in capfd.readouterr().err


def test_the_next_master_gets_the_agents_of_one_that_is_cut_off(
    warm: Warm, tmp_path: Path, cluster: FakeCluster, launch: Callable[..., Program]
) -> None:
    with running(backend="kubernetes", lost_after=PATIENCE), fiber.Pool(1, pool="warm") as pool:
        result = pool.apply_async(note_and_wait, (tmp_path, 0))
        warm.lead_to_master(1)
        wait_for(lambda: ran(tmp_path) == ["0"])
        warm.way.sever()
        warm.wait_until_master_is_lost()
        folder = tmp_path / "next"
        folder.mkdir()
        env = {
            "FIBER_BACKEND": "kubernetes",
            "FIBER_LOST_AFTER": f"{PATIENCE:g}",
            "KUBECONFIG": str(kubeconfig(folder, cluster.url)),
        }
        successor = launch(NEXT_MASTER, env=env, stdin=subprocess.PIPE)
        warm.lead_to_master(2)
        assert successor.line() == warm.pod
        warm.way.heal()
        with pytest.raises(FiberPoolError) as caught:
            result.get(PATIENCE)
        # A worker that is started after the loss tries to attach anew.
        assert caught.value.reason in ("Replaced", "InUse")
        assert ran(tmp_path) == ["0"]
        assert successor.process.stdin is not None
        successor.process.stdin.close()
        successor.finish()
