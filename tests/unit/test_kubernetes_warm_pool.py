"""A pool that somebody else keeps: attaching, a second master, leaving it as it was."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from census import wait_until
from fakes.kubernetes_api import Fault
from fiber._backends.kubernetes import fiber_pool
from fiber._backends.kubernetes.attached_pool import WarmPool
from fiber._backends.kubernetes.fiber_pool import FiberPoolClient
from fiber_api import names
from patience import PATIENCE
from unit.kubernetes_rig import CERTIFICATE, MASTER, NAMESPACE, OTHER, Body, Rig, Told, pool_body
from unit.kubernetes_rig import rig as make_rig
from warm_key import WarmKey

AT_ONCE = replace(MASTER, lease_duration=0)
"""A master whose Lease has expired when it is not renewed for the first time."""


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    with make_rig(tmp_path, monkeypatch) as made:
        body = pool_body("warm")
        body["spec"] |= {"minReplicas": 2, "replicas": 0, "scaleDown": {"policy": "Any"}}
        made.server.do(made.server.store.create, names.PLURAL, NAMESPACE, body)
        yield made


@pytest.fixture
def told() -> Told:
    return Told()


def spec(rig: Rig) -> Body:
    found: Body = rig.pool("warm")["spec"]
    return found


def owner_uid(rig: Rig) -> str:
    return str(rig.pool("warm")["metadata"]["uid"])


def has_master(rig: Rig, told: Told, epoch: int) -> None:
    told.wait(lambda: spec(rig).get("master", {}).get("epoch") == epoch)


def set_status(rig: Rig, **status: object) -> None:
    rig.server.do(rig.server.store.set_status, names.PLURAL, NAMESPACE, "warm", status)


def leave_master(rig: Rig, epoch: int = 4) -> None:
    """Another program wrote itself into the pool."""
    patch = {"spec": {"master": OTHER.spec("warm", epoch), "replicas": 9}}
    rig.server.do(rig.server.store.merge, names.PLURAL, NAMESPACE, "warm", patch)


def alive(value: str, since: str = "2026-01-01T00:00:00Z") -> list[Body]:
    return [{"type": "MasterAlive", "status": value, "lastTransitionTime": since}]


def test_attaching_and_leaving_it_as_it_was(rig: Rig, told: Told) -> None:
    before = spec(rig)
    client = rig.warm(told)
    client.demand(3, ["warm-a"])
    told.wait(lambda: spec(rig)["replicas"] == 3)
    assert spec(rig)["master"] == MASTER.spec("warm", 1)
    assert spec(rig)["scaleDown"] == {"policy": "Any", "release": ["warm-a"]}
    client.close()
    assert spec(rig) == before
    assert not told.errors


def test_a_lease_without_write_access_does_not_hold_the_pool(rig: Rig, told: Told) -> None:
    before = spec(rig)
    client = rig.warm(told)
    client.demand(3)
    told.wait(lambda: spec(rig)["replicas"] == 3)
    fault = Fault("patch", "leases", status=403, reason="Forbidden", times=99)
    rig.server.do(rig.server.api.faults.append, fault)
    client.close()
    assert spec(rig) == before


def test_the_lease_is_released_with_the_pool(rig: Rig, told: Told) -> None:
    client = rig.warm(told)
    client.demand(1)
    told.wait(lambda: spec(rig)["replicas"] == 1)
    lease = rig.get("leases", names.master_lease_name("warm"))
    assert lease["spec"]["holderIdentity"] == MASTER.identity
    assert lease["metadata"]["labels"][names.LABEL_POOL_UID] == owner_uid(rig)
    (owner,) = lease["metadata"]["ownerReferences"]
    assert owner["uid"] == owner_uid(rig)
    client.close()
    left = rig.get("leases", names.master_lease_name("warm"))
    assert left["spec"]["holderIdentity"] == ""


def test_the_next_master_has_a_higher_epoch_and_the_same_lease(rig: Rig, told: Told) -> None:
    first = rig.warm(told)
    first.demand(1)
    told.wait(lambda: spec(rig)["replicas"] == 1)
    first.close()
    again = Told()
    second = rig.warm(again, OTHER)
    second.demand(2)
    again.wait(lambda: spec(rig)["replicas"] == 2)
    assert spec(rig)["master"] == OTHER.spec("warm", 2)
    taken = rig.get("leases", names.master_lease_name("warm"))
    assert taken["spec"]["holderIdentity"] == OTHER.identity
    assert taken["spec"]["acquireTime"] == taken["spec"]["renewTime"]


def test_a_program_that_the_operator_does_not_sign_for_gets_the_reason(
    rig: Rig, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sign with another key than that of the status before."""
    monkeypatch.setattr(fiber_pool, "OPERATOR_SLOW", 0.0)
    credentials = WarmKey().unsigned(CERTIFICATE)
    attachment = WarmPool(rig.api, NAMESPACE, "warm", MASTER, credentials)
    client = FiberPoolClient(rig.api, rig.loop, attachment, told)
    client.start()
    assert wait_until(lambda: client._lacks == fiber_pool._NO_SIGNATURE, PATIENCE)
    monkeypatch.setattr(fiber_pool, "OPERATOR_ABSENT", 0.0)
    client.demand(1)
    error = told.error()
    client.close()
    assert error.reason == "NoOperator"
    assert "has no valid signature for this program" in str(error)
    assert not told.statuses
    assert not credentials.complete


