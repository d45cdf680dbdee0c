"""Programs on a played cluster whose account has the role ``fiber-user`` and no other right."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from fakes.cluster import FakeCluster, fake_cluster
from fakes.kubernetes_api import Fault
from fakes.rights import FiberUser
from faults.runtime import running
from fiber.pool import Pool
from fiber_api import names
from unit.kubernetes_rig import NAMESPACE, kubeconfig

pytestmark = [
    pytest.mark.may_leak("the operator's connections, for as long as the cluster is there"),
]

OLD = {"spec": {"renewTime": "2020-01-01T00:00:00.000000Z"}}


@pytest.fixture
def namespaces() -> tuple[str, ...]:
    """Namespaces that the operator serves; none: all."""
    return ()


@pytest.fixture
def cluster(
    namespaces: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[FakeCluster]:
    with fake_cluster(namespaces=namespaces) as cluster:
        monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, cluster.url)))
        monkeypatch.setenv("KUBERNETES_SERVICE_HOST", "10.96.0.1")  # as in a pod
        cluster.world.api.allows = FiberUser(NAMESPACE).allow
        for place in namespaces or (names.SERVING_NAMESPACE,):
            cluster.wait(partial(_lease_in, cluster, place))
        yield cluster


def _lease_in(cluster: FakeCluster, namespace: str) -> bool:
    found = cluster.world.store.list("leases", namespace)
    return names.SERVING_LEASE in {lease["metadata"]["name"] for lease in found}


def backend() -> str:
    with running(backend="auto") as runtime:
        if runtime.backend.name == "kubernetes":
            with Pool(1) as pool:
                assert pool.apply(abs, (-7,)) == 7
        return runtime.backend.name


@pytest.mark.parametrize("namespaces", [(), (NAMESPACE,)], ids=["all", "this"])
def test_a_living_operator_gives_pods(cluster: FakeCluster) -> None:
    if _lease_in(cluster, NAMESPACE):
        cluster.world.api.allows = FiberUser(NAMESPACE, sees_operators=False).allow
    assert backend() == "kubernetes"


@pytest.mark.parametrize("namespaces", [(), (NAMESPACE,)], ids=["all", "this"])
def test_a_dead_operator_gives_none(
    namespaces: tuple[str, ...], cluster: FakeCluster, caplog: pytest.LogCaptureFixture
) -> None:
    (place,) = namespaces or (names.SERVING_NAMESPACE,)
    cluster.do(cluster.world.crash)
    cluster.wait(lambda: cluster.world.dead)
    cluster.do(cluster.world.store.merge, "leases", place, names.SERVING_LEASE, OLD)
    assert backend() == "local"
    (line,) = caplog.messages
    assert "was last renewed at 2020-01-01T00:00:00Z" in line


@pytest.mark.parametrize("namespaces", [("other",)], ids=["other"])
def test_an_operator_of_other_namespaces_gives_none(
    cluster: FakeCluster, caplog: pytest.LogCaptureFixture
) -> None:
    assert backend() == "local"
    (line,) = caplog.messages
    assert "no operator shows that it serves the namespace 'lab'" in line


def test_an_operator_that_may_not_be_seen_gives_none(
    cluster: FakeCluster, caplog: pytest.LogCaptureFixture
) -> None:
    cluster.world.api.allows = FiberUser(NAMESPACE, sees_operators=False).allow
    assert backend() == "local"
    (line,) = caplog.messages
    assert "may not be read in the namespace 'kube-public'" in line


def test_an_account_without_rights_stays_local_in_silence(
    cluster: FakeCluster, caplog: pytest.LogCaptureFixture
) -> None:
    cluster.world.api.allows = lambda call: False
    assert backend() == "local"
    assert not caplog.messages


def test_pods_come_though_the_secret_was_made_by_an_attempt_without_an_answer(
    cluster: FakeCluster,
) -> None:
    cluster.do(cluster.world.api.faults.append, Fault("create", "secrets", carried_out=True))
    assert backend() == "kubernetes"
    cluster.wait(lambda: not cluster.world.store.list("secrets"))
