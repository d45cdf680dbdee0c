"""The status document: counts, conditions, phase, and that nothing in it moves by itself."""

from __future__ import annotations

from typing import Any

import pytest

from fiber_api.v1alpha1 import FiberPool, FiberPoolStatus
from fiber_operator.planning import plans
from fiber_operator.planning.manifests import template_hash
from fiber_operator.planning.pods import PodState
from fiber_operator.planning.reconcile import plan_unreadable
from unit.operator_cluster_model import view
from unit.operator_objects import (
    MASTER,
    NOW,
    UID,
    ended,
    make_pool,
    of_template,
    plan_of,
    pod_document,
    pool_document,
    running,
    status_of,
    terminating,
    views,
    with_plan,
)

Json = dict[str, Any]


def told(status: FiberPoolStatus) -> dict[str, tuple[str, str]]:
    return {found.type: (found.status, found.reason) for found in status.conditions}


def test_the_status_has_counts_addresses_and_the_selector() -> None:
    pool = make_pool(replicas=5, master={**MASTER, "epoch": 3})
    status = status_of(
        pool,
        running(1),
        of_template("older", running(2)),
        pod_document(3),
        terminating(running(4)),
        ended(5),
    )
    counts = (status.desired_replicas, status.replicas, status.ready_replicas)
    assert counts == (5, 3, 2)
    counts = (status.pending_replicas, status.terminating_replicas, status.updated_replicas)
    assert counts == (1, 1, 2)
    assert status.observed_generation == 7
    assert status.selector == f"fiber.dev/pool-uid={UID}"
    assert status.endpoint == "tls+tcp://10.96.1.2:7070"
    assert (status.master, status.master_epoch) == ("10.0.3.7:41337", 3)
    assert status.credentials_secret == "es-fiber-key"
    assert status.template_hash == template_hash(pool)


def test_the_highest_epoch_is_remembered_without_a_master() -> None:
    pool = make_pool({"masterEpoch": 5})
    status = status_of(pool)
    assert (status.master, status.master_epoch) == (None, 5)


def test_every_condition_is_there_once() -> None:
    found = told(status_of(make_pool(replicas=1), running(1)))
    assert found == {
        "Accepted": ("True", "AsExpected"),
        "Ready": ("True", "AsExpected"),
        "Progressing": ("False", "AsExpected"),
        "Degraded": ("False", "AsExpected"),
        "MasterAlive": ("Unknown", "NoMaster"),
        "ScalingLimited": ("False", "WithinBounds"),
        "Suspended": ("False", "NotSuspended"),
    }


@pytest.mark.parametrize(
    ("spec", "pods", "ready", "progressing", "phase"),
    [
        ({}, [], ("True", "ScaledToZero"), ("False", "AsExpected"), "Ready"),
        ({"replicas": 2}, [], ("False", "Creating"), ("True", "Creating"), "Scaling"),
        (
            {"replicas": 1},
            [pod_document(1)],
            ("False", "Starting"),
            ("True", "Starting"),
            "Scaling",
        ),
        (
            {"replicas": 1, "suspend": True},
            [terminating(running(1))],
            ("False", "Suspended"),
            ("True", "Deleting"),
            "Suspended",
        ),
        (
            {"replicas": 1, "master": MASTER},
            [running(1), running(2)],
            ("True", "AsExpected"),
            ("True", "Draining"),
            "Scaling",
        ),
        (
            {"replicas": 1, "master": MASTER},
            [of_template("older", running(1))],
            ("True", "AsExpected"),
            ("True", "Updating"),
            "Scaling",
        ),
        (
            {"replicas": 1},
            [ended(1)],
            ("False", "ContainerFailed"),
            ("True", "BackingOff"),
            "Degraded",
        ),
    ],
)
def test_readiness_progress_and_phase(
    spec: Json,
    pods: list[Json],
    ready: tuple[str, str],
    progressing: tuple[str, str],
    phase: str,
) -> None:
    status = status_of(make_pool(**spec), *pods)
    assert (told(status)["Ready"], told(status)["Progressing"]) == (ready, progressing)
    assert status.phase == phase


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ({"replicas": 9, "maxReplicas": 4}, ("True", "AboveMaximum")),
        ({"replicas": 1, "minReplicas": 2}, ("True", "BelowMinimum")),
        ({"minReplicas": 2}, ("False", "WithinBounds")),
    ],
)
def test_binding_bounds_are_reported(spec: Json, expected: tuple[str, str]) -> None:
    assert told(status_of(make_pool(**spec)))["ScalingLimited"] == expected


