"""The master's Lease: renewed, late, lost."""

from __future__ import annotations

import dataclasses
import queue
from collections.abc import Iterator
from pathlib import Path

import pytest

from fakes.kubernetes_api import Fault
from fiber._backends.kubernetes import fiber_pool
from fiber._backends.kubernetes.attached_pool import AttachedPool
from fiber._backends.kubernetes.fiber_pool import LeaseRenewer
from fiber.errors import FiberPoolError
from fiber_api import names
from fiber_api.rest import ApiError
from patience import PATIENCE
from unit.kubernetes_rig import MASTER, NAMESPACE, OTHER, Body, Rig, pool_body
from unit.kubernetes_rig import rig as make_rig

LEASE = names.master_lease_name("es-1")


class Case:
    """A renewer whose time is ``now``."""

    def __init__(self, rig: Rig, duration: int = 30) -> None:
        self.rig = rig
        self.now = 100.0
        self.lost: queue.Queue[FiberPoolError] = queue.Queue()
        self.troubles: queue.Queue[Exception] = queue.Queue()
        self.expiries: list[float] = []
        self.refusals: queue.Queue[Exception] = queue.Queue()
        self.faults: queue.Queue[Exception] = queue.Queue()
        master = dataclasses.replace(MASTER, lease_duration=duration)
        body = pool_body()
        body["spec"]["master"] = master.spec("es-1", 1)
        made = rig.server.do(rig.server.store.create, names.PLURAL, NAMESPACE, body)
        self.pool = AttachedPool(rig.api, made, master, 1)
        self.pool.make_lease()
        self.renewer = LeaseRenewer(
            self.pool,
            on_lost=self.lost.put,
            on_trouble=self.troubles.put,
            on_expired=self.expiries.append,
            on_refused=self.refusals.put,
            on_fault=self.faults.put,
            now=lambda: self.now,
        )

    def lease(self) -> Body:
        spec: Body = self.rig.get("leases", LEASE)["spec"]
        return spec


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    with make_rig(tmp_path, monkeypatch) as made:
        yield made


@pytest.fixture
def case(rig: Rig) -> Case:
    return Case(rig)


def test_the_lease_names_holder_start_and_duration(case: Case) -> None:
    before = case.lease()
    assert before["holderIdentity"] == MASTER.identity
    assert before["leaseDurationSeconds"] == 30
    assert before["acquireTime"] == before["renewTime"]
    case.renewer.renew()
    after = case.lease()
    assert after["renewTime"] > before["renewTime"]
    assert {**after, "renewTime": ""} == {**before, "renewTime": ""}


def test_the_lease_has_the_number_of_linked_agents(case: Case) -> None:
    def said() -> str:
        metadata = case.rig.get("leases", LEASE)["metadata"]
        return str(metadata["annotations"][names.ANNOTATION_CONNECTED])

    assert said() == "0"
    case.pool.connected = lambda: 12
    case.renewer.renew()
    assert said() == "12"


def test_a_renewal_in_time_is_one_call(case: Case) -> None:
    case.rig.server.api.calls.clear()
    case.now += 30
    case.renewer.renew()
    assert [(call.verb, call.plural) for call in case.rig.server.api.calls] == [("patch", "leases")]


def test_a_connection_that_breaks_once_is_made_again(case: Case) -> None:
    before = case.lease()
    case.rig.server.api.faults.append(Fault("patch", "leases"))
    case.renewer.renew()
    assert case.lease()["renewTime"] > before["renewTime"]


def test_a_deleted_lease_is_created_again(case: Case) -> None:
    case.rig.remove("leases", LEASE)
    case.renewer.renew()
    assert case.lease()["holderIdentity"] == MASTER.identity


def test_no_lease_is_created_for_a_deleted_pool(case: Case) -> None:
    case.rig.remove(names.PLURAL, "es-1")
    case.rig.server.api.calls.clear()
    with pytest.raises(FiberPoolError) as caught:
        case.renewer.renew()
    assert caught.value.reason == "Deleted"
    assert case.rig.server.api.count("create", "leases") == 0


def test_a_paused_program_renews_if_the_pool_has_waited(case: Case) -> None:
    case.now += 45
    case.renewer.renew()
    case.rig.server.api.calls.clear()
    case.now += 10
    case.renewer.renew()
    assert case.rig.server.api.count("get", names.PLURAL) == 0  # it is in time again


def test_a_paused_program_does_not_renew_anothers_lease(case: Case) -> None:
    patch = {"spec": {"master": OTHER.spec("es-1", 2)}}
    case.rig.server.do(case.rig.server.store.merge, names.PLURAL, NAMESPACE, "es-1", patch)
    before = case.lease()
    case.now += 45
    with pytest.raises(FiberPoolError, match="has another master now: laptop-8:4712"):
        case.renewer.renew()
    assert case.lease() == before


def test_a_loss_that_came_of_being_late_says_so(case: Case) -> None:
    loss = case.pool.loss(None)
    assert loss is not None
    assert case.renewer.explain(loss) is loss
    case.now += 45
    explained = case.renewer.explain(loss)
    assert "did not renew its Lease for 45 s" in str(explained)
    assert (explained.reason, explained.pool) == ("Deleted", "es-1")


