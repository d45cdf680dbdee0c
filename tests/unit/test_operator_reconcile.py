"""Creation and deletion of pods, case by case. The properties test what always holds."""

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
from fiber_operator.planning.manifests import spec_hash, template_hash
from fiber_operator.planning.plans import Knowledge, Plan, PodRefusal
from fiber_operator.planning.pods import PodState, Trouble
from fiber_operator.planning.reconcile import plan
from unit.operator_cluster_model import view
from unit.operator_objects import (
    MASTER,
    NOW,
    UID,
    condition,
    ended,
    knowledge_of,
    make_pool,
    name_of,
    of_template,
    plan_of,
    pod_document,
    running,
    terminating,
    unschedulable,
    views,
    waiting,
    with_plan,
)

Json = dict[str, Any]
LEASED = {**MASTER, "leaseName": "es", "lostGraceSeconds": 60}


def proven(pool: FiberPool, **status: Any) -> Json:
    """The status of a pool of whose template a worker was Ready."""
    failures = {"specHash": spec_hash(pool), **status.pop("failures", {})}
    return {"provenTemplateHash": template_hash(pool), "failures": failures, **status}


def tried(**spec: Any) -> FiberPool:
    """A pool whose template is known to work."""
    pool = make_pool(**spec)
    return make_pool(proven(pool), **spec)


def gone(made: Plan) -> list[str]:
    return [deletion.name for deletion in made.delete]


def why(made: Plan) -> set[str]:
    return {deletion.reason for deletion in made.delete}


def names(*numbers: int) -> list[str]:
    return [name_of(number) for number in numbers]


# -- Up


@pytest.mark.parametrize(
    ("spec", "wanted"),
    [
        ({}, 0),
        ({"minReplicas": 2}, 2),
        ({"replicas": 5}, 5),
        ({"replicas": 1, "minReplicas": 2}, 2),
        ({"replicas": 9, "maxReplicas": 4}, 4),
        ({"replicas": 9, "suspend": True}, 0),
    ],
)
def test_the_wanted_number_of_pods_within_the_bounds_is_created(spec: Json, wanted: int) -> None:
    assert plan_of(tried(**spec)).create == wanted


def test_only_live_pods_of_the_pool_count() -> None:
    pool = tried(replicas=3)
    foreign = running(3)
    foreign["metadata"]["ownerReferences"][0]["uid"] = "an earlier pool"
    evicted = ended(4, conditions=[condition("DisruptionTarget", "True")])
    made = plan_of(pool, running(1), terminating(running(2)), foreign, evicted)
    assert made.create == 2
    assert name_of(3) not in gone(made)


def test_a_template_is_tried_in_a_dry_run_first() -> None:
    pool = make_pool(replicas=3)
    first = plan_of(pool, accepted=None)
    assert (first.dry_run, first.create) == (True, 0)
    status = with_plan(pool, first).status
    (accepted,) = (c.status for c in status.conditions if c.type == "Accepted")
    assert (status.phase, accepted) == ("Pending", "Unknown")
    assert plan_of(pool).create == 3
    worked = tried(replicas=3)
    assert plan_of(worked, accepted=None).create == 3


def test_no_pod_is_created_without_an_address_or_with_an_obstacle() -> None:
    pool = tried(replicas=3)
    obstacle = plans.Obstacle(Reason.NAME_TAKEN, "taken")
    assert plan_of(pool, address=None).create == 0
    assert plan_of(pool, obstacles=(obstacle,)).create == 0


def test_a_refusal_is_tried_again_after_a_while() -> None:
    pool = tried(replicas=3)
    refused = PodRefusal(template_hash(pool), 403, "exceeded quota: q", NOW, count=4)
    first = plan_of(pool, refusal=refused)
    assert first.create == 0
    assert first.requeue_at is not None
    assert NOW + 25 < first.requeue_at <= NOW + 30
    assert plan_of(pool, refusal=refused, now=NOW + 31).create == 3
    other = PodRefusal("an older template", 422, "no", NOW)
    assert plan_of(pool, refusal=other).create == 3


# -- Down


def test_released_pods_go_for_any_replicas() -> None:
    pool = tried(replicas=3, master=MASTER, scaleDown={"release": [*names(1, 9), "another"]})
    made = plan_of(pool, running(1), running(2), running(3))
    assert gone(made) == names(1)
    assert made.delete[0].uid == "uid-1"
    assert made.delete[0].resource_version is None
    assert made.create == 1
    assert Reason.RELEASED in [event.reason for event in made.events]


