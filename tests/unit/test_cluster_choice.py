"""Choice of the end-to-end tests' cluster, and the message where there is none."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
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


@pytest.fixture(autouse=True)
def nothing_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without kind, and unable to run our own cluster."""
    monkeypatch.setattr(ability, "kind_lacks", lambda: "kind is not on the PATH")
    monkeypatch.setattr(ability, "obstacles", lambda: ["it takes root"])
    monkeypatch.setattr(Own, "__init__", lambda _: None)
    monkeypatch.setattr(Kind, "__init__", lambda *_, **__: None)


@pytest.fixture
def kubectl(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A kubectl whose cluster is ready and whose context is what is written to the file."""
    context = tmp_path / "context"
    context.write_text("somewhere")
    program = tmp_path / "bin" / "kubectl"
    program.parent.mkdir()
    program.write_text(
        f'#!/bin/sh\ncase "$*" in *current-context) cat {context};; *) echo ok;; esac\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    return context


@pytest.fixture
def kubeconfig(tmp_path: Path) -> str:
    file = tmp_path / "kubeconfig"
    file.touch()
    return str(file)


def test_a_given_cluster_comes_first(
    monkeypatch: pytest.MonkeyPatch, kubectl: Path, kubeconfig: str
) -> None:
    monkeypatch.setattr(ability, "kind_lacks", lambda: None)
    monkeypatch.setattr(ability, "obstacles", list)
    chosen = choose({"KUBECONFIG": kubeconfig, **IMAGES})
    assert isinstance(chosen, Given)
    assert chosen.images == {
        "fiber-operator": "example/operator:1",
        "fiber-worker": "example/w:1",
        "fiber-worker-rl": "example/w-rl:1",
    }


def test_a_given_kind_cluster_is_known_as_one(
    monkeypatch: pytest.MonkeyPatch, kubectl: Path, kubeconfig: str
) -> None:
    monkeypatch.setattr(ability, "kind_lacks", lambda: None)
    kubectl.write_text("kind-mine")
    assert isinstance(choose({"KUBECONFIG": kubeconfig}), Kind)


def test_our_own_cluster_is_known_when_it_is_given(
    monkeypatch: pytest.MonkeyPatch, kubeconfig: str
) -> None:
    monkeypatch.setattr(places, "KUBECONFIG", Path(kubeconfig))
    assert isinstance(choose({"KUBECONFIG": kubeconfig}), Own)


@pytest.mark.usefixtures("kubectl")
def test_a_given_cluster_must_know_where_images_are(kubeconfig: str) -> None:
    with pytest.raises(ClusterError, match="FIBER_E2E_OPERATOR_IMAGE and FIBER_E2E_WORKER_IMAGE"):
        choose({"KUBECONFIG": kubeconfig})


def test_a_kubeconfig_that_is_not_there_is_an_error() -> None:
    with pytest.raises(ClusterError, match="KUBECONFIG is /nowhere, and there is no such file"):
        choose({"KUBECONFIG": "/nowhere"})


def test_kind_comes_before_our_own(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Cluster()
    monkeypatch.setattr(ability, "kind_lacks", lambda: None)
    monkeypatch.setattr(Kind, "make", lambda: made)
    monkeypatch.setattr(ability, "obstacles", list)
    assert choose({}) is made


def test_our_own_comes_where_it_can_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ability, "obstacles", list)
    assert isinstance(choose({}), Own)


def test_where_there_is_none_each_reason_is_given() -> None:
    with pytest.raises(NoCluster) as raised:
        choose({})
    for reason in ("KUBECONFIG is not set", "kind is not on the PATH", "it takes root"):
        assert reason in str(raised.value)


@pytest.mark.parametrize(
    "harm",
    [
        lambda cluster: cluster.cut_off("node-1"),
        lambda cluster: cluster.without_apiserver(),
    ],
    ids=["cut off", "apiserver"],
)
def test_a_missing_ability_of_the_cluster_skips_the_test(
    harm: Callable[[Cluster], AbstractContextManager[None]],
) -> None:
    some = Cluster()
    some.description = "the cluster of my boss"
    with pytest.raises(pytest.skip.Exception, match="my boss: cannot"), harm(some):
        pass


def test_a_container_is_killed_where_that_can_be_done(monkeypatch: pytest.MonkeyPatch) -> None:
    killed: list[tuple[str, str]] = []
    monkeypatch.setattr("cluster.faults.kill_container", lambda *what: killed.append(what))
    statuses = [{"name": "operator", "containerID": "containerd://1234"}]
    pod = {"spec": {"nodeName": "node-1"}, "status": {"containerStatuses": statuses}}
    Own().kill(pod, "operator")
    assert killed == [("node-1", "1234")]
    some = Cluster()
    some.description = "the cluster of my boss"
    with pytest.raises(pytest.skip.Exception, match="cannot kill a container on node-1"):
        some.kill(pod, "operator")


# Whether our own can run; the functions that the other tests replace, themselves.

OBSTACLES = ability.obstacles


def test_root_with_go_has_no_obstacle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(ability, "_capabilities_lacking", list)
    monkeypatch.setattr(packages, "missing", lambda _: [])
    monkeypatch.setattr("cluster.build.missing", lambda _: ["kubelet"])
    monkeypatch.setattr("cluster.build.find_go", lambda: "/usr/bin/go")
    assert OBSTACLES() == []


def test_every_obstacle_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(packages, "missing", lambda _: ["runc"])
    monkeypatch.setattr("shutil.which", lambda *_, **__: None)
    monkeypatch.setattr("cluster.build.missing", lambda _: ["kubelet"])
    root, go, wanted = OBSTACLES()
    assert "root" in root
    assert "install Go" in go
    assert "runc" in wanted


def test_programs_that_are_built_need_no_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(ability, "_capabilities_lacking", list)
    monkeypatch.setattr(packages, "missing", lambda _: [])
    monkeypatch.setattr("shutil.which", lambda *_, **__: None)
    monkeypatch.setattr("cluster.build.missing", lambda _: [])
    assert OBSTACLES() == []