def test_a_lease_without_the_label_gets_it(rig: Rig, told: Told) -> None:
    name = names.master_lease_name("warm")
    rig.server.do(rig.server.store.create, "leases", NAMESPACE, {"metadata": {"name": name}})
    client = rig.warm(told)
    client.demand(1)
    told.wait(lambda: spec(rig)["replicas"] == 1)
    lease = rig.get("leases", name)
    assert lease["metadata"]["labels"][names.LABEL_POOL_UID] == owner_uid(rig)
    assert lease["spec"]["holderIdentity"] == MASTER.identity


def test_a_second_master_learns_the_holder_and_its_start(rig: Rig, told: Told) -> None:
    first = rig.warm(told)
    first.demand(1)
    told.wait(lambda: spec(rig)["replicas"] == 1)
    lease = rig.get("leases", names.master_lease_name("warm"))
    second = Told()
    rig.warm(second, OTHER)
    error = second.error()
    assert error.reason == "InUse"
    assert MASTER.identity in str(error)
    assert f"since {lease['spec']['acquireTime']}" in str(error)
    assert spec(rig)["master"]["identity"] == MASTER.identity


def test_a_second_master_that_was_refused_leaves_the_first_alone(rig: Rig, told: Told) -> None:
    leave_master(rig)
    client = rig.warm(told)
    assert told.error().reason == "InUse"
    client.close()
    assert spec(rig)["master"]["identity"] == OTHER.identity


def test_a_master_that_is_lost_is_replaced_and_its_demand_forgotten(rig: Rig, told: Told) -> None:
    leave_master(rig)
    generation = rig.pool("warm")["metadata"]["generation"]
    set_status(rig, observedGeneration=generation, conditions=alive("False"), masterEpoch=4)
    client = rig.warm(told)
    has_master(rig, told, 5)
    assert client._attachment.displaced == OTHER.identity
    client.close()
    assert spec(rig)["replicas"] == 0


def test_statuses_of_an_earlier_master_do_not_count(rig: Rig, told: Told) -> None:
    set_status(rig, observedGeneration=1, conditions=alive("False"))
    leave_master(rig)
    rig.warm(told)
    assert told.error().reason == "InUse"


def test_the_epoch_is_above_that_of_all_masters_before(rig: Rig, told: Told) -> None:
    set_status(rig, observedGeneration=1, masterEpoch=7)
    rig.warm(told)
    has_master(rig, told, 8)


def test_one_of_two_programs_that_attach_at_the_same_time_is_refused(rig: Rig, told: Told) -> None:
    reads = 0

    def other_is_faster(call: object) -> None:
        nonlocal reads
        if getattr(call, "verb", "") == "get" and not reads:
            reads += 1
            patch = {"spec": {"master": OTHER.spec("warm", 1)}}
            rig.server.store.merge(names.PLURAL, NAMESPACE, "warm", patch)

    rig.server.api.after = other_is_faster
    rig.warm(told)
    assert told.error().reason == "InUse"
    assert spec(rig)["master"]["identity"] == OTHER.identity