def test_the_end_of_a_released_pod_is_no_failure() -> None:
    pool = tried(replicas=0, master=MASTER, scaleDown={"release": names(1, 2)})
    made = plan_of(pool, ended(1, code=1), terminating(running(2)))
    assert gone(made) == names(1)
    after = with_plan(pool, made).status.failures
    assert (after.total, after.disrupted) == (0, 0)


def test_lowered_replicas_delete_pods_that_do_not_run_yet_newest_first() -> None:
    """A worker that runs may have joined, though it was never Ready."""
    pool = tried(replicas=2, master=MASTER)
    pods = [running(1), running(2), running(3), running(4, age=9, ready=False)]
    made = plan_of(pool, *pods, pod_document(5, age=5), pod_document(6, age=2))
    assert gone(made) == names(6, 5)
    assert [deletion.resource_version for deletion in made.delete] == ["1006", "1005"]
    status = with_plan(pool, made).status
    (progressing,) = (c for c in status.conditions if c.type == "Progressing")
    assert (progressing.status, progressing.reason) == ("True", "Draining")
    made = plan_of(pool, *pods[:2], pod_document(5, age=5), pod_document(6, age=2), running(3))
    assert gone(made) == names(6, 5)


def test_without_a_master_any_worker_goes() -> None:
    pool = tried(replicas=1)
    made = plan_of(pool, running(1, age=100), running(2, age=50))
    assert gone(made) == names(2)
    assert why(made) == {Reason.SCALED_DOWN}
    conditions = with_plan(pool, made).status.conditions
    assert ("Progressing", "Deleting") in [(found.type, found.reason) for found in conditions]


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
        set(gone(plan_of(tried(replicas=replicas, **spec), *pods)))
        for replicas in (5, 4, 3, 2, 1, 0)
    ]
    taken = [sorted(after - before) for before, after in pairwise([set[str](), *order])]
    assert taken == [names(5), names(4), names(3), names(2), names(6), names(1)]


def test_suspending_deletes_everything_and_keeps_the_count() -> None:
    pool = tried(replicas=3, suspend=True, master=MASTER)
    made = plan_of(pool, running(1), pod_document(2), ended(3), terminating(running(4)))
    assert sorted(gone(made)) == names(1, 2, 3)
    assert why(made) == {Reason.SUSPENDED}
    status = with_plan(pool, made).status
    assert (status.phase, status.desired_replicas, status.failures.total) == ("Suspended", 0, 0)


def test_a_pool_that_is_being_deleted_is_left_to_kubernetes() -> None:
    pool = tried(replicas=3)
    metadata = pool.metadata.model_copy(update={"deletion_timestamp": NOW})
    pool = pool.model_copy(update={"metadata": metadata})
    made = plan_of(pool, running(1), ended(2))
    assert (made.create, made.delete, made.dry_run) == (0, (), False)
    assert with_plan(pool, made).status.phase == "Terminating"


# -- Templates


def outdated(*documents: Json) -> list[Json]:
    return [of_template("older", document) for document in documents]


def test_on_idle_leaves_ready_workers_to_their_master() -> None:
    pool = tried(replicas=2, master=MASTER)
    starting = running(3, age=9, ready=False)
    made = plan_of(pool, *outdated(running(1), waiting(2, "ErrImagePull"), starting))
    assert gone(made) == names(2)
    assert made.delete[0].resource_version is not None
    assert made.create == 0
    released = tried(replicas=2, master=MASTER, scaleDown={"release": names(1)})
    assert plan_of(released, *outdated(running(1)), running(3)).create == 1


def test_a_worker_of_an_unknown_template_is_not_outdated() -> None:
    pool = tried(replicas=1)
    (worker,) = views(pool, running(1))
    made = plan(pool, [replace(worker, template_hash="")], knowledge_of(pool), NOW)
    assert made.delete == ()
    assert with_plan(pool, made).status.updated_replicas == 1


def test_on_idle_replaces_a_warm_pool_a_quarter_at_a_time() -> None:
    pool = tried(replicas=8)
    old = outdated(*(running(number) for number in range(8)))
    first = plan_of(pool, *old)
    assert (len(first.delete), first.create) == (2, 2)
    assert why(first) == {Reason.REPLACED}
    half = [*old[:6], pod_document(8), pod_document(9)]
    assert plan_of(pool, *half).delete == ()
    assert len(plan_of(pool, *old[:6], running(8), pod_document(9)).delete) == 1


def test_recreate_replaces_all_at_once() -> None:
    pool = tried(replicas=2, master=MASTER, update={"strategy": "Recreate"})
    made = plan_of(pool, *outdated(running(1), running(2)))
    assert (gone(made), made.create) == (names(1, 2), 2)


