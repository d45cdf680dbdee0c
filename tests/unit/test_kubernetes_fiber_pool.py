"""A pool that a program makes: its birth, what is wanted of it, what goes wrong, its end."""

from __future__ import annotations

import base64
import math
import queue
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fakes.kubernetes_api import Call, Fault
from fakes.rights import FiberUser
from fakes.store import Failure
from fiber._backends.kubernetes import fiber_pool, informer
from fiber._backends.kubernetes.fiber_pool import FiberPoolClient
from fiber_api import identity, names
from fiber_api.rest import Forbidden
from patience import PATIENCE
from unit.kubernetes_rig import CERTIFICATE, MASTER, NAMESPACE, OTHER, Body, Rig, Told
from unit.kubernetes_rig import rig as make_rig


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    with make_rig(tmp_path, monkeypatch) as made:
        yield made


@pytest.fixture
def told() -> Told:
    return Told()


def changes(rig: Rig) -> list[tuple[str, str]]:
    """Return the calls that change something."""
    calls = (call for call in rig.server.api.calls if call.verb not in ("get", "list", "watch"))
    return [(call.verb, call.plural) for call in calls]


def on(rig: Rig, verb: str, plural: str, act: object) -> None:
    """Call ``act`` on the server's thread after each such call."""
    before = rig.server.api.after

    def after(call: Call) -> None:
        before(call)
        if (call.verb, call.plural) == (verb, plural):
            act()  # type: ignore[operator]

    rig.server.api.after = after


def replicas_become(rig: Rig, told: Told, number: int, name: str = "es-1") -> None:
    """Wait; the operator's word of each change is what the observer is told."""
    told.wait(lambda: rig.spec(name).get("replicas") == number)


# -- Birth


def test_a_pool_is_born_with_its_master_and_without_pods(rig: Rig, told: Told) -> None:
    seen: list[Body] = []
    on(rig, "create", names.PLURAL, lambda: seen.append(rig.server.store.list(names.PLURAL)[0]))
    rig.own(told).demand(3)
    replicas_become(rig, told, 3)
    (born,) = seen
    assert born["spec"]["replicas"] == 0
    assert born["spec"]["onLost"] == "Delete"
    assert born["spec"]["credentialsSecretName"] == names.secret_name("es-1")
    assert born["spec"]["master"] == {
        "host": "10.0.0.7",
        "port": 41337,
        "epoch": 1,
        "identity": "laptop-7:4711",
        "certificate": CERTIFICATE.hash.hex(),
        "leaseName": names.master_lease_name("es-1"),
        "leaseDurationSeconds": 30,
        "lostGraceSeconds": 60,
    }
    assert changes(rig) == [
        ("create", names.PLURAL),
        ("create", "secrets"),
        ("create", "leases"),
        ("patch", names.PLURAL),
    ]


def test_objects_of_a_pool_are_deleted_with_it(rig: Rig, told: Told) -> None:
    rig.own(told).demand(1)
    replicas_become(rig, told, 1)
    uid = rig.pool()["metadata"]["uid"]
    for plural, name in (
        ("secrets", names.secret_name("es-1")),
        ("leases", names.master_lease_name("es-1")),
    ):
        (owner,) = rig.get(plural, name)["metadata"]["ownerReferences"]
        assert owner == {
            "apiVersion": names.API_VERSION,
            "kind": names.KIND,
            "name": "es-1",
            "uid": uid,
        }


@pytest.mark.parametrize("readable", [True, False], ids=["readable", "forbidden"])
@pytest.mark.parametrize("plural", ["secrets", "leases"])
def test_an_object_of_another_owner_is_not_taken_for_the_pools(
    rig: Rig, told: Told, plural: str, readable: bool
) -> None:
    """The role fiber-user reads no Secret."""
    if not readable:
        rig.server.api.faults.append(Fault("get", plural, 403, reason="Forbidden"))
    name = names.secret_name("es-1") if plural == "secrets" else names.master_lease_name("es-1")
    other = {"metadata": {"name": name}, "data": {}, "spec": {"holderIdentity": "other"}}
    rig.server.do(rig.server.store.create, plural, NAMESPACE, other)
    client = rig.own(told)
    assert told.error().reason == "AlreadyExists"
    client.close()
    assert not rig.server.objects(names.PLURAL)


