"""Plans: each row has a pool, its pods and what the operator knows, and the work that follows.

The properties test what holds for every plan.
"""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from fiber_api.names import Reason
from fiber_api.times import format_time
from fiber_api.v1alpha1 import FiberPool
from fiber_operator.planning import plans
from fiber_operator.planning.manifests import template_hash
from fiber_operator.planning.plans import Knowledge, Plan, PodRefusal
from fiber_operator.planning.pods import PodState, Trouble
from fiber_operator.planning.reconcile import plan
from unit.operator_cluster_model import view
from unit.operator_objects import (
    MASTER,
    NOW,
    condition,
    edited,
    ended,
    knowledge_of,
    make_pool,
    name_of,
    names,
    of_template,
    outdated,
    plan_of,
    pod_document,
    row,
    running,
    terminating,
    tried,
    unschedulable,
    views,
    waiting,
    with_plan,
    work_of,
)

Json = dict[str, Any]


def foreign(document: Json) -> Json:
    """Return the pod with another owner."""
    document["metadata"]["ownerReferences"][0]["uid"] = "an earlier pool"
    return document


def evicted(number: int) -> Json:
    pod = ended(number, code=137)
    pod["status"] |= {"reason": "Evicted", "message": "low on memory"}
    return pod


def deleted(pool: FiberPool) -> FiberPool:
    metadata = pool.metadata.model_copy(update={"deletion_timestamp": NOW})
    return pool.model_copy(update={"metadata": metadata})


def with_sidecar(pod: Json) -> Json:
    pod["status"]["containerStatuses"].append({"name": "proxy", "state": {"running": {}}})
    return pod


def attended(replicas: int, *released: int, **spec: Any) -> FiberPool:
    """Return a pool with a master that releases these workers, and a name that is none."""
    release = {"release": [*names(*released), "another"]}
    return tried(replicas=replicas, master=MASTER, scaleDown=release, **spec)


def updated(strategy: str, **spec: Any) -> FiberPool:
    return tried(replicas=2, update={"strategy": strategy}, **spec)


THREE, NEW = tried(replicas=3), make_pool(replicas=3)
TAKEN = plans.Obstacle(Reason.NAME_TAKEN, "taken")
FULL = PodRefusal(template_hash(THREE), 403, "exceeded quota: q", NOW, count=4)
LOOKED_UP = "error looking up service account team/default: not found"
NO_ACCOUNT = replace(FULL, message=f'pods "es-1" is forbidden: {LOOKED_UP}', dry_run=True)
PENDING = [pod_document(5, age=5), pod_document(6, age=2)]
STARTING = running(4, age=9, ready=False)
SILENT = ended(4, conditions=[condition("DisruptionTarget", "True")])
OLD = outdated(*map(running, range(8)))
EIGHT = tried(replicas=8)

UP = [
    *(
        row(f"wanted-{wanted}-{number}", f"+{wanted}", tried(**spec))
        for number, (spec, wanted) in enumerate(
            [
                ({}, 0),
                ({"minReplicas": 2}, 2),
                ({"replicas": 5}, 5),
                ({"replicas": 1, "minReplicas": 2}, 2),
                ({"replicas": 9, "maxReplicas": 4}, 4),
                ({"replicas": 9, "suspend": True}, 0),
            ]
        )
    ),
    row(
        "live-pods-of-the-pool-count",
        "-4 +2 Disrupted",
        THREE,
        running(1),
        terminating(running(2)),
        foreign(running(3)),
        SILENT,
    ),
    row("a-new-template", "+0 trial", NEW, accepted=None),
    row("an-accepted-template", "+3", NEW),
    row("a-template-that-worked", "+3", THREE, accepted=None),
    row("no-address", "+0", THREE, address=None),
    row("an-obstacle", "+0", THREE, obstacles=(TAKEN,)),
    row("a-refusal", "+0", THREE, refusal=FULL),
    row("a-refusal-31-s-ago", "+3", THREE, refusal=FULL, now=NOW + 31),
    row("a-refusal-of-another-template", "+3", THREE, refusal=replace(FULL, template_hash="older")),
    row("evicted", "-1 +1 Disrupted", tried(replicas=2), evicted(1), running(2)),
    row("deleted-by-a-user", "+1", tried(replicas=2), terminating(running(1)), running(2)),
]

