"""Preparation before the tests, by the machine's abilities; it never fails."""

from __future__ import annotations

import pytest

from cluster import ability, build, images, packages, preparation
from cluster.preparation import prepare
from cluster.shell import ClusterError


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the preparations on a fresh machine that can run the project's cluster."""
    steps: list[str] = []
    monkeypatch.delenv("KUBECONFIG", raising=False)
    monkeypatch.setattr("shutil.which", lambda *_, **__: None)
    monkeypatch.setattr(ability, "obstacles", list)
    monkeypatch.setattr(build, "build", steps.extend)
    monkeypatch.setattr(packages, "need", lambda *_: steps.append("packages"))
    monkeypatch.setattr(preparation, "pause_archive", lambda: steps.append("pause"))
    monkeypatch.setattr(images, "build_images", lambda: steps.append("images"))
    return steps


def test_everything_for_our_own_cluster(done: list[str]) -> None:
    prepare()
    assert done == ["helm", "packages", "kubernetes", "helm", "pause", "images"]


def test_a_given_cluster_takes_helm_alone(done: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KUBECONFIG", "/somewhere")
    prepare()
    assert done == ["helm"]


def test_a_machine_that_cannot_run_it_builds_helm_alone(
    done: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ability, "obstacles", lambda: ["it takes root"])
    prepare()
    assert done == ["helm"]


def test_a_failed_preparation_is_reported_and_is_no_error(
    done: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def need(*_: object) -> None:
        raise ClusterError("no network")

    monkeypatch.setattr(packages, "need", need)
    prepare()
    assert "not prepared: no network" in capsys.readouterr().err
    assert done == ["helm"]