def test_a_lease_that_was_there_before_is_not_taken_for_the_pools(rig: Rig, told: Told) -> None:
    """A neighbour may read in the pool which holder the Lease will have."""
    name = names.master_lease_name("es-1")
    forged = {"metadata": {"name": name}, "spec": {"holderIdentity": MASTER.identity}}
    rig.server.do(rig.server.store.create, "leases", NAMESPACE, forged)
    rig.own(told)
    assert told.error().reason == "AlreadyExists"


@pytest.mark.parametrize("there", [True, False], ids=["anothers", "own"])
def test_a_secret_of_an_unknown_maker_is_not_used(rig: Rig, told: Told, there: bool) -> None:
    """An attempt has no answer, and fiber-user may not read whose Secret is there then."""
    rig.server.api.allows = FiberUser(NAMESPACE).allow
    name = names.secret_name("es-1")
    if there:
        other = {"metadata": {"name": name}, "data": {"key": "b3RoZXI="}}
        rig.server.do(rig.server.store.create, "secrets", NAMESPACE, other)
    rig.server.api.faults.append(Fault("create", "secrets", carried_out=not there))
    rig.own(told).demand(1)
    replicas_become(rig, told, 1)
    assert not told.errors
    used = rig.spec()["credentialsSecretName"]
    assert used != name
    secret = rig.get("secrets", used)
    assert set(secret["data"]) == {names.KEY_POOL, names.KEY_MASTER}
    assert secret["metadata"]["ownerReferences"][0]["uid"] == rig.pool()["metadata"]["uid"]
    left = {secret["metadata"]["name"] for secret in rig.server.objects("secrets")} - {used}
    assert left == ({name} if there else set())


def test_a_lease_that_came_before_an_attempt_without_an_answer_is_not_the_pools(
    rig: Rig, told: Told
) -> None:
    """A neighbour may read in the pool which holder the Lease will have."""
    rig.server.api.allows = FiberUser(NAMESPACE).allow
    name = names.master_lease_name("es-1")
    holder = {"holderIdentity": MASTER.identity, "acquireTime": "2026-01-01T00:00:00.000000Z"}
    forged = {"metadata": {"name": name}, "spec": holder}
    rig.server.do(rig.server.store.create, "leases", NAMESPACE, forged)
    rig.server.api.faults.append(Fault("create", "leases"))
    rig.own(told)
    assert told.error().reason == "AlreadyExists"


def test_another_pool_is_not_deleted_after_attempts_without_an_answer(rig: Rig, told: Told) -> None:
    rig.server.api.allows = FiberUser(NAMESPACE).allow
    other = {"metadata": {"name": "es-1"}, "spec": {"master": OTHER.spec("es-1", 1)}}
    rig.server.do(rig.server.store.create, names.PLURAL, NAMESPACE, other)
    tried = threading.Event()
    on(rig, "create", names.PLURAL, tried.set)
    rig.server.api.faults.append(Fault("create", names.PLURAL, carried_out=True, times=math.inf))
    client = rig.own(told)
    assert tried.wait(PATIENCE)
    client.close()
    assert rig.spec()["master"]["identity"] == OTHER.identity


@pytest.mark.parametrize("plural", ["secrets", "leases"])
def test_objects_of_a_pool_have_its_labels(rig: Rig, told: Told, plural: str) -> None:
    rig.own(told).demand(1)
    replicas_become(rig, told, 1)
    name = names.secret_name("es-1") if plural == "secrets" else names.master_lease_name("es-1")
    labels = rig.get(plural, name)["metadata"]["labels"]
    assert labels[names.LABEL_POOL] == "es-1"
    assert labels[names.LABEL_POOL_UID] == rig.pool()["metadata"]["uid"]


