"""A program attaches to a pool that is warm, and every agent dials in."""

from __future__ import annotations

import pytest

from e2e.accounts import may_use_pools
from e2e.clusters import Cluster
from e2e.delays import record
from e2e.kube import Body
from e2e.masters import Inside, Master, outside
from e2e.pools import Pool, is_ready, state_of, template
from e2e.scene import Scene
from e2e.test_apply import SOMEWHERE


@pytest.fixture
def host(cluster: Cluster) -> str:
    """Return the address at which pods reach a program beside the tests."""
    if cluster.outside is None:
        pytest.skip(f"{cluster.description}: pods cannot reach a program beside the tests")
    return cluster.outside


def endpoints(scene: Scene, pool: Pool) -> list[tuple[list[str], int]]:
    """Return the addresses that the pool's Service leads to."""
    found = scene.now["endpointslices"].get(f"{pool.name}-fiber", {})
    ports = [port["port"] for port in found.get("ports") or []]
    return [
        (endpoint["addresses"], port) for endpoint in found.get("endpoints") or [] for port in ports
    ]


def follows(pool: Pool, master: Master) -> None:
    """The slice and the table say where the master is."""
    host, _, port = master.address.rpartition(":")
    pool.wait("the endpoint", lambda: endpoints(pool.scene, pool) == [([host], int(port))])
    pool.wait("the status", lambda: pool.status.get("master") == master.address)
    assert master.address in pool.kubectl("get", "fiberpool", pool.name)


def test_a_master_outside_of_the_cluster(pool: Pool, agent: Body, host: str) -> None:
    pool.apply(agent, minReplicas=3)
    workers = pool.ready(3)
    with outside(pool, host) as first:
        record("agents join the first master", first.is_joined_by(*workers))
        follows(pool, first)
        first.kill()
    with outside(pool, host) as second:
        record("agents join the second master", second.is_joined_by(*workers))
        assert second.address != first.address
        follows(pool, second)
        assert pool.status["masterEpoch"] == 2
        second.end()
    pool.wait("nobody at the endpoint", lambda: not endpoints(pool.scene, pool))
    pool.wait("no master in the status", lambda: "master" not in pool.status)
    with outside(pool, host) as third:
        record("agents join the third master", third.is_joined_by(*workers))
    assert sorted(pool.names) == workers
    assert all(is_ready(pod) for pod in pool.live)


def test_a_worker_that_may_write_only_to_tmp_works(pool: Pool, image: str, host: str) -> None:
    pool.apply(template(image, securityContext={"readOnlyRootFilesystem": True}), minReplicas=1)
    (worker,) = pool.ready(1)
    with outside(pool, host) as master:
        master.is_joined_by(worker)


def test_a_worker_that_comes_later_joins_too(pool: Pool, agent: Body, host: str) -> None:
    pool.apply(agent, minReplicas=1)
    (worker,) = pool.ready(1)
    with outside(pool, host) as master:
        master.is_joined_by(worker)
        pool.scale(2)
        master.is_joined_by(*pool.ready(2))


def test_workers_are_ready_once_a_master_has_answered_them(
    pool: Pool, agent: Body, host: str
) -> None:
    pool.apply(agent)
    pool.attach(master=SOMEWHERE, replicas=1)
    pool.wait("it runs", lambda: [pod for pod in pool.live if "running" in state_of(pod)], 60.0)
    pool.wait("it is said", lambda: pool.status.get("pendingReplicas") == 0)
    assert not any(is_ready(pod) for pod in pool.live)
    assert (pool.status["replicas"], pool.status["readyReplicas"]) == (1, 0)
    assert pool.status["phase"] == "Scaling"
    assert "connectedReplicas" not in pool.status  # no Lease says anything of it
    pool.patch(minReplicas=1)  # replicas that the next master does not set are removed
    (worker,) = pool.names
    with outside(pool, host) as master:
        master.is_joined_by(worker)
        assert pool.ready(1) == [worker]
        master.end()
    pool.wait("nobody is linked", lambda: pool.status.get("connectedReplicas") == 0)
    assert pool.ready(1) == [worker]  # it waits for the next one on purpose


def test_a_master_in_the_cluster(pool: Pool, agent: Body, image: str) -> None:
    may_use_pools(pool.scene)
    pool.apply(agent, minReplicas=2)
    workers = pool.ready(2)
    first = Inside(pool, image)
    record("agents join the first master", first.is_joined_by(*workers))
    follows(pool, first)
    first.kill()
    second = Inside(pool, image)
    record("agents join the second master", second.is_joined_by(*workers))
    assert second.address != first.address
    follows(pool, second)
    second.end()
    pool.wait("no master in the status", lambda: "master" not in pool.status)
    assert sorted(pool.names) == workers


def test_workers_end_some_time_after_their_master(pool: Pool, agent: Body, host: str) -> None:
    # Without a Lease only the agents can notice, and those that end make room for new ones.
    pool.apply(agent, minReplicas=1)  # warm: the worker is older than the master's settings
    (worker,) = pool.ready(1)
    with outside(pool, host, lost_grace=1) as master:
        master.has_welcomed(worker)
    pool.wait("another", lambda: pool.ever - {worker}, seconds=90)

    def runs() -> bool:
        # The pod is not Ready: it was made for a dead master whose death is not known.
        counts = [pool.status.get(f"{kind}Replicas") for kind in ("ready", "pending")]
        return len(pool.live) == 1 and counts == [0, 0]

    pool.wait("it runs", runs, seconds=60)
    assert worker not in pool.names
    assert pool.status["problems"] == []  # one that ended well is no failure


def test_each_master_gets_the_agents_of_its_pool_only(scene: Scene, agent: Body, host: str) -> None:
    es, ppo = Pool(scene, "es"), Pool(scene, "ppo")
    es.apply(agent, minReplicas=1)
    ppo.apply(agent, minReplicas=2)
    with outside(es, host) as first, outside(ppo, host) as second:
        first.is_joined_by(*es.ready(1))
        second.is_joined_by(*ppo.ready(2))
        assert set(first.joined) == es.names
        assert set(second.joined) == ppo.names


def test_the_endpoint_follows_the_master(pool: Pool, agent: Body) -> None:
    scene = pool.scene
    pool.apply(agent)
    pool.wait("an endpoint slice", lambda: scene.now["endpointslices"])
    assert endpoints(scene, pool) == []
    moves(pool, SOMEWHERE)
    moves(pool, {"host": "10.0.3.8", "port": 5000, "epoch": 2, "identity": "somebody else"})
    pool.attach()
    pool.wait("nobody", lambda: endpoints(scene, pool) == [])


def moves(pool: Pool, master: Body) -> None:
    """Let this be the master; the endpoint follows soon."""
    scene, there = pool.scene, [([master["host"]], master["port"])]
    pool.attach(master=master)
    pool.wait("the endpoint", lambda: endpoints(scene, pool) == there)
    asked = scene.first("fiberpools", lambda found: _epoch(found) == master["epoch"])
    moved = [moment.at for moment in scene.moments if moment.resource == "endpointslices"]
    record("the endpoint follows the master", moved[-1] - asked)


def _epoch(pool: Body) -> int | None:
    epoch: int | None = pool["spec"].get("master", {}).get("epoch")
    return epoch
