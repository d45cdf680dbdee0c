"""Pods' readiness on a simulated cluster in this process, and the number of connected pods."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import fiber
from fakes.cluster import FakeCluster, fake_cluster
from faults.runtime import running
from unit.kubernetes_rig import kubeconfig

pytestmark = [
    pytest.mark.may_leak("the operator's connections, for as long as the cluster is there"),
]


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeCluster]:
    with fake_cluster() as cluster:
        monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, cluster.url)))
        yield cluster


def square(number: int) -> int:
    return number * number


def test_pods_are_ready_once_their_agents_are_linked(
    cluster: FakeCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fiber._backends.kubernetes.fiber_pool.RENEWALS", 300)

    def has(**counts: int) -> Callable[[], bool]:
        def reached() -> bool:
            pools = cluster.world.store.list("fiberpools")
            return [{key: pool.get("status", {}).get(key) for key in counts} for pool in pools] == [
                counts
            ]

        return reached

    with running(backend="kubernetes"), fiber.Pool(2) as pool:
        assert pool.map(square, range(3)) == [0, 1, 4]
        cluster.wait(has(readyReplicas=2, connectedReplicas=2))
        pods = {pod["metadata"]["name"]: pod for pod in cluster.objects("pods")}
        assert all("startupProbe" in pod["spec"]["containers"][0] for pod in pods.values())
        # A worker that dials a dead address replaces one that is killed.
        cluster.nodes.cut_off = True
        cluster.do(cluster.nodes.kill, next(iter(pods)))
        cluster.wait(has(replicas=2, pendingReplicas=0, readyReplicas=1, connectedReplicas=1))
        assert pool.map(square, range(3)) == [0, 1, 4]