def test_the_secret_holds_no_private_key_of_a_master(rig: Rig, told: Told) -> None:
    rig.own(told).demand(1)
    replicas_become(rig, told, 1)
    data = rig.get("secrets", names.secret_name("es-1"))["data"]
    assert set(data) == {names.KEY_POOL, names.KEY_MASTER}
    assert identity.key_in(data)
    assert len(base64.b64decode(data[names.KEY_MASTER])) == 64, "its certificate's fingerprint"


def test_in_a_pod_the_pool_is_owned_by_it(rig: Rig, told: Told) -> None:
    owner = {"apiVersion": "v1", "kind": "Pod", "name": "notebook", "uid": "123"}
    rig.own(told, owner=owner).demand(1)
    replicas_become(rig, told, 1)
    assert rig.pool()["metadata"]["ownerReferences"] == [owner]


@pytest.mark.parametrize("plural", [names.PLURAL, "secrets", "leases"])
def test_an_answer_that_is_lost_while_it_is_born(rig: Rig, told: Told, plural: str) -> None:
    rig.server.api.allows = FiberUser(NAMESPACE).allow
    rig.server.api.faults.append(Fault("create", plural, carried_out=True))
    rig.own(told).demand(2)
    replicas_become(rig, told, 2)
    assert not told.errors


def test_the_name_of_another_programs_pool_is_refused(rig: Rig, told: Told) -> None:
    other = {"metadata": {"name": "es-1"}, "spec": {"master": OTHER.spec("es-1", 1)}}
    rig.server.do(rig.server.store.create, names.PLURAL, NAMESPACE, other)
    client = rig.own(told)
    assert told.error().reason == "AlreadyExists"
    client.close()
    assert rig.spec()["master"]["identity"] == OTHER.identity


# -- Demand


def test_only_the_newest_demand_is_written(rig: Rig, told: Told) -> None:
    own: Future[FiberPoolClient] = Future()  # The client may create its lease at once.
    on(rig, "create", "leases", lambda: list(map(own.result(PATIENCE).demand, (1, 2, 3))))
    own.set_result(rig.own(told))
    replicas_become(rig, told, 3)
    assert rig.server.api.count("patch", names.PLURAL) == 1


@pytest.mark.slow
def test_a_demand_is_written_until_it_holds(
    rig: Rig, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fiber_pool, "_TIMEOUT", 0.0)
    rig.server.api.faults.append(Fault("patch", names.PLURAL, status=503, times=3))
    rig.own(told).demand(4)
    replicas_become(rig, told, 4)
    assert not told.errors
    assert "cannot scale the FiberPool 'es-1'" in told.warnings[0]
    assert "HTTP status 503" in told.warnings[0]


def test_names_to_release_are_written_until_their_pods_are_gone(
    rig: Rig, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fiber_pool, "PATCH_INTERVAL", 0.01)
    client = rig.own(told)
    client.demand(2)
    replicas_become(rig, told, 2)
    rig.add_pod("es-1-a")
    rig.add_pod("es-1-b")
    told.wait(lambda: len(told.pods) == 2)
    client.demand(1, ["es-1-a"])
    replicas_become(rig, told, 1)
    assert rig.spec()["scaleDown"]["release"] == ["es-1-a"]
    rig.remove("pods", "es-1-a")
    told.wait(lambda: ("es-1-a", None) in told.pods)
    client.demand(0, ["es-1-b"])
    replicas_become(rig, told, 0)
    assert rig.spec()["scaleDown"]["release"] == ["es-1-b"]


# -- Notices


def test_a_fiber_pool_client_reports_status_and_pods(rig: Rig, told: Told) -> None:
    rig.own(told).demand(1)
    replicas_become(rig, told, 1)
    status = {"observedGeneration": 9, "phase": "Ready"}
    rig.server.do(rig.server.store.set_status, names.PLURAL, NAMESPACE, "es-1", status)
    told.wait(lambda: status in told.statuses)
    rig.add_pod("es-1-a")
    told.wait(lambda: told.pods)
    name, pod = told.pods[0]
    assert (name, pod and pod["metadata"]["name"]) == ("es-1-a", "es-1-a")


