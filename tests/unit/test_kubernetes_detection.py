"""Default backend of a program: pods where it may make them, else this machine."""

from __future__ import annotations

from typing import Any, Literal

import pytest

from fiber._backends.kubernetes import backend
from fiber._runtime.state import _is_on_cluster
from fiber.config import Config
from fiber.errors import ConfigError
from fiber_api import names
from fiber_api.rest import Forbidden, NotFound, NotServed, ServerUnreachable

ALLOWED = {"status": {"allowed": True}}
LEASE = "/apis/coordination.k8s.io/v1/namespaces/{}/leases/operator.fiber.dev"
FRESH = {"renewTime": "9000-01-01T00:00:00.000000Z", "leaseDurationSeconds": 300}
OLD = {"renewTime": "2020-01-01T00:00:00.000000Z", "leaseDurationSeconds": 300}
FORBIDDEN = Forbidden("you may not", status=403)


class Account:
    """A pod's account, and what the API server says of its rights."""

    namespace = "lab"

    def __init__(self, answer: dict[str, Any] | Exception) -> None:
        self._answer = answer
        self.served = True
        self.leases: dict[str, dict[str, Any] | Exception] = {"kube-public": {"spec": FRESH}}
        """Answers of the API server about an operator's Lease, by namespace."""
        self.got: list[str] = []
        self.asked: list[dict[str, Any]] = []
        self.closed = False

    def connect(self) -> Account:
        if isinstance(self._answer, ConfigError):
            raise self._answer
        return self

    def create(self, path: str, body: dict[str, Any], *, timeout: float) -> dict[str, Any]:
        assert path == "/apis/authorization.k8s.io/v1/selfsubjectaccessreviews"
        assert timeout <= 5.0  # every program in a pod waits for it
        self.asked.append(body["spec"]["resourceAttributes"])
        if isinstance(self._answer, Exception):
            raise self._answer
        return self._answer

    def get(self, path: str, *, timeout: float) -> dict[str, Any]:
        assert timeout <= 5.0
        self.got.append(path)
        if path == "/apis/fiber.dev/v1alpha1" and self.served:
            return {}
        for namespace, answer in self.leases.items():
            if path == LEASE.format(namespace):
                if isinstance(answer, Exception):
                    raise answer
                return answer
        if "/namespaces/" in path:
            raise NotFound("not found", status=404, reason="NotFound")
        raise NotServed("404 page not found", status=404)

    def close(self) -> None:
        self.closed = True


def in_a_pod(monkeypatch: pytest.MonkeyPatch, answer: dict[str, Any] | Exception) -> Account:
    account = Account(answer)
    monkeypatch.setenv("KUBERNETES_SERVICE_HOST", "10.96.0.1")
    monkeypatch.setattr(backend, "Api", account)
    return account


def test_a_pod_whose_account_may_make_pools_has_pods(monkeypatch: pytest.MonkeyPatch) -> None:
    account = in_a_pod(monkeypatch, ALLOWED)
    assert _is_on_cluster(Config())
    assert account.asked == [
        {"group": names.GROUP, "resource": names.PLURAL, "verb": "create", "namespace": "lab"}
    ]
    assert account.got == [LEASE.format("kube-public")]
    assert account.closed


def test_the_right_counts_where_the_pods_are_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    account = in_a_pod(monkeypatch, ALLOWED)
    assert _is_on_cluster(Config(namespace="team-a"))
    assert [attributes["namespace"] for attributes in account.asked] == ["team-a"]


@pytest.mark.parametrize(
    "answer",
    [
        {"status": {"allowed": False}},
        {"status": {}},
        {},
        Forbidden("no", status=403),
        ServerUnreachable("no route"),
        ConfigError("no account"),
    ],
    ids=repr,
)
def test_every_other_pod_runs_its_processes_itself(
    answer: dict[str, Any] | Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_a_pod(monkeypatch, answer)
    assert not _is_on_cluster(Config())


@pytest.mark.parametrize("backend", ["local", "loopback"])
def test_a_chosen_backend_skips_the_detection(
    backend: Literal["local", "loopback"], monkeypatch: pytest.MonkeyPatch
) -> None:
    account = in_a_pod(monkeypatch, ALLOWED)
    assert not _is_on_cluster(Config(backend=backend))
    assert account.asked == []


def test_outside_of_pods_no_server_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    account = in_a_pod(monkeypatch, ALLOWED)
    monkeypatch.delenv("KUBERNETES_SERVICE_HOST")
    assert not _is_on_cluster(Config())
    assert account.asked == []


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name == "fiber"]


def test_without_fiber_pools_processes_run_here_with_a_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    account = in_a_pod(monkeypatch, ALLOWED)
    account.served, account.leases = False, {}
    assert not _is_on_cluster(Config())
    (line,) = lines(caplog)
    assert "the cluster knows no FiberPools" in line


@pytest.mark.parametrize(
    "public",
    [None, {"spec": OLD}, FORBIDDEN],
    ids=["no-public-lease", "an-old-public-lease", "an-unreadable-public-lease"],
)
def test_an_operator_of_this_namespace_alone_is_found(
    public: dict[str, Any] | Exception | None,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    account = in_a_pod(monkeypatch, ALLOWED)
    account.leases = {"lab": {"spec": FRESH}, **({"kube-public": public} if public else {})}
    assert _is_on_cluster(Config())
    assert account.got == [LEASE.format("kube-public"), LEASE.format("lab")]
    assert lines(caplog) == []


@pytest.mark.parametrize(
    ("leases", "says"),
    [
        ({}, "does not exist in the namespace 'kube-public' and does not exist in the namespace"),
        ({"other": {"spec": FRESH}}, "does not exist in the namespace 'lab'"),
        (
            {"kube-public": {"spec": OLD}},
            "was last renewed at 2020-01-01T00:00:00Z in the namespace 'kube-public'",
        ),
        ({"lab": {"spec": OLD}}, "was last renewed at 2020-01-01T00:00:00Z in the namespace 'lab'"),
        ({"kube-public": {}}, "has no time"),
        ({"kube-public": {"spec": {**FRESH, "leaseDurationSeconds": "?"}}}, "has no time"),
        (
            {"kube-public": FORBIDDEN, "lab": FORBIDDEN},
            "may not be read in the namespace 'kube-public' and may not be read in the namespace",
        ),
        ({"kube-public": ServerUnreachable("no route")}, "the API server does not say"),
    ],
    ids=["none", "elsewhere", "dead", "dead-here", "empty", "damaged", "no-right", "no-answer"],
)
def test_without_a_fresh_lease_processes_run_here_and_one_line_explains_it(
    leases: dict[str, dict[str, Any] | Exception],
    says: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    account = in_a_pod(monkeypatch, ALLOWED)
    account.leases = leases
    assert not _is_on_cluster(Config())
    (line,) = lines(caplog)
    assert says in line
    assert "backend='local'" in line
    assert len(account.got) <= 3
