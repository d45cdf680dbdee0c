"""The operator ends, is away, or loses the API server: no worker is lost, none is there twice."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest

from e2e.clusters import Cluster
from e2e.kube import Body, Refused
from e2e.pools import Pool, is_live
from e2e.release import Release
from e2e.scene import Scene

MANY = 12


@pytest.fixture
def no_operator(release: Release) -> Iterator[None]:
    """Remove the operator; the test may start it, else it is started at the end."""
    release.stop()
    try:
        yield
    finally:
        release.start()


def grows_to(pool: Pool, workers: int) -> None:
    """So many workers come, and never was there one more."""
    pool.ready(workers, seconds=90)
    assert len(pool.ever) == workers
    assert pool.scene.most_at_once(is_live) == workers
    assert pool.status["failures"].get("total", 0) == 0


def test_killed_while_it_creates_workers(
    pool: Pool, agent: Body, release: Release, cluster: Cluster
) -> None:
    (status,) = release.pod()["status"]["containerStatuses"]
    restarts = status["restartCount"]
    pool.apply(agent, minReplicas=MANY, scaleUp={"maxInFlight": 2})
    pool.wait("a few workers", lambda: len(pool.ever) >= 3)
    cluster.kill(release.pod(), "operator")
    grows_to(pool, MANY)
    (status,) = release.pod()["status"]["containerStatuses"]
    assert status["restartCount"] == restarts + 1
    assert status["lastState"]["terminated"]["exitCode"] == 137


def test_another_operator_goes_on(pool: Pool, agent: Body, release: Release) -> None:
    pool.apply(agent, minReplicas=MANY, scaleUp={"maxInFlight": 2})
    pool.wait("a few workers", lambda: len(pool.ever) >= 3)
    first = release.pod()["metadata"]["name"]
    release.kubectl("delete", "pod", first, "--grace-period=0", "--force")
    grows_to(pool, MANY)
    release.wait_until_ready()
    assert release.pod()["metadata"]["name"] != first


def test_a_pool_that_is_deleted_meanwhile(scene: Scene, agent: Body, release: Release) -> None:
    goes, stays = Pool(scene, "goes"), Pool(scene, "stays")
    goes.apply(agent, minReplicas=2)
    stays.apply(agent, minReplicas=2)
    goes.ready(2)
    victim, kept = stays.ready(2)
    release.stop()
    try:
        goes.delete()
        stays.kubectl("delete", "pod", victim, "--wait=false")
        scene.wait("the pool and its workers are gone", lambda: not goes.body and not goes.pods)
        scene.wait("its endpoint too", lambda: "goes-fiber" not in scene.now["endpointslices"])
        scene.wait("the victim is gone", lambda: len(stays.pods) == 1)
    finally:
        release.start()
    after = stays.ready(2)
    assert kept in after
    assert len(stays.ever) == 3
    assert len(goes.ever) == 2


def test_a_pool_that_is_made_meanwhile(
    pool: Pool, agent: Body, release: Release, no_operator: None
) -> None:
    pool.apply(agent, minReplicas=1)
    pool.scene.never("a pod", lambda: pool.pods, seconds=1)
    release.start()
    pool.ready(1)


def test_no_worker_is_lost_with_the_api_server(
    pool: Pool, agent: Body, release: Release, cluster: Cluster
) -> None:
    pool.apply(agent, minReplicas=2)
    before = pool.ready(2)
    with cluster.without_apiserver():
        pool.scene.never("a worker goes", lambda: len(pool.live) != 2, seconds=5)
    pool.scale(3)
    assert set(before) < set(pool.ready(3, seconds=60))
    assert len(pool.ever) == 3
    release.wait_until_ready()


def test_a_second_operator_waits_and_takes_over(pool: Pool, agent: Body, release: Release) -> None:
    first = release.pod()
    release.scale(2)
    try:
        release.wait("a second operator waits", lambda: _is_waiting(release))
        pool.apply(agent, minReplicas=MANY, scaleUp={"maxInFlight": 2})
        pool.wait("a few workers", lambda: len(pool.ever) >= 3)
        release.kubectl("delete", "pod", first["metadata"]["name"], "--wait=false")
        grows_to(pool, MANY)
    finally:
        release.scale(1)
        release.wait_until_ready()


def test_foreign_writes_to_the_status_do_no_harm(pool: Pool, agent: Body) -> None:
    pool.apply(agent, minReplicas=2)
    before = pool.ready(2)
    nonsense = {
        "phase": "Splendid",
        "readyReplicas": 99,
        "endpoint": "nowhere",
        "failures": {"total": 99, "nextCreateTime": "2099-01-01T00:00:00Z"},
        "problems": [{"reason": "Whatever", "message": "none"}],
        "conditions": [{"type": "Ready", "status": "Unknown"}],
    }
    path = pool.scene.path("fiberpools", pool.name, "status")
    pool.scene.kube.patch(path, {"status": nonsense})
    pool.scale(3)
    assert set(before) < set(pool.ready(3))
    assert pool.problem("Whatever") is None
    assert pool.status["endpoint"].startswith("tls+tcp://")


def test_metrics_reach_the_monitoring(pool: Pool, agent: Body, release: Release) -> None:
    pool.apply(agent, minReplicas=2)
    pool.ready(2)
    mine = {"namespace": pool.scene.namespace, "pool": pool.name}
    samples = {
        (name, labels.get("state")): value
        for name, labels, value in release.metrics()
        if mine.items() <= labels.items()
    }
    assert samples["fiber_pool_pods", "ready"] == 2
    assert samples["fiber_pool_desired_pods", None] == 2
    for page in ("healthz", "readyz"):
        release.page(page, release.pod())
    lines = [json.loads(line) for line in release.log().splitlines()]
    assert all({"time", "level", "message"} <= line.keys() for line in lines)
    assert any(line.get("pool") == pool.name for line in lines)


def _is_waiting(release: Release) -> bool:
    """Return whether a second operator runs and says that another is the leader."""
    pods = release.pods()
    if len(pods) != 2:
        return False
    newest = max(pods, key=lambda pod: pod["metadata"]["creationTimestamp"])
    try:
        release.page("readyz", newest)
    except Refused as refused:
        return "holds the Lease" in refused.message
    return False
