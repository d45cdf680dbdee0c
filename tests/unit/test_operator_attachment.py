"""A pool and its master: it joins, is lost, releases workers, or is forgotten."""

from __future__ import annotations

from typing import Any

import pytest

from fiber_api.names import Reason
from fiber_api.times import format_time
from fiber_api.v1alpha1 import FiberPool
from fiber_operator.planning import plans
from unit.operator_objects import (
    EXPIRED,
    LEASED,
    MASTER,
    NOW,
    UNKNOWN,
    edited,
    ended,
    lost,
    names,
    outdated,
    plan_of,
    row,
    running,
    tried,
    with_plan,
    work_of,
)

Json = dict[str, Any]
SECOND = {**LEASED, "epoch": 2}


def attended(on_lost: str) -> FiberPool:
    return tried(replicas=3, master=LEASED, onLost=on_lost)


def after_grace(on_lost: str | None, **spec: Any) -> FiberPool:
    """Return a pool whose master's grace period ends now."""
    named = {"onLost": on_lost} if on_lost else {}
    return lost(60, replicas=3, minReplicas=1, **named, **spec)


def releasing(*numbers: int, **spec: Any) -> FiberPool:
    return tried(master=MASTER, scaleDown={"release": names(*numbers)}, **spec)


TWO = [running(1), running(2, age=50)]
THREE = [running(1), running(2), running(3)]
EDITS = {
    "template": {"spec": {"containers": [{"name": "worker", "image": "corrected"}]}},
    "failurePolicy": {"backoffLimit": 9},
    "suspend": True,
    "update": {"strategy": "Recreate"},
}

LOST = [
    *(
        row(
            f"grace-{on_lost}",
            work,
            tried(replicas=3, master=LEASED, onLost=on_lost),
            *TWO,
            master=EXPIRED,
        )
        for on_lost, work in [("Delete", "+0"), ("ScaleToMin", "+0"), ("Retain", "+1")]
    ),
    row("after-Delete", "+0 pool", after_grace("Delete"), *TWO, master=EXPIRED),
    row("after-ScaleToMin", "-2 +0 ScaledDown", after_grace("ScaleToMin"), *TWO, master=EXPIRED),
    # A master that did not make the pool does not end it.
    row("after-the-default", "-2 +0 ScaledDown", after_grace(None), *TWO, master=EXPIRED),
    row("after-Retain", "+1", after_grace("Retain"), *TWO, master=EXPIRED),
    row("unconfirmed-Delete", "+0", after_grace("Delete"), *TWO, master=UNKNOWN),
    row("unconfirmed-ScaleToMin", "+0", after_grace("ScaleToMin"), *TWO, master=UNKNOWN),
    row("new-master", "+1", lost(30, replicas=2, master=SECOND), running(1), master=UNKNOWN),
    row("back", "+1", lost(30, replicas=2), running(1), master=plans.LeaseVerdict(alive=True)),
]

RELEASED = [
    row("below-the-minimum", "+0", releasing(1, 2, replicas=1, minReplicas=3), *THREE),
    row("wanted", "-1 +1 Released", releasing(1, replicas=3, minReplicas=3), *THREE),
    # An outdated worker is released to be replaced; an ended one has no work to lose.
    row(
        "outdated",
        "-1 +1 Released",
        releasing(1, minReplicas=3),
        *outdated(running(1)),
        *THREE[1:],
    ),
    row(
        "ended",
        "-1 +0 Released",
        releasing(1, minReplicas=3),
        ended(1, 0),
        *THREE[1:],
        running(4),
    ),
]


@pytest.mark.parametrize(("pool", "pods", "known", "work"), [*LOST, *RELEASED])
def test_a_plan_has_this_work(pool: FiberPool, pods: list[Json], known: Json, work: str) -> None:
    assert work_of(plan_of(pool, *pods, **known)) == work


def test_only_workers_above_the_minimum_are_released() -> None:
    made = plan_of(releasing(1, 2, replicas=1, minReplicas=3), *THREE, running(4))
    assert (len(made.delete), made.create) == (1, 0)
    assert made.delete[0].name in names(1, 2)


# -- One that is lost