def test_a_namesake_is_another_pool(case: Case) -> None:
    found = case.rig.pool()
    assert case.pool.loss(found) is None
    loss = case.pool.loss({**found, "metadata": {**found["metadata"], "uid": "another"}})
    assert loss is not None
    assert loss.reason == "Deleted"


def test_a_pool_that_is_being_deleted_is_lost(case: Case) -> None:
    found = case.rig.pool()
    going = {**found["metadata"], "deletionTimestamp": "2026-01-01T00:00:00Z"}
    loss = case.pool.loss({**found, "metadata": going})
    assert loss is not None
    assert loss.reason == "Deleted"


def test_a_failed_renewal_does_not_count(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fiber_pool, "_TIMEOUT", 0.0)
    case.rig.server.api.faults.append(Fault("patch", "leases", status=503))
    case.now += 20
    with pytest.raises(Exception, match="this is a test"):
        case.renewer.renew()
    case.now += 20
    case.rig.server.api.calls.clear()
    case.renewer.renew()
    assert case.rig.server.api.count("get", names.PLURAL) == 1


def test_a_lease_expires_once_in_each_duration_without_a_renewal(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fiber_pool, "_TIMEOUT", 0.0)
    fault = Fault("patch", "leases", status=503, times=float("inf"))
    case.rig.server.api.faults.append(fault)
    for seconds in (29, 1, 10, 20):
        case.now += seconds
        case.renewer._attempt()
        case.troubles.get_nowait()
    assert case.expiries == [30, 60]
    case.rig.server.api.faults.clear()
    case.renewer._attempt()
    case.rig.server.api.faults.append(fault)
    for seconds in (29, 1):
        case.now += seconds
        case.renewer._attempt()
        case.troubles.get_nowait()
    assert case.expiries == [30, 60, 30]


# -- The thread


def test_the_thread_renews_until_it_is_stopped(rig: Rig) -> None:
    case = Case(rig, duration=0)
    renewed: queue.Queue[str] = queue.Queue()
    rig.server.api.after = lambda call: renewed.put(call.plural)
    case.renewer.start()
    assert [renewed.get(timeout=PATIENCE) for _ in range(3)] == ["leases"] * 3
    case.renewer.stop()
    case.renewer.join(PATIENCE)
    assert case.troubles.empty()


def test_the_thread_ends_when_the_pool_is_lost(rig: Rig) -> None:
    case = Case(rig, duration=0)
    rig.remove(names.PLURAL, "es-1")
    case.now += 7
    case.renewer.start()
    assert "did not renew its Lease for 7 s" in str(case.lost.get(timeout=PATIENCE))
    case.renewer.join(PATIENCE)


def test_the_thread_reports_failed_renewals(rig: Rig) -> None:
    case = Case(rig, duration=0)
    rig.server.api.faults.append(Fault("patch", "leases", status=422))
    case.renewer.start()
    assert "this is a test" in str(case.troubles.get(timeout=PATIENCE))
    case.renewer.stop()
    case.renewer.join(PATIENCE)


def test_a_busy_api_server_is_asked_later_and_in_time(case: Case) -> None:
    for seconds, pause in ((7, 7), (25, 10)):  # after 25 s the Lease would be over
        fault = Fault("patch", "leases", status=429, retry_after=seconds)
        case.rig.server.api.faults.append(fault)
        assert case.renewer._attempt() == pause
        assert "this is a test" in str(case.troubles.get_nowait())


@pytest.mark.parametrize("status", [401, 403])
def test_a_login_or_right_that_stays_away_ends_the_thread(
    rig: Rig, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fiber_pool, "_RETRY", 0.01)
    case = Case(rig, duration=0)
    fault = Fault("patch", "leases", status=status, times=float("inf"))
    rig.server.api.faults.append(fault)
    case.renewer.start()
    assert "this is a test" in str(case.troubles.get(timeout=PATIENCE))
    case.now += 1
    assert "this is a test" in str(case.refusals.get(timeout=PATIENCE))
    case.renewer.join(PATIENCE)


def test_an_api_server_that_was_away_may_refuse_as_it_comes_back(case: Case) -> None:
    """Simulate an API server that has not read the roles yet."""
    case.now += 60
    case.rig.server.api.faults.append(Fault("patch", "leases", status=403, times=2))
    for _ in range(2):
        case.renewer._attempt()
        assert "this is a test" in str(case.troubles.get_nowait())
        case.now += 2
    case.renewer._attempt()
    assert case.troubles.empty()


def test_refusals_count_from_the_first_after_something_else(case: Case) -> None:
    statuses = (403, 422, 403, 403)
    case.rig.server.api.faults += [Fault("patch", "leases", status=each) for each in statuses]
    for _ in statuses[:-1]:
        case.renewer._attempt()
        assert "this is a test" in str(case.troubles.get_nowait())
        case.now += 25
    case.now += 10
    with pytest.raises(ApiError, match="this is a test"):
        case.renewer._attempt()


def test_an_internal_error_is_reported(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    case = Case(rig, duration=0)
    monkeypatch.setattr(case.renewer, "renew", lambda: 1 / 0)
    case.renewer.start()
    assert isinstance(case.faults.get(timeout=PATIENCE), ZeroDivisionError)
    case.renewer.join(PATIENCE)