def test_a_status_that_is_written_meanwhile_does_not_keep_it_out(rig: Rig, told: Told) -> None:
    looks = iter(range(3))

    def status_changes(call: object) -> None:
        if getattr(call, "verb", "") == "get" and (number := next(looks, None)) is not None:
            rig.server.store.set_status(names.PLURAL, NAMESPACE, "warm", {"replicas": number})

    rig.server.api.after = status_changes
    rig.warm(told)
    has_master(rig, told, 1)


def test_an_answer_to_attaching_that_is_lost(rig: Rig, told: Told) -> None:
    rig.server.api.faults.append(Fault("patch", names.PLURAL, carried_out=True))
    client = rig.warm(told)
    client.demand(2)
    told.wait(lambda: spec(rig)["replicas"] == 2)
    assert spec(rig)["master"]["epoch"] == 1
    client.close()
    assert "master" not in spec(rig)


def test_a_replaced_master_gets_an_error_and_leaves_its_successor_alone(
    rig: Rig, told: Told
) -> None:
    client = rig.warm(told)
    has_master(rig, told, 1)
    told.wait(lambda: told.statuses)
    leave_master(rig)
    error = told.error()
    assert error.reason == "Replaced"
    assert OTHER.identity in str(error)
    client.close()
    assert spec(rig)["master"]["identity"] == OTHER.identity


def test_a_master_whose_lease_expires_breaks_its_agents_connections(
    rig: Rig, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fiber_pool, "_TIMEOUT", 0.0)
    monkeypatch.setattr(fiber_pool, "_RETRY", 0.01)
    rig.warm(told, AT_ONCE)
    has_master(rig, told, 1)
    fault = Fault("patch", "leases", status=503, times=float("inf"))
    rig.server.do(rig.server.api.faults.append, fault)
    told.wait(lambda: len(told.expiries) > 1)
    said = [warning for warning in told.warnings if "may get another master" in warning]
    assert re.search(r"has not renewed its Lease for \d+ s", said[0])
    assert told.errors == []


def test_no_such_pool(rig: Rig, told: Told) -> None:
    rig.warm(told, name="cold")
    error = told.error()
    assert error.reason == "NotFound"
    assert "kubectl get fiberpools -n lab" in str(error)


def test_leftovers_are_named_with_the_command_that_detaches(
    rig: Rig, told: Told, capsys: pytest.CaptureFixture[str]
) -> None:
    client = rig.warm(told)
    has_master(rig, told, 1)
    told.wait(lambda: told.statuses)
    rig.server.api.down = True
    client.close(timeout=0.5)
    said = capsys.readouterr().err
    assert "kubectl patch fiberpool warm -n lab --type=merge" in said
    assert '{"spec": {"master": null, "replicas": 0}}' in said


def test_the_error_of_a_deleted_warm_pool_asks_its_owner_to_make_it_again(
    rig: Rig, told: Told
) -> None:
    rig.warm(told)
    has_master(rig, told, 1)
    rig.remove(names.PLURAL, "warm")
    error = told.error()
    assert error.reason == "Deleted"
    assert "Its owner has to make it again" in str(error)
    assert "begins anew" not in str(error)


def test_a_pool_taken_by_another_program_names_the_wait(rig: Rig, told: Told) -> None:
    rig.warm(told)
    has_master(rig, told, 1)
    leave_master(rig)
    assert "Wait until that program ends" in str(told.error())


def test_the_error_of_a_detached_program_says_that_it_can_attach_again(
    rig: Rig, told: Told
) -> None:
    rig.warm(told)
    has_master(rig, told, 1)
    patch = {"spec": {"master": None}}
    rig.server.do(rig.server.store.merge, names.PLURAL, NAMESPACE, "warm", patch)
    assert "attach to it again" in str(told.error())
