"""examples/06-managers"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.run_example import BACKENDS, run
from fakes.cluster import FakeCluster, fake_cluster
from unit.kubernetes_rig import kubeconfig

SCRIPT = "06-managers/train_remote.py"


def train(backend: str, picture: Path, *, envs: int, updates: int) -> list[float]:
    """The mean returns that a small run prints; it also draws the picture."""
    small = ("--envs", envs, "--updates", updates, "--ms", 1, "--out", picture)
    done = run(SCRIPT, *small, backend=backend)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert all("] waiting for pods: " in line for line in done.stderr.splitlines())
    rates = re.findall(r"^(?:one after|side by).*: +[\d,]+ steps a second$", done.stdout, re.M)
    assert len(rates) == 2
    returns = re.findall(r"^update .* mean return +([\d.]+)$", done.stdout, re.M)
    return [float(mean) for mean in returns]


def test_the_learning_curve_is_the_same_on_each_backend(tmp_path: Path) -> None:
    here, there = (train(kind, tmp_path / "curve.png", envs=3, updates=30) for kind in BACKENDS)
    assert here == there
    assert here[-1] > 1.2 * here[0]


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeCluster]:
    with fake_cluster() as cluster:
        monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, cluster.url)))
        yield cluster


@pytest.mark.may_leak("the operator's connections, for as long as the cluster is there")
def test_environments_in_pods(cluster: FakeCluster, tmp_path: Path) -> None:
    train("kubernetes", tmp_path / "curve.png", envs=2, updates=10)
    cluster.wait(lambda: not cluster.world.store.list("fiberpools"))


def test_bad_arguments() -> None:
    done = run(SCRIPT, "--env", "Chess-v9", status=2)
    assert "--env Chess-v9: Environment `Chess` doesn't exist" in done.stderr
    done = run(SCRIPT, "--env", "Pendulum-v1", status=2)
    assert "not Discrete" in done.stderr
