"""Requests of a master to a pool, and the pool after the master leaves or forgets it."""

from __future__ import annotations

from typing import Any

import pytest

from fiber_api.times import format_time
from fiber_operator.planning import plans
from unit.operator_objects import (
    MASTER,
    NOW,
    ended,
    make_pool,
    name_of,
    of_template,
    plan_of,
    running,
    with_plan,
)
from unit.test_operator_reconcile import EXPIRED, LEASED, gone, lost, names, proven, tried

Json = dict[str, Any]

# -- One that is lost


def test_a_lease_that_is_never_made_is_that_of_a_lost_master() -> None:
    """A program that died between making the pool and the Lease leaves nothing for ever."""
    pool = tried(replicas=2, master=LEASED, onLost="Delete")
    soon = plan_of(pool, running(1), master=plans.LeaseVerdict(missing=True))
    assert (soon.delete_pool, soon.delete, soon.create) == (False, (), 1)
    told = with_plan(pool, soon)
    never = plans.LeaseVerdict(alive=False, missing=True)
    found = plan_of(told, running(1), running(2), master=never, now=NOW + 30)
    assert (found.delete_pool, found.requeue_at) == (False, NOW + 90)
    told = with_plan(told, found)
    assert not plan_of(told, running(1), running(2), master=never, now=NOW + 89).delete_pool
    assert plan_of(told, running(1), running(2), master=never, now=NOW + 90).delete_pool


def test_a_master_that_did_not_make_the_pool_does_not_end_it() -> None:
    """A laptop attaches to a platform's warm pool and dies."""
    pool = lost(make_pool(replicas=3, minReplicas=1, master=LEASED), ago=60)
    made = plan_of(pool, running(1), running(2, age=50), master=EXPIRED)
    assert (made.delete_pool, gone(made)) == (False, names(2))


# -- Released workers


def test_a_release_below_the_minimum_changes_no_pod() -> None:
    release = {"release": [name_of(1), name_of(2)]}
    pool = tried(replicas=1, minReplicas=3, master=MASTER, scaleDown=release)
    made = plan_of(pool, running(1), running(2), running(3))
    assert (made.delete, made.create) == ((), 0)
    # Of those that are more than the minimum it still takes as many as are named.
    made = plan_of(pool, running(1), running(2), running(3), running(4))
    assert (len(made.delete), made.create) == (1, 0)
    assert set(gone(made)) < set(names(1, 2))


def test_a_released_worker_is_deleted_unless_only_the_minimum_keeps_it() -> None:
    release = {"release": [name_of(1)]}
    wanted = tried(replicas=3, minReplicas=3, master=MASTER, scaleDown=release)
    made = plan_of(wanted, running(1), running(2), running(3))
    assert (gone(made), made.create) == (names(1), 1)
    # An outdated worker is released to be replaced; an ended one has no work to lose.
    idle = tried(replicas=0, minReplicas=3, master=MASTER, scaleDown=release)
    made = plan_of(idle, of_template("older", running(1)), running(2), running(3))
    assert (gone(made), made.create) == (names(1), 1)
    assert gone(plan_of(idle, ended(1, 0), running(2), running(3), running(4))) == names(1)


# -- A master that was forgotten


IDLE = {"master": MASTER, "idle": {"timeoutSeconds": 3600}}


def test_an_idle_master_does_not_hold_the_minimum() -> None:
    pool = tried(minReplicas=2, **IDLE)
    made = plan_of(pool, running(1), running(2))
    assert made.requeue_at == NOW + 3600
    pool = with_plan(pool, made)
    assert (pool.status.idle_since, pool.status.desired_replicas) == (NOW, 2)
    soon = with_plan(pool, plan_of(pool, running(1), running(2), now=NOW + 3599))
    assert soon.status.desired_replicas == 2
    pool = with_plan(pool, plan_of(pool, running(1), running(2), now=NOW + 3600))
    assert (pool.status.idle_since, pool.status.desired_replicas) == (NOW, 0)
    # Only it knows that they are idle still: it releases them, and they go for good.
    draining = plan_of(pool, running(1), running(2), now=NOW + 3601)
    assert (draining.delete, draining.create) == ((), 0)
    spec = pool.spec.model_dump(mode="json", by_alias=True)
    released = make_pool(
        pool.status.model_dump(mode="json", by_alias=True),
        **{**spec, "scaleDown": {"release": [name_of(1), name_of(2)]}},
    )
    made = plan_of(released, running(1), running(2), now=NOW + 3602)
    assert (gone(made), made.create) == (names(1, 2), 0)


@pytest.mark.parametrize(
    "change",
    [{"replicas": 1}, {"master": {**MASTER, "epoch": 2}}, {"master": None}, {"idle": None}],
    ids=str,
)
def test_a_master_with_requests_or_a_new_one_holds_the_minimum(change: Json) -> None:
    status = {"idleSince": format_time(NOW - 9000), "masterEpoch": 1}
    pool = tried(minReplicas=2, **IDLE)
    idle = make_pool({**proven(pool), **status}, minReplicas=2, **IDLE)
    assert plan_of(idle, running(1)).create == 0
    busy = make_pool({**proven(pool), **status}, minReplicas=2, **{**IDLE, **change})
    assert plan_of(busy, running(1)).create == 1