def test_on_delete_replaces_deleted_pods() -> None:
    pool = tried(replicas=2, update={"strategy": "OnDelete"})
    made = plan_of(pool, *outdated(running(1), terminating(running(2))))
    assert (gone(made), made.create) == ([], 1)


@pytest.mark.parametrize("strategy", ["OnIdle", "Recreate"])
def test_a_refused_template_replaces_no_pod(strategy: str) -> None:
    pool = make_pool(replicas=2, update={"strategy": strategy})
    old = outdated(running(1), pod_document(2))
    assert plan_of(pool, *old, accepted=None).delete == ()
    refused = PodRefusal(template_hash(pool), 422, "spec.containers[0].image: Required value", NOW)
    made = plan_of(pool, *old, accepted=None, refusal=refused)
    assert (made.delete, made.dry_run) == ((), False)
    status = with_plan(pool, made).status
    assert status.phase == "Failed"
    assert status.problems[0].terminal
    assert "Required value" in status.problems[0].message
    assert plan_of(pool, *old, accepted=None, refusal=refused, now=NOW + 9).dry_run


# -- Ends


def test_a_disrupted_worker_is_replaced_at_once_and_not_counted() -> None:
    pool = tried(replicas=2)
    evicted = ended(1, code=137)
    evicted["status"] |= {"reason": "Evicted", "message": "low on memory"}
    made = plan_of(pool, evicted, running(2))
    assert (gone(made), made.create) == (names(1), 1)
    failures = with_plan(pool, made).status.failures
    assert (failures.consecutive, failures.total, failures.disrupted) == (0, 0, 1)
    (event,) = (event for event in made.events if event.reason == Reason.DISRUPTED)
    assert "low on memory" in event.message


def test_a_worker_that_a_user_deletes_is_replaced_at_once_and_not_counted() -> None:
    pool = tried(replicas=2)
    made = plan_of(pool, terminating(running(1)), running(2))
    assert made.create == 1
    assert with_plan(pool, made).status.failures == pool.status.failures


def test_only_the_places_of_workers_that_failed_wait() -> None:
    """Drained workers, and those that a new demand asks for, are none of these."""
    pool = tried(replicas=10)
    ready = [running(number) for number in range(3, 10)]
    made = plan_of(pool, ended(1), ended(2), terminating(running(10)), *ready)
    failures = with_plan(pool, made).status.failures
    assert (made.create, failures.waiting) == (1, 2)
    assert made.requeue_at == failures.next_create_time
    more = with_replicas(with_plan(pool, made), 14)
    assert plan_of(more, *ready, running(11), now=NOW + 1).create == 4
    fewer = with_replicas(more, 9)
    made = plan_of(fewer, *ready, running(11), now=NOW + 1)
    assert (made.create, with_plan(fewer, made).status.failures.waiting) == (0, 1)
    again = with_replicas(with_plan(fewer, made), 10)
    assert plan_of(again, *ready, running(11), now=NOW + 2).create == 1
    assert failures.next_create_time is not None
    assert plan_of(more, *ready, running(11), now=failures.next_create_time).create == 6


def test_fifty_of_a_hundred_drained_during_a_back_off_are_replaced_at_once() -> None:
    pool = tried(replicas=100)
    drained = condition("DisruptionTarget", "True", reason="EvictionByEvictionAPI")
    failures = {"waves": 5, "consecutive": 0, "waiting": 0, "nextCreateTime": format_time(NOW + 80)}
    failing = make_pool(proven(pool, failures=failures), replicas=100)
    pods = [running(number) for number in range(50)]
    pods += [terminating(ended(number, conditions=[drained])) for number in range(50, 100)]
    made = plan_of(failing, *pods)
    assert made.create == 50
    assert with_plan(failing, made).status.failures.disrupted == 50


def test_pods_that_never_came_do_not_add_to_failures_while_others_work() -> None:
    """A pool is given up for workers that fail, not for workers that never came."""
    failures = {"consecutive": 6, "waves": 6, "nextCreateTime": format_time(NOW - 1)}
    pool = tried(replicas=10)
    pool = make_pool(proven(pool, failures=failures), replicas=10)
    ready = [running(number, age=500) for number in (1, 2, 3)]
    homeless = [unschedulable(number) for number in range(5, 11)]
    made = with_plan(pool, plan_of(pool, *ready, ended(4), *homeless))
    assert made.status.failures.consecutive == 0
    refused = PodRefusal(template_hash(pool), 403, "exceeded quota: q", NOW - 1)
    made = with_plan(pool, plan_of(pool, *ready, ended(4), refusal=refused))
    assert made.status.failures.consecutive == 0
    assert with_plan(pool, plan_of(pool, *ready, ended(4))).status.failures.consecutive == 7