def test_pods_of_other_pools_are_ignored(rig: Rig, told: Told) -> None:
    rig.own(told).demand(1)
    replicas_become(rig, told, 1)
    others = {"metadata": {"name": "x", "labels": {names.LABEL_POOL_UID: "another"}}, "spec": {}}
    rig.server.do(rig.server.store.create, "pods", NAMESPACE, others)
    rig.add_pod("es-1-a")
    told.wait(lambda: told.pods)
    assert [name for name, _ in told.pods] == ["es-1-a"]


def test_the_deletion_of_a_pool_is_an_error(rig: Rig, told: Told) -> None:
    rig.own(told).demand(1)
    replicas_become(rig, told, 1)
    rig.remove(names.PLURAL, "es-1")
    error = told.error()
    assert (error.reason, error.pool, error.namespace) == ("Deleted", "es-1", NAMESPACE)
    assert "was deleted" in str(error)


# -- What keeps it waiting


def test_a_new_waiter_gets_earlier_notices(
    rig: Rig, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries: queue.Queue[None] = queue.Queue()

    def refuse(*_: object, **__: object) -> None:
        tries.put(None)
        raise Forbidden("no right", status=403)

    monkeypatch.setattr(fiber_pool, "_PAUSE_MAX", 0.01)
    monkeypatch.setattr(rig.api, "apply", refuse)
    client = rig.own(told)
    client.demand(1)
    for _ in range(4):
        tries.get(timeout=PATIENCE)
    told.wait(lambda: told.warnings)
    assert len(told.warnings) == 1
    client.warn_anew()
    told.wait(lambda: len(told.warnings) == 2)
    assert told.warnings[0] == told.warnings[1]
    assert "cannot scale the FiberPool 'es-1' in namespace 'lab': no right" in told.warnings[0]


def test_each_right_that_is_missing_is_spoken_of(rig: Rig, told: Told) -> None:
    for plural in (names.PLURAL, "pods"):
        verb = "patch" if plural == names.PLURAL else "list"
        fault = Fault(verb, plural, status=403, message=f"cannot {verb} {plural}", times=math.inf)
        rig.server.do(rig.server.api.faults.append, fault)
    rig.own(told).demand(1)
    told.wait(lambda: len(told.warnings) == 2)
    watching, scaling_ = sorted(told.warnings, key=lambda warning: "scale" in warning)
    assert "cannot watch the pods of the FiberPool 'es-1'" in watching
    assert "cannot scale the FiberPool 'es-1'" in scaling_


# -- What keeps it from being born


@pytest.mark.parametrize(
    ("fault", "reason", "advice"),
    [
        (Fault(status=404, text="404 page not found"), "NotInstalled", "helm install"),
        (
            Fault(status=404, reason="NotFound", message='namespaces "lab" not found'),
            "NamespaceNotFound",
            "kubectl create namespace lab",
        ),
        (
            Fault(status=403, reason="Forbidden", message="cannot create resource fiberpools"),
            "Forbidden",
            "kubectl create rolebinding .* -n lab --clusterrole=fiber-user",
        ),
        (
            Fault(status=422, reason="Invalid", message="ValidatingAdmissionPolicy 'p' denied: no"),
            "Refused",
            "ask an administrator",
        ),
        (
            Fault(status=403, reason="Forbidden", message="exceeded quota: small"),
            "QuotaExceeded",
            "kubectl get resourcequota -n lab",
        ),
        (
            Fault(status=400, reason="BadRequest", message='unknown field "spec.onLost"'),
            "OutdatedDefinition",
            "upgrade the operator",
        ),
        (Fault(status=401, reason="Unauthorized", times=9), "Unauthorized", "kubectl auth whoami"),
        (Fault(status=422, reason="Invalid", message="spec.x: too big"), "Invalid", "spec.x"),
    ],
)
def test_obstacles_of_the_creation_are_reported_at_once(
    rig: Rig, told: Told, fault: Fault, reason: str, advice: str
) -> None:
    fault.verb, fault.plural = "create", names.PLURAL
    rig.server.api.faults.append(fault)
    rig.own(told).demand(1)
    error = told.error()
    assert error.reason == reason
    assert (error.pool, error.namespace) == ("es-1", NAMESPACE)
    with pytest.raises(type(error), match=f"cannot make the FiberPool 'es-1'.*{advice}"):
        raise error


def test_fields_that_the_definition_does_not_know_are_not_dropped_in_silence(
    rig: Rig, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    strict: dict[str, bool] = {}
    create = rig.api.create

    def spy(path: str, body: Body, **how: Any) -> Body:
        strict[body["kind"]] = how.get("strict", False)
        return create(path, body, **how)

    monkeypatch.setattr(rig.api, "create", spy)
    rig.own(told).demand(1)
    replicas_become(rig, told, 1)
    assert strict[names.KIND]


def test_a_pool_whose_secret_may_not_be_made_is_taken_back(rig: Rig, told: Told) -> None:
    rig.server.api.faults.append(Fault("create", "secrets", status=403, message="no secrets"))
    client = rig.own(told)
    assert told.error().reason == "Forbidden"
    client.close()
    assert rig.server.objects(names.PLURAL) == []


def test_a_watch_that_is_forbidden_is_not_taken_for_a_missing_operator(
    rig: Rig, told: Told
) -> None:
    rig.operator.mute = True
    rig.server.api.faults.append(Fault("list", names.PLURAL, status=403, times=99))
    rig.own(told).demand(1)
    assert told.error().reason == "Forbidden"


def test_a_silent_operator_is_reported(
    rig: Rig, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fiber_pool, "OPERATOR_SLOW", 0.05)
    rig.operator.mute = True
    client = rig.own(told)
    client.demand(1)
    told.wait(lambda: told.warnings)
    monkeypatch.setattr(fiber_pool, "OPERATOR_ABSENT", 0.0)
    client.demand(2)
    error = told.error()
    assert error.reason == "NoOperator"
    assert "helm install fiber-operator" in str(error)
    (warning,) = told.warnings
    assert "was not reconciled by an operator" in warning


def test_a_pool_without_pods_is_given_back_at_once(
    rig: Rig, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fiber_pool, "OPERATOR_SLOW", 0.1)
    monkeypatch.setattr(fiber_pool, "OPERATOR_ABSENT", 0.2)
    rig.operator.mute = True
    rig.own(told)
    told.error()
    told.wait(lambda: told.ended)
    assert rig.server.objects(names.PLURAL) == []


@pytest.mark.slow
def test_an_unreadable_pool_is_not_blamed_on_the_operator(
    rig: Rig, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fiber_pool, "OPERATOR_SLOW", 0.2)
    monkeypatch.setattr(fiber_pool, "OPERATOR_ABSENT", 1.0)
    monkeypatch.setattr(informer, "_PAUSE_MAX", 0.1)
    rig.server.api.faults.append(Fault("list", names.PLURAL, status=503, times=20))
    rig.own(told).demand(1)
    told.wait(lambda: told.statuses)
    assert not told.errors


def test_an_own_pool_keeps_its_connections_when_its_lease_expires(
    rig: Rig, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fiber_pool, "_TIMEOUT", 0.0)
    monkeypatch.setattr(fiber_pool, "_RETRY", 0.01)
    tried: queue.SimpleQueue[None] = queue.SimpleQueue()
    expired = fiber_pool.LeaseRenewer._notice_expiry

    def notice(renewer: fiber_pool.LeaseRenewer) -> None:
        expired(renewer)
        tried.put(None)

    monkeypatch.setattr(fiber_pool.LeaseRenewer, "_notice_expiry", notice)
    fault = Fault("patch", "leases", status=503, times=float("inf"))
    rig.server.do(rig.server.api.faults.append, fault)
    rig.own(told, master=replace(MASTER, lease_duration=0))
    tried.get(timeout=PATIENCE)
    seen = threading.Event()
    rig.loop.call_soon(seen.set)
    assert seen.wait(PATIENCE)
    assert told.expiries == []


def test_an_operator_that_ends_later_is_waited_for(
    rig: Rig, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fiber_pool, "PATCH_INTERVAL", 0.01)
    client = rig.own(told)
    client.demand(1)
    told.wait(lambda: any("observedGeneration" in status for status in told.statuses))
    rig.operator.mute = True
    monkeypatch.setattr(fiber_pool, "OPERATOR_ABSENT", 0.0)
    for number in (2, 3):
        client.demand(number)
        replicas_become(rig, told, number)
    assert not told.errors


# -- Its end


def test_closing_deletes_the_pool_and_all_it_has(rig: Rig, told: Told) -> None:
    client = rig.own(told)
    client.demand(1)
    replicas_become(rig, told, 1)
    client.close()
    for plural in (names.PLURAL, "secrets", "leases"):
        assert rig.server.objects(plural) == []
    assert not told.errors


def test_closing_at_once_leaves_no_object(rig: Rig, told: Told) -> None:
    rig.own(told).close()
    for plural in (names.PLURAL, "secrets", "leases"):
        assert rig.server.objects(plural) == []


def test_a_pool_that_was_made_without_our_knowledge_is_deleted(rig: Rig, told: Told) -> None:
    made = threading.Event()
    on(rig, "create", names.PLURAL, made.set)
    never_answered = Fault("create", names.PLURAL, carried_out=True, times=math.inf)
    rig.server.api.faults.append(never_answered)
    client = rig.own(told)
    assert made.wait(PATIENCE)
    client.close()
    assert rig.server.objects(names.PLURAL) == []


def test_a_namesake_is_not_deleted(rig: Rig, told: Told) -> None:
    client = rig.own(told)
    client.demand(1)
    replicas_become(rig, told, 1)
    rig.remove(names.PLURAL, "es-1")
    other = {"metadata": {"name": "es-1"}, "spec": {"replicas": 0}}
    rig.server.do(rig.server.store.create, names.PLURAL, NAMESPACE, other)
    client.close()
    assert len(rig.server.objects(names.PLURAL)) == 1


def test_leftovers_are_named_with_the_command_that_removes_them(
    rig: Rig, told: Told, capsys: pytest.CaptureFixture[str]
) -> None:
    client = rig.own(told)
    client.demand(1)
    replicas_become(rig, told, 1)
    rig.server.api.down = True
    client.close(timeout=0.5)
    said = capsys.readouterr().err
    assert "kubectl delete fiberpool es-1 -n lab" in said
    assert "stays behind" in said


def test_an_interrupted_close_names_the_leftovers_too(
    rig: Rig, told: Told, capsys: pytest.CaptureFixture[str]
) -> None:
    client = rig.own(told)
    client.demand(1)
    replicas_become(rig, told, 1)
    rig.server.api.down = True

    def interrupted(_: float) -> bool:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(client._ended, "wait", interrupted)
        with pytest.raises(KeyboardInterrupt):
            client.close()
    said = capsys.readouterr().err
    assert "stays behind: the program was interrupted" in said
    assert "kubectl delete fiberpool es-1 -n lab" in said


def test_a_bug_in_the_client_ends_the_wait_with_an_error(
    rig: Rig, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("a fault")

    monkeypatch.setattr(fiber_pool, "LeaseRenewer", fail)
    rig.own(told)
    error = told.error()
    assert error.reason == "Internal"
    assert isinstance(error.__cause__, RuntimeError)


def test_a_quota_on_pools(rig: Rig, told: Told) -> None:
    def refuse(plural: str, body: Body) -> None:
        raise Failure(403, "Forbidden", f'{plural} "es-1" is forbidden: exceeded quota: small')

    rig.server.store.admit = refuse
    rig.own(told)
    assert told.error().reason == "QuotaExceeded"
    assert MASTER.identity not in str(told.errors[0])
