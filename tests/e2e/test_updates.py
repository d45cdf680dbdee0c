"""A changed template reaches the workers as spec.update.strategy says."""

from __future__ import annotations

import copy

from e2e.kube import Body
from e2e.pools import Pool, is_live, is_ready
from e2e.test_apply import SOMEWHERE
from fiber_api import names


def newer(agent: Body) -> Body:
    """Return the same template with another value of one variable."""
    changed = copy.deepcopy(agent)
    changed["spec"]["containers"][0]["env"] = [{"name": "VERSION", "value": "2"}]
    return changed


def revisions(pool: Pool) -> set[str]:
    """The template hashes of the live pods."""
    return {pod["metadata"]["labels"][names.LABEL_TEMPLATE_HASH] for pod in pool.live}


def test_on_idle_waits_for_the_master(pool: Pool, lone_agent: Body) -> None:
    pool.apply(lone_agent)
    pool.attach(master=SOMEWHERE, replicas=2)
    first, second = pool.ready(2)
    pool.apply(newer(lone_agent))
    pool.wait("none is updated", lambda: pool.status.get("updatedReplicas") == 0)
    assert pool.condition("Progressing")["reason"] == "Updating"
    pool.scene.never("a worker goes", lambda: len(pool.live) < 2, seconds=2)
    pool.attach(master=SOMEWHERE, replicas=2, scaleDown={"release": [first]})
    pool.wait("one is updated", lambda: pool.status.get("updatedReplicas") == 1)
    pool.wait("and ready", lambda: pool.status.get("readyReplicas") == 2)
    assert second in pool.names
    assert first not in pool.names
    pool.attach(master=SOMEWHERE, replicas=2, scaleDown={"release": [first, second]})
    assert set(pool.ready(2)).isdisjoint({first, second})
    assert revisions(pool) == {pool.status["templateHash"]}


def test_on_idle_replaces_a_warm_pool_bit_by_bit(pool: Pool, agent: Body) -> None:
    scene = pool.scene
    pool.apply(agent, minReplicas=4)
    before = pool.ready(4)
    start = len(scene.moments)
    pool.apply(newer(agent), minReplicas=4)
    pool.wait("the change is seen", lambda: pool.seen_generation)
    pool.wait("all are updated", lambda: pool.status.get("updatedReplicas") == 4, seconds=60)
    assert set(pool.ready(4)).isdisjoint(before)
    ready = set(before)
    fewest = 4
    for moment in scene.moments[start:]:
        if moment.resource == "pods":
            there = not moment.gone and is_live(moment.object) and is_ready(moment.object)
            (ready.add if there else ready.discard)(moment.name)
            fewest = min(fewest, len(ready))
    assert fewest == 3


def test_recreate_replaces_all_at_once(pool: Pool, lone_agent: Body) -> None:
    recreate = {"update": {"strategy": "Recreate"}}
    pool.apply(lone_agent, **recreate)
    pool.attach(master=SOMEWHERE, replicas=3)
    before = pool.ready(3)
    pool.apply(newer(lone_agent), **recreate)
    pool.wait("all are new", lambda: len(pool.names) == 3 and pool.names.isdisjoint(before))
    pool.ready(3)
    assert len(pool.ever) == 6
    assert revisions(pool) == {pool.status["templateHash"]}


def test_on_delete_updates_only_pods_that_a_user_deletes(pool: Pool, agent: Body) -> None:
    on_delete = {"update": {"strategy": "OnDelete"}, "minReplicas": 2}
    pool.apply(agent, **on_delete)
    first, second = pool.ready(2)
    pool.apply(newer(agent), **on_delete)
    pool.wait("none is updated", lambda: pool.status.get("updatedReplicas") == 0)
    pool.scene.never("a worker goes", lambda: len(pool.live) < 2, seconds=2)
    assert pool.status["phase"] == "Ready"
    pool.kubectl("delete", "pod", first, "--wait=false")
    pool.wait("one is updated", lambda: pool.status.get("updatedReplicas") == 1)
    pool.wait("and ready", lambda: pool.status.get("readyReplicas") == 2)
    assert second in pool.names


def test_a_change_outside_the_template_restarts_no_worker(pool: Pool, agent: Body) -> None:
    pool.apply(agent, minReplicas=1, update={"strategy": "Recreate"})
    before = pool.ready(1)
    pool.apply(agent, minReplicas=2, maxReplicas=9, update={"strategy": "Recreate"})
    assert set(before) < set(pool.ready(2))
    assert len(pool.ever) == 2
