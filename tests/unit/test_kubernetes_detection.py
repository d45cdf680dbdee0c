"""Which backend a program has that chose none: pods where it may make them, else this machine."""

from __future__ import annotations

from typing import Any

import pytest

from fiber._backends.kubernetes import detection
from fiber._backends.kubernetes.api_errors import Forbidden, NotFound, Unreachable
from fiber._runtime.state import _is_on_cluster
from fiber.config import Config
from fiber.errors import ConfigError
from fiber_api import names

ALLOWED = {"status": {"allowed": True}}


class Account:
    """A pod's account, and what the API server says of its rights."""

    namespace = "lab"

    def __init__(self, answer: dict[str, Any] | Exception) -> None:
        self._answer = answer
        self.served = True
        self.claim: dict[str, Any] | None = None
        self.pools: list[dict[str, Any]] = []
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
        if path == "/apis/fiber.dev/v1alpha1" and self.served:
            return {}
        if path.endswith("/leases/fiberpools.fiber.dev") and self.claim is not None:
            return {"spec": self.claim}
        raise NotFound("404 page not found", status=404)

    def list(self, path: str, selector: dict[str, str], *, timeout: float) -> dict[str, Any]:
        assert timeout <= 5.0
        assert path == "/apis/fiber.dev/v1alpha1/namespaces/lab/fiberpools"
        return {"items": self.pools}

    def close(self) -> None:
        self.closed = True


def in_a_pod(monkeypatch: pytest.MonkeyPatch, answer: dict[str, Any] | Exception) -> Account:
    account = Account(answer)
    monkeypatch.setenv("KUBERNETES_SERVICE_HOST", "10.96.0.1")
    monkeypatch.setattr(detection, "Api", account)
    return account


def test_a_pod_whose_account_may_make_pools_has_pods(monkeypatch: pytest.MonkeyPatch) -> None:
    account = in_a_pod(monkeypatch, ALLOWED)
    assert _is_on_cluster(Config())
    assert account.asked == [
        {"group": names.GROUP, "resource": names.PLURAL, "verb": "create", "namespace": "lab"}
    ]
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
        Unreachable("no route"),
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
def test_who_chose_a_backend_is_not_looked_at(
    backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    account = in_a_pod(monkeypatch, ALLOWED)
    assert not _is_on_cluster(Config(backend=backend))
    assert account.asked == []


def test_outside_of_pods_nobody_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    account = in_a_pod(monkeypatch, ALLOWED)
    monkeypatch.delenv("KUBERNETES_SERVICE_HOST")
    assert not _is_on_cluster(Config())
    assert account.asked == []


def test_without_fiber_pools_processes_run_here_with_a_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    account = in_a_pod(monkeypatch, ALLOWED)
    account.served = False
    assert not _is_on_cluster(Config())
    assert "the cluster knows no FiberPools" in caplog.text


RELEASE = {"holderIdentity": "fiber-system/fiber-operator", "leaseDurationSeconds": 900}
FRESH, OLD = "9000-01-01T00:00:00Z", "2020-01-01T00:00:00Z"


@pytest.mark.parametrize(
    ("claim", "pools", "taken"),
    [
        (None, 0, True),  # a namespace that has had no pool yet
        ({**RELEASE, "renewTime": FRESH}, 1, True),
        ({**RELEASE, "renewTime": OLD}, 1, False),
        ({**RELEASE, "renewTime": OLD, "holderIdentity": ""}, 1, True),  # it was given back
        ({**RELEASE, "renewTime": OLD}, 0, True),  # operators give up a namespace without pools
    ],
    ids=["absent", "fresh", "old", "free", "unused"],
)
def test_an_operator_that_is_gone_makes_no_pods(
    claim: dict[str, Any] | None,
    pools: int,
    taken: bool,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    account = in_a_pod(monkeypatch, ALLOWED)
    account.claim = claim
    account.pools = [{}] * pools
    assert _is_on_cluster(Config()) == taken
    assert ("is gone" in caplog.text) != taken