DOWN = [
    row("released", "-1 +1 Released", attended(3, 1, 9), running(1), running(2), running(3)),
    row(
        "released-and-ended", "-1 +0 Released", attended(0, 1, 2), ended(1), terminating(running(2))
    ),
    # A worker that runs may have joined, though it was never Ready.
    row(
        "not-running-newest-first",
        "-6* -5* +0 ScaledDown",
        attended(2),
        running(1),
        running(2),
        running(3),
        STARTING,
        *PENDING,
    ),
    row(
        "not-running-as-many-as-are-surplus",
        "-6* +0 ScaledDown",
        attended(2),
        running(1),
        *PENDING,
    ),
    row("no-master", "-2 +0 ScaledDown", tried(replicas=1), running(1), running(2, age=50)),
    row(
        "suspended",
        "-1 -2 -3 +0 Suspended",
        attended(3, suspend=True),
        running(1),
        pod_document(2),
        ended(3),
        terminating(running(4)),
    ),
    row("left-to-kubernetes", "+0", deleted(THREE), running(1), ended(2)),
    row(
        "three-failed-pods-are-kept",
        "-4 -5 +0 ContainerFailed",
        tried(),
        *(ended(number, ago=number) for number in (1, 2, 3, 4, 5)),
    ),
    row(
        "a-failed-pod-with-a-sidecar",
        "-1 +0 ContainerFailed",
        tried(),
        with_sidecar(ended(1, phase="Running")),
    ),
]

REPLACED = [
    # The master decides when a Ready worker, or one that may have joined, goes.
    row(
        "on-idle",
        "-2* +0 Replaced",
        attended(2),
        *outdated(running(1), waiting(2, "ErrImagePull"), running(3, age=9, ready=False)),
    ),
    row("on-idle-released", "-1 +1 Released", attended(2, 1), *outdated(running(1)), running(3)),
    row("warm-pool", "-0 -1 +2 Replaced", EIGHT, *OLD),
    row("warm-pool-with-two-starting", "+0", EIGHT, *OLD[:6], pod_document(8), pod_document(9)),
    row(
        "warm-pool-with-one-starting",
        "-0 +1 Replaced",
        EIGHT,
        *OLD[:6],
        running(8),
        pod_document(9),
    ),
    row(
        "recreate",
        "-1 -2 +2 Replaced",
        updated("Recreate", master=MASTER),
        *outdated(running(1), running(2)),
    ),
    row("on-delete", "+1", updated("OnDelete"), *outdated(running(1), terminating(running(2)))),
]


@pytest.mark.parametrize(("pool", "pods", "known", "work"), [*UP, *DOWN, *REPLACED])
def test_a_plan_has_this_work(pool: FiberPool, pods: list[Json], known: Json, work: str) -> None:
    made = plan_of(pool, *pods, **known)
    assert work_of(made) == work
    assert all(deletion.uid == f"uid-{int(deletion.name[3:], 16)}" for deletion in made.delete)


@pytest.mark.parametrize(
    ("refusal", "earliest", "latest"),
    [(FULL, 25, 30), (NO_ACCOUNT, 0, 1)],
    ids=["quota", "account"],
)
def test_a_refusal_is_tried_again_after_a_while(
    refusal: PodRefusal, earliest: float, latest: float
) -> None:
    requeue_at = plan_of(THREE, refusal=refusal).requeue_at
    assert requeue_at is not None
    assert NOW + earliest < requeue_at <= NOW + latest


def test_policy_any_takes_those_that_cost_least() -> None:
    def costing(document: Json, cost: int) -> Json:
        key = "controller.kubernetes.io/pod-deletion-cost"
        document["metadata"]["annotations"] = {key: str(cost)}
        return document

    unready = running(3)
    unready["status"]["conditions"] = [condition("Ready", "False", ago=5)]
    pods = [
        running(1, age=300),
        costing(running(2), -5),
        unready,
        of_template("older", running(4)),
        pod_document(5, age=200),
        running(6, age=100),
    ]
    spec = {"scaleDown": {"policy": "Any"}, "master": MASTER, "update": {"strategy": "OnDelete"}}
    order = [
        {d.name for d in plan_of(tried(replicas=replicas, **spec), *pods).delete}
        for replicas in (5, 4, 3, 2, 1, 0)
    ]
    taken = [sorted(after - before) for before, after in pairwise([set[str](), *order])]
    assert taken == [names(5), names(4), names(3), names(2), names(6), names(1)]


def test_a_worker_of_an_unknown_template_is_not_outdated() -> None:
    pool = tried(replicas=1)
    (worker,) = views(pool, running(1))
    made = plan(pool, [replace(worker, template_hash="")], knowledge_of(pool), NOW)
    assert made.delete == ()
    assert with_plan(pool, made).status.updated_replicas == 1


