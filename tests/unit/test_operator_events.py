"""Events tell what is done and what is new; what stays as it is is not told again."""

from __future__ import annotations

from typing import Any

import pytest

from fiber_api.v1alpha1 import FiberPool
from fiber_operator.planning.plans import Plan
from unit.operator_objects import (
    MASTER,
    NOW,
    condition,
    ended,
    make_pool,
    name_of,
    of_template,
    plan_of,
    running,
    terminating,
    unschedulable,
    waiting,
    with_plan,
)

Json = dict[str, Any]


def look(pool: FiberPool, *pods: Json, now: float = NOW) -> tuple[Plan, FiberPool]:
    made = plan_of(pool, *pods, now=now)
    return made, with_plan(pool, made)


def reasons(made: Plan) -> list[str]:
    return [str(event.reason) for event in made.events]


def test_actions_are_reported() -> None:
    pool = make_pool(replicas=3, master=MASTER, scaleDown={"release": [name_of(1)]})
    made, _ = look(pool, running(1), of_template("older", waiting(2, "ErrImagePull")), running(3))
    assert [event.message for event in made.events[:3]] == [
        "Deleting workers that the master released",
        "Deleting workers of an older template",
        "Creating workers: more are wanted",
    ]


def test_a_problem_is_reported_when_it_comes_and_when_it_gets_worse() -> None:
    pool = make_pool(replicas=1)
    pod = waiting(1, "ErrImagePull", "manifest unknown")
    made, pool = look(pool, pod)
    assert reasons(made) == ["ImagePullError"]
    assert made.events[0].type == "Warning"
    made, pool = look(pool, pod, now=NOW + 1)
    assert made.events == ()
    made, pool = look(pool, waiting(1, "ImagePullBackOff", "manifest unknown"))
    assert reasons(made) == ["ImagePullError"]
    made, pool = look(pool, running(1))
    assert [(event.type, event.reason) for event in made.events] == [("Normal", "Recovered")]


def test_a_warning_that_passes_is_not_a_recovery() -> None:
    pool = make_pool(replicas=1)
    _, pool = look(pool, unschedulable(1))
    made, _ = look(pool, running(1))
    assert made.events == ()


def test_each_failure_is_reported_even_if_the_problem_stays() -> None:
    pool = make_pool(replicas=1)
    first, pool = look(pool, ended(1))
    assert reasons(first) == ["ContainerFailed"]
    again, pool = look(pool, ended(1), now=NOW + 1)
    assert again.events == ()
    second, pool = look(pool, ended(1), ended(2, ago=-2), now=NOW + 3)
    assert reasons(second) == ["ContainerFailed"]
    assert name_of(2) in second.events[0].message


@pytest.mark.parametrize("limit", [0, 6])
def test_output_of_a_worker_is_in_the_status_alone(limit: int) -> None:
    pool = make_pool(replicas=1, failurePolicy={"backoffLimit": limit})
    made, pool = look(pool, ended(1, message="password: 1234"))
    assert reasons(made)[-1] == "ContainerFailed"
    assert "password" in str(pool.status.problems)
    assert "password" not in str(made.events)


def test_the_event_of_a_disruption_leaves_out_the_message_of_the_worker() -> None:
    evicted = condition("DisruptionTarget", "True", reason="PreemptionByScheduler")
    made, _ = look(make_pool(replicas=1), ended(1, message="password: 1", conditions=[evicted]))
    assert "Disrupted" in reasons(made)
    assert "password" not in str(made.events)


def test_disruptions_are_reported_together() -> None:
    pool = make_pool(replicas=2)
    drained = condition("DisruptionTarget", "True", reason="EvictionByEvictionAPI")
    pods = [terminating(ended(number, conditions=[drained])) for number in (1, 2)]
    made, _ = look(pool, *pods, terminating(running(3)))
    (event,) = (event for event in made.events if event.reason == "Disrupted")
    assert event.message == (
        f"The cluster ended {name_of(2)} and 1 more: EvictionByEvictionAPI. "
        "A new worker replaces it at once"
    )


def test_a_master_that_comes_and_goes_is_reported() -> None:
    _, pool = look(make_pool(replicas=1, master=MASTER), running(1))
    left = pool.model_copy(update={"spec": pool.spec.model_copy(update={"master": None})})
    made, _ = look(left, running(1))
    assert reasons(made) == ["MasterChanged"]
    assert "has left" in made.events[0].message
