"""A vector environment whose workers are pods, on a cluster played in this process."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import fiber
from fakes.cluster import FakeCluster, fake_cluster
from faults.runtime import running
from fiber.vector import VectorEnv
from fiber_api import names
from patience import PATIENCE
from unit.kubernetes_rig import kubeconfig
from vector_envs import Faulty

pytestmark = pytest.mark.may_leak("the operator's connections, for as long as the cluster is there")


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[FakeCluster]:
    with fake_cluster() as cluster, pytest.MonkeyPatch.context() as patch:
        patch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, cluster.url)))
        with running(backend="kubernetes"):
            yield cluster


@fiber.meta(memory=512)
def small() -> Faulty:
    return Faulty()


@fiber.meta(cpu=2, memory=256)
def quick() -> Faulty:
    return Faulty()


def test_a_pod_worker_has_the_resources_of_its_environments(cluster: FakeCluster) -> None:
    env = VectorEnv([small, quick], num_workers=1)
    try:
        (pod,) = cluster.objects("pods")
        requests = pod["spec"]["containers"][0]["resources"]["requests"]
        assert requests["cpu"] == "2"
        assert requests["memory"] == "512Mi"
    finally:
        env.close(terminate=True)


def test_a_pod_that_is_deleted_between_send_and_recv(cluster: FakeCluster, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    env = VectorEnv([lambda: Faulty(gate)] * 4, num_workers=2, on_error="restart")
    try:
        assert env.reset()[0].tolist() == [[0]] * 4
        victim = env.call("getenv", names.ENV_NAME)[2]
        env.send([Faulty.GOOD, Faulty.GOOD, Faulty.WAIT, Faulty.GOOD])
        cluster.do(cluster.world.store.delete, "pods", "lab", victim)
        with pytest.warns(RuntimeWarning, match="(?s)environments 2 to 3 replaced: .*pod"):
            _, _, _, truncations, infos = env.recv(4, timeout=PATIENCE)
        truncated = dict(zip(infos["env_id"].tolist(), truncations.tolist(), strict=True))
        assert truncated == {0: False, 1: False, 2: True, 3: True}
        assert env.reset()[0].tolist() == [[0]] * 4
        assert env.step([Faulty.GOOD] * 4)[0].tolist() == [[1]] * 4
    finally:
        env.close(terminate=True)