def with_replicas(pool: FiberPool, replicas: int) -> FiberPool:
    return pool.model_copy(update={"spec": pool.spec.model_copy(update={"replicas": replicas})})


def test_a_status_stays_small_whatever_happens_to_how_many() -> None:
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


def test_a_worker_that_ends_well_is_replaced_like_one_that_failed() -> None:
    pool = tried(replicas=1)
    made = plan_of(pool, ended(1, code=0, ran=100))
    assert (gone(made), made.create) == (names(1), 0)
    assert why(made) == {Reason.COMPLETED}
    status = with_plan(pool, made).status
    assert (status.failures.total, status.failures.waiting, status.problems) == (1, 1, ())
    assert status.failures.next_create_time is not None
    assert plan_of(with_plan(pool, made), now=status.failures.next_create_time).create == 1
    released = tried(replicas=0, master=MASTER, scaleDown={"release": names(1)})
    made = plan_of(released, ended(1, code=0, ran=100))
    assert with_plan(released, made).status.failures.total == 0


@pytest.mark.parametrize(
    ("grace", "ran", "completed"), [(5, 4, 1), (5, 3, 0), (0, 1, 1), (0, 0, 0), (60, 9, 0)]
)
def test_an_agent_whose_grace_is_short_has_not_failed_when_it_ends_soon(
    grace: int, ran: float, completed: int
) -> None:
    pool = tried(replicas=1, master={**MASTER, "lostGraceSeconds": grace})
    status = with_plan(pool, plan_of(pool, ended(1, code=0, ran=ran))).status
    assert (status.failures.total, status.failures.consecutive) == (1, 1 - completed)
    assert bool(status.problems) is not bool(completed)
    crash = with_plan(pool, plan_of(pool, ended(1, code=1, ran=ran))).status
    assert crash.failures.total == 1


def test_the_last_three_failed_pods_are_kept() -> None:
    pool = tried(replicas=0)
    pods = [ended(number, ago=number) for number in (1, 2, 3, 4, 5)]
    made = plan_of(pool, *pods)
    assert sorted(gone(made)) == names(4, 5)
    assert with_plan(pool, made).status.failures.total == 5
    assert plan_of(with_plan(pool, made), *pods[:3]).delete == ()


def test_a_failed_pod_whose_sidecar_goes_on_is_not_kept() -> None:
    document = ended(1, phase="Running")
    document["status"]["containerStatuses"].append({"name": "proxy", "state": {"running": {}}})
    assert gone(plan_of(tried(replicas=0), document)) == names(1)


def test_a_worker_that_does_not_get_ready_in_time_failed() -> None:
    policy = {"startupTimeoutSeconds": 60}
    pool = tried(replicas=1, failurePolicy=policy)
    late, in_time = running(1, age=61, ready=False), running(1, age=60, ready=False)
    early = plan_of(pool, in_time)
    assert (early.delete, early.requeue_at) == ((), NOW + 1)
    made = plan_of(pool, late)
    assert gone(made) == names(1)
    assert made.delete[0].resource_version is not None
    status = with_plan(pool, made).status
    assert (status.failures.total, status.failures.consecutive) == (1, 1)
    assert status.failures.last_reason == "StartupTimeout"
    assert status.problems[0].reason == "StartupTimeout"
    assert (made.create, made.inspect) == (0, (name_of(1),))
    later = with_plan(pool, plan_of(with_plan(pool, made), terminating(late), now=NOW + 1)).status
    assert later.failures.total == 1


# -- Masters


def lost(pool: FiberPool, ago: float) -> FiberPool:
    """The pool as the operator left it when it found the Lease expired."""
    alive = {"type": "MasterAlive", "status": "False", "lastTransitionTime": format_time(NOW - ago)}
    spec = pool.spec.model_dump(mode="json", by_alias=True)
    return make_pool(proven(pool, conditions=[alive], masterEpoch=1), **spec)


EXPIRED, UNKNOWN = plans.LeaseVerdict(alive=False), plans.LeaseVerdict(alive=None)


@pytest.mark.parametrize("on_lost", ["Delete", "ScaleToMin", "Retain"])
def test_a_lost_master_keeps_its_workers_for_its_grace(on_lost: str) -> None:
    pool = tried(replicas=3, master=LEASED, onLost=on_lost)
    made = plan_of(pool, running(1), running(2), master=EXPIRED)
    assert (made.delete, made.delete_pool, made.requeue_at) == ((), False, NOW + 60)
    assert made.create == (1 if on_lost == "Retain" else 0)
    status = with_plan(pool, made).status
    assert status.problems[0].reason == "MasterLost"
    assert status.phase == "Degraded"