@pytest.mark.parametrize("strategy", ["OnIdle", "Recreate"])
def test_a_refused_template_replaces_no_pod(strategy: str) -> None:
    pool = make_pool(replicas=2, update={"strategy": strategy})
    old = outdated(running(1), pod_document(2))
    assert plan_of(pool, *old, accepted=None).delete == ()
    refused = PodRefusal(template_hash(pool), 422, "spec.containers[0].image: Required value", NOW)
    known: Json = {"accepted": None, "refusal": refused}
    assert work_of(plan_of(pool, *old, **known)) == "+0"
    assert work_of(plan_of(pool, *old, **known, now=NOW + 9)) == "+0 trial"


# -- Failures


def failures_of(pool: FiberPool, *pods: Json, **known: Any) -> tuple[int, int, int]:
    """Return how many failed, in a row and in total, and how many the cluster ended."""
    found = with_plan(pool, plan_of(pool, *pods, **known)).status.failures
    return found.consecutive, found.total, found.disrupted


COUNTED = {"consecutive": 6, "waves": 6, "nextCreateTime": format_time(NOW - 1)}
TIRED = tried({"failures": COUNTED}, replicas=10)
LONG_READY = [running(number, age=500) for number in (1, 2, 3)]
HOMELESS = [unschedulable(number) for number in range(5, 11)]
DRAINED = condition("DisruptionTarget", "True", reason="EvictionByEvictionAPI")
WAVES = {"waves": 5, "consecutive": 0, "waiting": 0, "nextCreateTime": format_time(NOW + 80)}


@pytest.mark.parametrize(
    ("pool", "pods", "known", "counted"),
    [
        (tried(replicas=1), [ended(1)], {}, (1, 1, 0)),
        (tried(replicas=2), [ended(1), running(2)], {}, (0, 1, 0)),
        (tried(replicas=2), [evicted(1), running(2)], {}, (0, 0, 1)),
        (tried(replicas=2), [terminating(running(1)), running(2)], {}, (0, 0, 0)),
        (attended(0, 1, 2), [ended(1), terminating(running(2))], {}, (0, 0, 0)),
        (attended(0, 1), [ended(1, code=0, ran=100)], {}, (0, 0, 0)),
        (attended(3, suspend=True), [ended(3)], {}, (0, 0, 0)),
        (tried(), [ended(number, ago=number) for number in range(1, 6)], {}, (1, 5, 0)),
        # Workers that never came do not count against those that work.
        (TIRED, [*LONG_READY, ended(4), *HOMELESS], {}, (0, 1, 0)),
        (
            TIRED,
            [*LONG_READY, ended(4)],
            {"refusal": PodRefusal(template_hash(TIRED), 403, "exceeded quota: q", NOW - 1)},
            (0, 1, 0),
        ),
        (TIRED, [*LONG_READY, ended(4)], {}, (7, 1, 0)),
        *(
            (
                tried(replicas=1, master={**MASTER, "lostGraceSeconds": grace}),
                [ended(1, code=code, ran=ran)],
                {},
                (consecutive, 1, 0),
            )
            # An agent whose master is lost ends with 0 after its grace period.
            for grace, ran, code, consecutive in [
                (5, 4, 0, 0),
                (5, 3, 0, 1),
                (0, 1, 0, 0),
                (0, 0, 0, 1),
                (60, 9, 0, 1),
                (5, 4, 1, 1),
            ]
        ),
    ],
)
def test_failures_are_counted(
    pool: FiberPool, pods: list[Json], known: Json, counted: tuple[int, int, int]
) -> None:
    assert failures_of(pool, *pods, **known) == counted


def test_a_disrupted_worker_is_reported_with_its_reason() -> None:
    made = plan_of(tried(replicas=2), evicted(1), running(2))
    (event,) = (event for event in made.events if event.reason == Reason.DISRUPTED)
    assert "low on memory" in event.message


