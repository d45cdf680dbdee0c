"""The status document: counts, conditions, phase, and that nothing in it moves by itself."""

from __future__ import annotations

from typing import Any

import pytest

from fiber_api.signatures import is_signed, master_statement, pool_signer
from fiber_api.v1alpha1 import FiberPool, FiberPoolStatus
from fiber_operator.planning import plans
from fiber_operator.planning.manifests import template_hash
from fiber_operator.planning.plans import PoolSecret
from fiber_operator.planning.pods import PodState
from fiber_operator.planning.reconcile import plan_unreadable
from unit.operator_cluster_model import view
from unit.operator_objects import (
    MASTER,
    NOW,
    UID,
    edited,
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


def told(status: FiberPoolStatus) -> dict[str, str]:
    """Return the status and the reason of each condition."""
    return {found.type: f"{found.status} {found.reason}" for found in status.conditions}


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


# -- The signature for the master

CERTIFICATE = "c7" * 32
SIGNED = {**MASTER, "epoch": 3, "certificate": CERTIFICATE}
SIGNER = pool_signer("ab" * 32, UID)
WARM = PoolSecret(signer=SIGNER)


def is_valid(status: FiberPoolStatus, epoch: int = 3) -> bool:
    assert status.public_key
    assert status.master_signature
    statement = master_statement(epoch, bytes.fromhex(CERTIFICATE))
    key, signature = bytes.fromhex(status.public_key), bytes.fromhex(status.master_signature)
    return is_signed(key, statement, signature)


def test_the_master_of_a_warm_pool_gets_a_signature_for_its_epoch() -> None:
    status = status_of(make_pool(master=SIGNED), secret=WARM)
    assert is_valid(status)
    assert not is_valid(status, epoch=4)


def test_a_pool_without_a_master_has_its_public_key_alone() -> None:
    status = status_of(make_pool(), secret=WARM)
    assert status.public_key == SIGNER.public_key.hex()
    assert status.master_signature is None
    assert status_of(make_pool(master={**MASTER, "epoch": 3}), secret=WARM).master_signature is None


def test_a_pool_with_one_master_needs_no_signature() -> None:
    status = status_of(make_pool(master=SIGNED), secret=PoolSecret())
    assert (status.public_key, status.master_signature) == (None, None)


@pytest.mark.parametrize("knowledge", [{"secret": None}, {"secret": WARM, "led": False}])
def test_a_signature_stays_for_its_epoch_until_more_is_known(knowledge: dict[str, Any]) -> None:
    seen = with_plan(make_pool(master=SIGNED), plan_of(make_pool(master=SIGNED), secret=WARM))
    status = status_of(seen, **knowledge)
    assert is_valid(status)
    later = edited(seen, master={**SIGNED, "epoch": 4})
    status = status_of(later, **knowledge)
    assert status.master_signature is None
    assert status.public_key == SIGNER.public_key.hex()


# -- Conditions and the phase

AS_EXPECTED = {
    "Accepted": "True AsExpected",
    "Ready": "True AsExpected",
    "Progressing": "False AsExpected",
    "Degraded": "False AsExpected",
    "MasterAlive": "Unknown NoMaster",
    "ScalingLimited": "False WithinBounds",
    "Suspended": "False NotSuspended",
}
ONE, TWO = make_pool(replicas=1), make_pool(replicas=2)
ATTENDED = make_pool(replicas=1, master=MASTER)
LEASED = make_pool(replicas=1, master={**MASTER, "leaseName": "es"})
OLDER = of_template("older", running(1))


def seen(alive: bool | None, pool: FiberPool = LEASED, **fields: Any) -> FiberPool:
    """Return the pool with the status that follows from its master's Lease."""
    verdict = plans.LeaseVerdict(alive, **fields)
    return with_plan(pool, plan_of(pool, running(1), master=verdict))


def row(expected: str, pool: FiberPool, *pods: Json, **known: Any) -> Any:
    """Return a pool, its pods, what the operator knows, the phase and the changed conditions."""
    return pytest.param(pool, pods, known, expected, id=expected.replace("; ", ", "))


def lease(alive: bool | None, **fields: Any) -> plans.LeaseVerdict:
    return plans.LeaseVerdict(alive, **fields)


def refused(code: int, message: str) -> plans.PodRefusal:
    return plans.PodRefusal(template_hash(ONE), code, message, NOW)


QUOTA, INVALID = refused(403, "exceeded quota: q"), refused(422, "image: Required value")
UNCHECKED = "MasterAlive Unknown LeaseNotChecked"
LOST = "Degraded; MasterAlive False MasterLost; Degraded True MasterLost"
FAILED = "Ready False ContainerFailed; Progressing True BackingOff; Degraded True ContainerFailed"
STOPPED = "Ready False Suspended; Progressing True Deleting; Suspended True Suspended"
FULL = "Ready False QuotaExceeded; Progressing False QuotaExceeded; Degraded True QuotaExceeded"
WRONG = "Accepted False InvalidTemplate; Ready False InvalidTemplate; Degraded True InvalidTemplate"


@pytest.mark.parametrize(
    ("pool", "pods", "known", "expected"),
    [
        row("Ready", ONE, running(1)),
        row("Ready; Ready True ScaledToZero", make_pool()),
        row("Scaling; Ready False Creating; Progressing True Creating", TWO),
        row("Scaling; Ready False Starting; Progressing True Starting", ONE, pod_document(1)),
        row(f"Suspended; {STOPPED}", make_pool(replicas=1, suspend=True), terminating(running(1))),
        row("Scaling; Progressing True Deleting", ONE, running(1), running(2)),
        row(f"Scaling; Progressing True Draining; {UNCHECKED}", ATTENDED, running(1), running(2)),
        row(f"Scaling; Progressing True Updating; {UNCHECKED}", ATTENDED, OLDER),
        row(f"Degraded; {FAILED}", ONE, ended(1)),
        row("Pending; Accepted Unknown NotJudged; Ready False Creating", ONE, accepted=None),
        row(f"Degraded; {FULL}", ONE, refusal=QUOTA),
        row(f"Failed; {WRONG}; Progressing False InvalidTemplate", ONE, refusal=INVALID),
        row(
            "Ready; ScalingLimited True AboveMaximum",
            make_pool(replicas=9, maxReplicas=1),
            running(1),
        ),
        row(
            "Ready; ScalingLimited True BelowMinimum",
            make_pool(replicas=1, minReplicas=2),
            running(1),
            running(2),
        ),
        row("Ready; ScalingLimited False WithinBounds", make_pool(minReplicas=1), running(1)),
        row("Ready; MasterAlive True LeaseRenewed", LEASED, running(1), master=lease(True)),
        row(f"Ready; {UNCHECKED}", LEASED, running(1), master=lease(None)),
        row(
            "Ready; MasterAlive Unknown Forbidden",
            LEASED,
            running(1),
            master=lease(None, unreadable="no right"),
        ),
        row(
            "Ready; MasterAlive Unknown LeaseNotFound",
            LEASED,
            running(1),
            master=lease(None, missing=True),
        ),
        row(LOST, LEASED, running(1), master=lease(False)),
        # An operator that has just started goes by the status.
        row("Ready; MasterAlive True LeaseRenewed", seen(True), running(1), master=lease(None)),
        row(LOST, seen(False), running(1), master=lease(None)),
    ],
)
def test_each_condition_is_there_once_and_gives_the_phase(
    pool: FiberPool, pods: list[Json], known: Json, expected: str
) -> None:
    status = status_of(pool, *pods, **known)
    phase, *changed = expected.split("; ")
    conditions = dict(condition.split(" ", 1) for condition in changed)
    assert told(status) == {**AS_EXPECTED, **conditions}
    assert (status.phase, len(status.conditions)) == (phase, len(AS_EXPECTED))


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
    assert told(status)["Accepted"] == "False InvalidSpec"
    assert told(status)["Degraded"] == "True InvalidSpec"