def test_on_lost_decides_which_pods_outlive_a_lost_master() -> None:
    def after_grace(on_lost: str, lease: plans.LeaseVerdict = EXPIRED) -> Plan:
        pool = lost(make_pool(replicas=3, minReplicas=1, master=LEASED, onLost=on_lost), 60)
        return plan_of(pool, running(1), running(2, age=50), master=lease)

    assert after_grace("Delete").delete_pool
    assert gone(after_grace("ScaleToMin")) == names(2)
    retained = after_grace("Retain")
    assert (retained.delete, retained.create) == ((), 1)
    for on_lost in ("Delete", "ScaleToMin"):
        made = after_grace(on_lost, UNKNOWN)
        assert (made.delete_pool, made.delete, made.create) == (False, (), 0)


@pytest.mark.parametrize("ago", [-(10**9), 10**9, 2000])
def test_a_loss_at_a_time_that_cannot_be_shortens_no_grace(ago: float) -> None:
    """Somebody has edited the status; the pool is a thousand seconds old."""
    pool = lost(make_pool(replicas=1, master=LEASED, onLost="Delete"), ago)
    born = pool.metadata.model_copy(update={"creation_timestamp": NOW - 1000})
    pool = pool.model_copy(update={"metadata": born})
    made = plan_of(pool, running(1), master=EXPIRED)
    assert (made.delete_pool, made.requeue_at) == (False, NOW + 60)
    told = with_plan(pool, made)
    assert not plan_of(told, running(1), master=EXPIRED, now=NOW + 59).delete_pool
    assert plan_of(told, running(1), master=EXPIRED, now=NOW + 60).delete_pool


@pytest.mark.parametrize(
    "edit",
    [
        {"template": {"spec": {"containers": [{"name": "worker", "image": "corrected"}]}}},
        {"failurePolicy": {"backoffLimit": 9}},
        {"suspend": True},
        {"update": {"strategy": "Recreate"}},
    ],
)
def test_an_edit_while_the_master_is_lost_gives_it_no_time(edit: Json) -> None:
    pool = make_pool(replicas=2, master=LEASED, onLost="Delete")
    spec = lost(pool, ago=61).model_dump(mode="json", by_alias=True)
    pool = FiberPool.read({**spec, "spec": {**spec["spec"], **edit}})
    assert plan_of(pool, running(1), master=EXPIRED).delete_pool
    restarted = plan_of(pool, running(1), master=UNKNOWN)
    assert (restarted.delete_pool, restarted.create) == (False, 0)
    (alive,) = (c for c in with_plan(pool, restarted).status.conditions if c.type == "MasterAlive")
    assert (alive.status, alive.last_transition_time) == ("False", NOW - 61)


def test_a_new_master_ends_the_mourning() -> None:
    pool = lost(make_pool(replicas=2, master=LEASED), ago=30)
    back = pool.spec.model_copy(
        update={"master": pool.spec.master and pool.spec.master.model_copy(update={"epoch": 2})}
    )
    made = plan_of(pool.model_copy(update={"spec": back}), running(1), master=UNKNOWN)
    assert made.create == 1
    assert plan_of(pool, running(1), master=plans.LeaseVerdict(alive=True)).create == 1


def test_a_new_master_that_is_lost_too_has_a_grace_of_its_own() -> None:
    pool = lost(make_pool(replicas=2, master=LEASED, onLost="Delete"), ago=50)
    assert pool.spec.master
    newer = pool.spec.master.model_copy(update={"epoch": 2})
    pool = pool.model_copy(update={"spec": pool.spec.model_copy(update={"master": newer})})
    first = plan_of(pool, running(1), master=EXPIRED)
    assert (first.delete_pool, first.requeue_at) == (False, NOW + 60)
    pool = with_plan(pool, first)
    assert not plan_of(pool, running(1), master=EXPIRED, now=NOW + 59).delete_pool
    assert plan_of(pool, running(1), master=EXPIRED, now=NOW + 60).delete_pool


def test_a_new_master_is_announced() -> None:
    pool = tried(replicas=0, master={**MASTER, "epoch": 4})
    made = plan_of(pool)
    (event,) = (event for event in made.events if event.reason == Reason.MASTER_CHANGED)
    assert "10.0.3.7:41337" in event.message
    assert with_plan(pool, made).status.master_epoch == 4


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
    assert settled.metadata.uid == UID