def test_the_places_of_workers_that_failed_wait_alone() -> None:
    """Drained workers are replaced, and a new demand is met, at once."""
    pool = tried(replicas=10)
    ready = [running(number) for number in range(3, 10)]
    made = plan_of(pool, ended(1), ended(2), terminating(running(10)), *ready)
    failures = with_plan(pool, made).status.failures
    assert (made.create, failures.waiting) == (1, 2)
    assert made.requeue_at == failures.next_create_time
    more = edited(with_plan(pool, made), replicas=14)
    assert plan_of(more, *ready, running(11), now=NOW + 1).create == 4
    fewer = edited(more, replicas=9)
    made = plan_of(fewer, *ready, running(11), now=NOW + 1)
    assert (made.create, with_plan(fewer, made).status.failures.waiting) == (0, 1)
    again = edited(with_plan(fewer, made), replicas=10)
    assert plan_of(again, *ready, running(11), now=NOW + 2).create == 1
    assert failures.next_create_time is not None
    assert plan_of(more, *ready, running(11), now=failures.next_create_time).create == 6


def test_fifty_of_a_hundred_drained_during_a_back_off_are_replaced_at_once() -> None:
    pool = tried({"failures": WAVES}, replicas=100)
    pods = [running(number) for number in range(50)]
    pods += [terminating(ended(number, conditions=[DRAINED])) for number in range(50, 100)]
    assert plan_of(pool, *pods).create == 50
    assert failures_of(pool, *pods)[2] == 50


def test_the_status_of_6000_pods_stays_small() -> None:
    pool = tried(replicas=6000, maxReplicas=6000)
    workers = [view(number, PodState.READY, template_hash="older") for number in range(6000)]
    knowledge = knowledge_of(pool)
    for pods in (
        workers,
        [replace(pod, state=PodState.TERMINATING) for pod in workers],
        [
            replace(pod, state=PodState.ENDED, trouble=Trouble.APPLICATION, message="x" * 1000)
            for pod in workers
        ],
    ):
        for spec in (pool.spec, pool.spec.model_copy(update={"suspend": True})):
            made = plan(pool.model_copy(update={"spec": spec}), pods, knowledge, NOW)
            assert made.status is not None
            assert len(json.dumps(made.status)) < 40_000


def test_a_worker_that_ends_well_is_replaced_after_a_while() -> None:
    pool = tried(replicas=1)
    made = plan_of(pool, ended(1, code=0, ran=100))
    assert work_of(made) == "-1 +0 Completed"
    pool = with_plan(pool, made)
    assert (pool.status.failures.waiting, pool.status.problems) == (1, ())
    assert pool.status.failures.next_create_time is not None
    assert plan_of(pool, now=pool.status.failures.next_create_time).create == 1


def test_kept_pods_that_failed_stay_until_a_newer_one_fails() -> None:
    pool, pods = tried(), [ended(number, ago=number) for number in (1, 2, 3, 4, 5)]
    assert plan_of(with_plan(pool, plan_of(pool, *pods)), *pods[:3]).delete == ()


def test_a_worker_that_does_not_get_ready_in_time_failed() -> None:
    policy = {"startupTimeoutSeconds": 60}
    pool = tried(replicas=1, failurePolicy=policy)
    late, in_time = running(1, age=61, ready=False), running(1, age=60, ready=False)
    early = plan_of(pool, in_time)
    assert (early.delete, early.requeue_at) == ((), NOW + 1)
    made = plan_of(pool, late)
    assert work_of(made) == "-1* +0 StartupTimeout"
    status = with_plan(pool, made).status
    assert (status.failures.total, status.failures.consecutive) == (1, 1)
    assert status.failures.last_reason == "StartupTimeout"
    assert status.problems[0].reason == "StartupTimeout"
    assert made.inspect == (name_of(1),)
    later = with_plan(pool, plan_of(with_plan(pool, made), terminating(late), now=NOW + 1)).status
    assert later.failures.total == 1


# -- Looking again


def test_events_are_asked_for_where_the_status_of_a_pod_is_silent() -> None:
    pool = tried(replicas=3)
    young, old = waiting(1, "ContainerCreating", age=3), waiting(2, "ContainerCreating", age=8)
    told = waiting(3, "ErrImagePull", age=9)
    assert plan_of(pool, young, told).inspect == ()
    made = plan_of(pool, young, old, told)
    assert (made.inspect, made.requeue_at) == ((name_of(2),), NOW + 2)
    assert plan_of(pool, old, now=NOW + 2).requeue_at == NOW + 12


def test_a_settled_pool_is_left_alone() -> None:
    pool = tried(replicas=2)
    pods = [running(1), running(2)]
    settled = with_plan(pool, plan_of(pool, *pods))
    assert plan_of(settled, *pods, now=NOW + 3600) == Plan(
        batch_limit=200, template_hash=template_hash(pool)
    )
    assert plan(settled, views(pool, *pods), Knowledge(), NOW).status is None
