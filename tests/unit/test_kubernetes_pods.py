"""A program whose processes are pods: the whole way, on a cluster that is played in this process."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import fiber
from fakes.cluster import FakeCluster, fake_cluster
from faults.runtime import running
from unit.kubernetes_rig import kubeconfig

LEFT = ("fiberpools", "pods", "secrets", "leases", "services", "endpointslices")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakeCluster]:
    folder = tmp_path_factory.mktemp("cluster")
    with fake_cluster(folder) as cluster, pytest.MonkeyPatch.context() as patch:
        patch.setenv("KUBECONFIG", str(kubeconfig(folder, cluster.url)))
        yield cluster


@pytest.fixture(autouse=True)
def _nothing_is_left(cluster: FakeCluster) -> Iterator[None]:
    yield
    theirs = {"fiber-operator.operator.fiber.dev", "fiberpools.fiber.dev"}

    def left() -> set[str]:
        found = [o for plural in LEFT for o in cluster.world.store.list(plural)]
        return {o["metadata"]["name"] for o in found} - theirs

    cluster.wait(lambda: not left())


def square(number: int) -> int:
    return number * number


def where(_: Any) -> str:
    return os.environ["FIBER_AGENT_NAME"]


def test_a_pool_is_pods_that_come_with_the_work_and_go_with_the_program(
    cluster: FakeCluster,
) -> None:
    with running(backend="kubernetes"), fiber.Pool(2) as pool:
        assert cluster.objects("pods") == []
        assert pool.map(square, range(100)) == [n * n for n in range(100)]
        assert len(cluster.objects("pods")) == 2
        assert {info.host for info in pool.workers()} == {
            pod["metadata"]["name"] for pod in cluster.objects("pods")
        }