@pytest.mark.parametrize(
    ("alive", "expected"),
    [
        (True, ("True", "LeaseRenewed")),
        (False, ("False", "MasterLost")),
        (None, ("Unknown", "LeaseNotChecked")),
    ],
)
def test_the_master_is_alive_if_its_lease_is(alive: bool | None, expected: tuple[str, str]) -> None:
    pool = make_pool(master={**MASTER, "leaseName": "es"})
    status = status_of(pool, master=plans.LeaseVerdict(alive=alive))
    assert told(status)["MasterAlive"] == expected
    if alive is not None:
        again = status_of(pool.model_copy(update={"status": status}), master=plans.LeaseVerdict())
        assert told(again)["MasterAlive"] == expected


def test_a_condition_keeps_its_time_until_its_status_changes() -> None:
    pool = make_pool(replicas=1)
    first = with_plan(pool, plan_of(pool, pod_document(1)))
    second = with_plan(first, plan_of(first, running(1, age=1), now=NOW + 9))
    times = {found.type: found.last_transition_time for found in second.status.conditions}
    assert times["Accepted"] == NOW
    assert times["Ready"] == NOW + 9


def test_time_alone_changes_no_field() -> None:
    pool = make_pool(replicas=3)
    pods = [running(1), running(2), ended(3)]
    pool = with_plan(pool, plan_of(pool, *pods))
    assert plan_of(pool, *pods, now=NOW + 1.5).status is None


def test_the_secret_is_named_once_it_is_seen_to_be_the_pools() -> None:
    pool = make_pool()
    seen = with_plan(pool, plan_of(pool))
    assert seen.status.credentials_secret == "es-fiber-key"
    assert status_of(pool, credentials=None).credentials_secret is None
    assert status_of(seen, credentials=None).credentials_secret == "es-fiber-key"
    assert status_of(seen, credentials=False).credentials_secret is None


def test_a_damaged_status_is_written_anew() -> None:
    document = pool_document(
        with_plan(make_pool(), plan_of(make_pool())).status.model_dump(mode="json", by_alias=True)
    )
    assert plan_of(FiberPool.read(document)).status is None
    document["status"]["failures"]["total"] = "many"
    made = plan_of(FiberPool.read(document))
    assert made.status is not None
    assert made.status["failures"]["total"] == 0


def test_the_patch_of_a_status_removes_old_values() -> None:
    pool = make_pool(replicas=1)
    pool = with_plan(pool, plan_of(pool, ended(1)))
    assert pool.status.failures.next_create_time
    document = {**pool_document(replicas=0), "status": pool.status.model_dump(by_alias=True)}
    made = plan_of(FiberPool.read(document), now=NOW + 100)
    assert made.status is not None
    assert made.status["failures"]["nextCreateTime"] is None
    assert made.status["problems"] == []


def test_an_unreadable_spec_is_reported_and_counts_go_on() -> None:
    pool = make_pool(replicas=1, master=MASTER)
    document = pool_document(
        with_plan(pool, plan_of(pool, running(1))).status.model_dump(mode="json", by_alias=True)
    )
    document["spec"]["replicas"] = "three"
    pods = [*views(pool, running(1)), view(2, PodState.PENDING)]
    made = plan_unreadable(document, pods, ["spec.replicas: Input should be an integer"], NOW)
    assert made.status is not None
    status = FiberPoolStatus.model_validate(made.status)
    assert (status.phase, status.replicas, status.endpoint) == (
        "Failed",
        2,
        "tls+tcp://10.96.1.2:7070",
    )
    assert "spec.replicas" in status.problems[0].message
    assert told(status)["Accepted"] == ("False", "InvalidSpec")
    assert told(status)["Degraded"] == ("True", "InvalidSpec")
