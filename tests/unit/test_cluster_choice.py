"""Choice of the end-to-end tests' cluster, and the message where there is none."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from cluster import ability, packages, places
from cluster.shell import ClusterError
from e2e.clusters import Cluster, Given, Kind, NoCluster, Own, choose

IMAGES = {
    "FIBER_E2E_OPERATOR_IMAGE": "example/operator:1",
    "FIBER_E2E_WORKER_IMAGE": "example/w:1",
    "FIBER_E2E_WORKER_RL_IMAGE": "example/w-rl:1",
}
OBSTACLES = ability.obstacles  # the tests of the choice replace it


@pytest.fixture(autouse=True)
def _unable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the machine have neither kind nor the abilities that our own cluster takes."""
    monkeypatch.setattr(ability, "kind_lacks", lambda: "kind is not on the PATH")
    monkeypatch.setattr(ability, "obstacles", lambda: ["it takes root"])
    monkeypatch.setattr(Own, "__init__", lambda _: None)
    monkeypatch.setattr(Kind, "__init__", lambda *_, **__: None)
    monkeypatch.setattr(Kind, "make", Kind)


@pytest.fixture
def kubeconfig(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """Return the kubeconfig of a cluster that a kubectl on the PATH finds ready."""
    program = tmp_path / "bin" / "kubectl"
    program.parent.mkdir()
    (tmp_path / "context").write_text("somewhere")
    program.write_text(
        f'#!/bin/sh\ncase "$*" in *current-context) cat {tmp_path}/context;; *) echo ok;; esac\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    file = tmp_path / "kubeconfig"
    file.touch()
    return str(file)


@pytest.mark.parametrize(
    ("context", "kind", "own", "chosen"),
    [
        ("somewhere", True, True, Given),
        ("kind-mine", True, True, Kind),
        ("ours", False, True, Own),
        ("", True, True, Kind),
        ("", False, True, Own),
    ],
)
def test_a_named_cluster_comes_before_kind_and_kind_before_our_own(
    monkeypatch: pytest.MonkeyPatch,
    kubeconfig: str,
    context: str,
    kind: bool,
    own: bool,
    chosen: type[Cluster],
) -> None:
    if kind:
        monkeypatch.setattr(ability, "kind_lacks", lambda: None)
    if own:
        monkeypatch.setattr(ability, "obstacles", list)
    if context == "ours":
        monkeypatch.setattr(places, "KUBECONFIG", Path(kubeconfig))
    (Path(kubeconfig).parent / "context").write_text(context)
    found = choose({"KUBECONFIG": kubeconfig, **IMAGES} if context else {})
    assert type(found) is chosen
    if isinstance(found, Given):
        assert found.images == {
            "fiber-operator": "example/operator:1",
            "fiber-worker": "example/w:1",
            "fiber-worker-rl": "example/w-rl:1",
        }


def test_a_named_cluster_that_cannot_be_used_is_an_error(kubeconfig: str) -> None:
    with pytest.raises(ClusterError, match="FIBER_E2E_OPERATOR_IMAGE and FIBER_E2E_WORKER_IMAGE"):
        choose({"KUBECONFIG": kubeconfig})
    with pytest.raises(ClusterError, match="KUBECONFIG is /nowhere, and there is no such file"):
        choose({"KUBECONFIG": "/nowhere"})


def test_a_machine_without_any_cluster_gets_each_reason() -> None:
    with pytest.raises(NoCluster) as raised:
        choose({})
    for reason in ("KUBECONFIG is not set", "kind is not on the PATH", "it takes root"):
        assert reason in str(raised.value)


def test_a_fault_that_the_cluster_cannot_make_skips_the_test() -> None:
    some = Cluster()
    some.description = "the cluster of my boss"
    with pytest.raises(pytest.skip.Exception, match="my boss: cannot"), some.cut_off("node-1"):
        pass


@pytest.mark.parametrize(
    ("user", "lacks", "go", "built", "named"),
    [
        (0, [], True, False, []),
        (0, [], False, True, []),
        (1000, ["runc"], False, False, ["root", "install Go", "runc"]),
    ],
    ids=["root-with-go", "root-with-programs", "user-with-nothing"],
)
def test_each_obstacle_to_our_own_cluster_is_named(
    monkeypatch: pytest.MonkeyPatch,
    user: int,
    lacks: list[str],
    go: bool,
    built: bool,
    named: list[str],
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: user)
    monkeypatch.setattr(ability, "_capabilities_lacking", list)
    monkeypatch.setattr(packages, "missing", lambda _: lacks)
    monkeypatch.setattr("cluster.build.missing", lambda _: [] if built else ["kubelet"])
    monkeypatch.setattr("shutil.which", lambda *_, **__: "/usr/bin/go" if go else None)
    found = OBSTACLES()
    assert len(found) == len(named)
    for obstacle, words in zip(found, named, strict=True):
        assert words in obstacle
