"""Which backend a program has that chose none: pods where it may make them, else this machine."""

from __future__ import annotations

from typing import Any

import pytest

from fiber._backends.kubernetes import backend
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
        self.refusal: Exception | None = None
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
        raise NotFound("404 page not found", status=404)

    def list(self, path: str, selector: dict[str, str], *, timeout: float) -> dict[str, Any]:
        assert timeout <= 5.0
        assert path.endswith("/fiberpools")
        if self.refusal is not None:
            raise self.refusal
        return {"items": self.pools}

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


SEEN, NEW, OLD = {"observedGeneration": 1}, "9000-01-01T00:00:00Z", "2020-01-01T00:00:00Z"


def pool(created: str, status: dict[str, Any] | None = None) -> dict[str, Any]:
    return {"metadata": {"creationTimestamp": created}, **({"status": status} if status else {})}


@pytest.mark.parametrize(
    ("pools", "taken"),
    [
        ([], True),
        ([pool(OLD, SEEN)], True),
        ([pool(OLD), pool(OLD, SEEN)], True),
        ([pool(NEW)], True),
        ([pool(OLD), pool(NEW)], True),
        ([{"metadata": {}}], True),
        ([pool(OLD)], False),
        ([pool(OLD), pool(OLD, {"phase": "Pending"})], False),
    ],
    ids=["none", "seen", "one-seen", "new", "one-new", "no-time", "waits", "both-wait"],
)
def test_pools_that_wait_in_vain_show_that_no_operator_serves_them(
    pools: list[dict[str, Any]],
    taken: bool,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    account = in_a_pod(monkeypatch, ALLOWED)
    account.pools = pools
    assert _is_on_cluster(Config()) == taken
    assert ("no operator serves" in caplog.text) != taken


def test_pools_that_may_not_be_listed_show_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    account = in_a_pod(monkeypatch, ALLOWED)
    account.refusal = Forbidden("no", status=403)
    assert _is_on_cluster(Config())