def grace_of(pool: FiberPool, made: plans.Plan, *pods: Json, **known: Any) -> float:
    """Return when the pool will be deleted; check that this does not happen earlier."""
    assert (made.delete_pool, made.requeue_at is None) == (False, False)
    pool, end = with_plan(pool, made), made.requeue_at or 0.0
    assert not plan_of(pool, *pods, **known, now=end - 1).delete_pool
    assert plan_of(pool, *pods, **known, now=end).delete_pool
    return end


@pytest.mark.parametrize("on_lost", ["Delete", "ScaleToMin", "Retain"])
def test_a_lost_master_has_a_grace_period(on_lost: str) -> None:
    pool = attended(on_lost)
    made = plan_of(pool, *TWO, master=EXPIRED)
    assert made.requeue_at == NOW + 60
    status = with_plan(pool, made).status
    assert (status.problems[0].reason, status.phase) == ("MasterLost", "Degraded")


@pytest.mark.parametrize("ago", [-(10**9), 10**9, 2000])
def test_an_impossible_time_of_a_loss_shortens_no_grace(ago: float) -> None:
    """A user has edited the status of a pool that is a thousand seconds old."""
    pool = lost(ago, replicas=1, onLost="Delete")
    born = pool.metadata.model_copy(update={"creation_timestamp": NOW - 1000})
    pool = pool.model_copy(update={"metadata": born})
    made = plan_of(pool, running(1), master=EXPIRED)
    assert grace_of(pool, made, running(1), master=EXPIRED) == NOW + 60


def test_a_second_master_that_is_lost_has_another_grace_period() -> None:
    pool = lost(50, replicas=2, master=SECOND, onLost="Delete")
    made = plan_of(pool, running(1), master=EXPIRED)
    assert grace_of(pool, made, running(1), master=EXPIRED) == NOW + 60


@pytest.mark.parametrize("field", EDITS)
def test_an_edit_while_the_master_is_lost_gives_it_no_time(field: str) -> None:
    pool = edited(lost(61, replicas=2, onLost="Delete"), **{field: EDITS[field]})
    assert plan_of(pool, running(1), master=EXPIRED).delete_pool
    restarted = plan_of(pool, running(1), master=UNKNOWN)
    assert (restarted.delete_pool, restarted.create) == (False, 0)
    (alive,) = (c for c in with_plan(pool, restarted).status.conditions if c.type == "MasterAlive")
    assert (alive.status, alive.last_transition_time) == ("False", NOW - 61)


def test_a_master_whose_lease_is_never_made_is_lost() -> None:
    """A program died after it made the pool and before it made the Lease."""
    pool = tried(replicas=2, master=LEASED, onLost="Delete")
    soon = plan_of(pool, running(1), master=plans.LeaseVerdict(missing=True))
    assert work_of(soon) == "+1"
    pool, never = with_plan(pool, soon), plans.LeaseVerdict(alive=False, missing=True)
    found = plan_of(pool, running(1), running(2), master=never, now=NOW + 30)
    assert grace_of(pool, found, running(1), running(2), master=never) == NOW + 90


def test_a_new_master_is_announced() -> None:
    pool = tried(replicas=0, master={**MASTER, "epoch": 4})
    made = plan_of(pool)
    (event,) = (event for event in made.events if event.reason == Reason.MASTER_CHANGED)
    assert "10.0.3.7:41337" in event.message
    assert with_plan(pool, made).status.master_epoch == 4


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
    released = edited(pool, scaleDown={"release": names(1, 2)})
    made = plan_of(released, running(1), running(2), now=NOW + 3602)
    assert work_of(made) == "-1 -2 +0 Released"


@pytest.mark.parametrize(
    "change",
    [{"replicas": 1}, {"master": {**MASTER, "epoch": 2}}, {"master": None}, {"idle": None}],
    ids=str,
)
def test_a_master_with_requests_or_a_new_one_holds_the_minimum(change: Json) -> None:
    status = {"idleSince": format_time(NOW - 9000), "masterEpoch": 1}
    assert plan_of(tried(status, minReplicas=2, **IDLE), running(1)).create == 0
    assert plan_of(tried(status, minReplicas=2, **{**IDLE, **change}), running(1)).create == 1
