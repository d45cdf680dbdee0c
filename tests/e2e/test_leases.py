"""Masters that vanish without notice: their Leases reveal it, and their pools follow.

The pools lose their masters at the same time, since a Lease takes at least five seconds to expire.
"""

from __future__ import annotations

import datetime
import time
from collections.abc import Callable, Mapping

import pytest

from e2e.kube import MERGE, Body
from e2e.pools import Pool, condition_in, says
from e2e.scene import Moment, NotSo, Scene
from e2e.test_apply import SOMEWHERE, table
from fiber_api import names

DURATION = 5
"""The shortest that there is."""
LATE = 3 * DURATION
"""Seconds after the last renewal until the operator must have noticed: it looks every third."""
GRACE = 3

Pools = Mapping[str, Pool]


@pytest.fixture(scope="module")
def pools(module_scene: Scene, lone_agent: Body) -> Pools:
    """Make a pool for each fate, and one whose master comes back; each has a live master."""
    fates = {"delete": "Delete", "shrink": "ScaleToMin", "retain": "Retain", "return": "Delete"}
    pools = {name: Pool(module_scene, name) for name in fates}
    for name, pool in pools.items():
        pool.apply(lone_agent, minReplicas=1, onLost=fates[name])
    # From here on each Lease must be renewed.
    for name, pool in pools.items():
        pool.attach(replicas=2, master=master_of(pool, 60 if name == "return" else GRACE))
        make_lease(pool)
    everyone = list(pools.values())
    while_renewed(everyone, lambda: all(map(is_ready, everyone)) and all(map(is_alive, everyone)))
    return pools


def master_of(pool: Pool, grace: int) -> Body:
    return {
        **SOMEWHERE,
        "leaseName": names.master_lease_name(pool.name),
        "leaseDurationSeconds": DURATION,
        "lostGraceSeconds": grace,
    }


def make_lease(pool: Pool) -> None:
    """Create and renew the Lease as a master does after its pool exists."""
    uid = pool.wait("it is there", lambda: pool.body["metadata"]["uid"] if pool.body else None)
    kind = {"apiVersion": names.API_VERSION, "kind": names.KIND}
    metadata = {
        "name": names.master_lease_name(pool.name),
        "labels": {names.LABEL_POOL: pool.name, names.LABEL_POOL_UID: uid},
        "ownerReferences": [{**kind, "name": pool.name, "uid": uid}],
    }
    body = {"metadata": metadata, "spec": {"holderIdentity": "master-of-the-test"}}
    pool.scene.kube.create(pool.scene.path("leases"), body)


def renew(pool: Pool) -> None:
    """Renew as a live master does every few seconds."""
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="microseconds")
    spec = {"renewTime": now.replace("+00:00", "Z")}
    lease = pool.scene.path("leases", names.master_lease_name(pool.name))
    pool.scene.kube.patch(lease, {"spec": spec}, MERGE)


def while_renewed(pools: list[Pool], condition: Callable[[], bool]) -> None:
    """Wait for the condition while the masters are alive."""
    for _ in range(60):
        for pool in pools:
            renew(pool)
        try:
            pools[0].wait("while the Leases are renewed", condition, seconds=1.0)
        except NotSo:
            continue
        return
    raise NotSo("it did not become so while the Leases were renewed")


def is_ready(pool: Pool) -> bool:
    return pool.status.get("readyReplicas") == len(pool.live) == 2


def is_alive(pool: Pool) -> bool:
    return bool(pool.condition("MasterAlive").get("status") == "True")


def is_lost(pool: Pool) -> Body:
    return pool.has_problem("MasterLost", seconds=LATE)


def test_a_lost_master_is_reported(pools: Pools) -> None:
    pool = pools["retain"]
    problem = is_lost(pool)
    address = names.address_of(SOMEWHERE["host"], SOMEWHERE["port"])
    words = ("Lease fiber-retain", f"{DURATION} s", address, "somebody", "workers stay")
    assert says(problem["message"], *words)
    alive = pool.condition("MasterAlive")
    assert (alive["status"], alive["reason"]) == ("False", "MasterLost")
    assert table(pool)["REASON"] == "MasterLost"


def test_a_master_that_comes_back_keeps_its_pool(pools: Pools) -> None:
    pool = pools["return"]
    before = pool.names
    is_lost(pool)
    while_renewed([pool], lambda: is_alive(pool) and not pool.problem("MasterLost"))
    assert pool.names == before
    assert pool.status["phase"] == "Ready"


def test_delete_deletes_the_pool(pools: Pools) -> None:
    pool = pools["delete"]
    pool.wait("the pool is gone", lambda: not pool.body, seconds=LATE + GRACE)
    pool.wait("its workers too", lambda: not pool.pods)
    lease = pool.scene.path("leases", names.master_lease_name(pool.name))
    pool.wait("its Lease too", lambda: not pool.scene.kube.get(lease))
    *_, lost, gone = (m for m in pool.scene.moments if _is_of(m, pool))
    alive = condition_in(lost.object, "MasterAlive")
    assert alive["status"] == "False"
    since = datetime.datetime.fromisoformat(alive["lastTransitionTime"]).timestamp()
    went = time.time() - (time.monotonic() - gone.at)
    assert went - since >= GRACE


def test_a_pool_whose_lease_is_never_made_goes_too(pool: Pool, agent: Body) -> None:
    """Simulate a program that died between making the pool and the Lease."""
    pool.apply(agent, onLost="Delete")
    pool.attach(master=master_of(pool, GRACE))
    pool.has_problem("LeaseNotFound", severity="Warning")
    pool.wait("the pool is gone", lambda: not pool.body, seconds=LATE + GRACE)


def test_scale_to_min_keeps_the_least(pools: Pools) -> None:
    pool = pools["shrink"]
    pool.wait("one worker", lambda: len(pool.live) == 1, seconds=LATE + GRACE)
    assert pool.body["spec"]["replicas"] == 2
    pool.wait("the status", lambda: pool.status.get("desiredReplicas") == 1)


def test_retain_keeps_all(pools: Pools) -> None:
    pool = pools["retain"]
    is_lost(pool)
    pool.scene.never("a worker goes", lambda: len(pool.live) != 2, seconds=GRACE)
    victim = min(pool.names)
    pool.kubectl("delete", "pod", victim, "--wait=false")
    pool.wait("it is replaced", lambda: len(pool.names - {victim}) == 2)


def _is_of(moment: Moment, pool: Pool) -> bool:
    return moment.resource == "fiberpools" and moment.name == pool.name
