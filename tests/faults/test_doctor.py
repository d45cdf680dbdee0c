"""The trial of ``fiber doctor`` on a cluster played in this process: it leaves nothing behind."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import fiber
from fakes.cluster import FakeCluster, fake_cluster
from fakes.doctor_cluster import schema
from fiber._cli import doctor, doctor_attempt
from fiber._cli.doctor_rights import SCHEMA
from fiber._cli.failures import INTERRUPTED
from fiber_api import names
from patience import PATIENCE
from unit.kubernetes_rig import kubeconfig
from unit.pool_command_rig import run

pytestmark = [
    pytest.mark.may_leak("the operator's connections, for as long as the cluster is there"),
]

KEPT = ("fiberpools", "pods", "secrets", "services", "endpointslices")


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeCluster]:
    with fake_cluster() as cluster:
        monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, cluster.url)))
        cluster.world.api.documents[SCHEMA] = schema()
        cluster.do(cluster.world.store.create, "namespaces", "", {"metadata": {"name": "lab"}})
        cluster.wait(partial(_serves, cluster))
        yield cluster
        cluster.wait(lambda: not any(map(cluster.world.store.list, KEPT)))
        assert cluster.take_forced() == []


def _serves(cluster: FakeCluster) -> bool:
    found = cluster.world.store.list("leases", names.SERVING_NAMESPACE)
    return names.SERVING_LEASE in {lease["metadata"]["name"] for lease in found}


def trial() -> list[dict[str, Any]]:
    found = json.loads(run("doctor", "--output", "json").out)
    return [verdict for verdict in found if verdict["check"] == "trial"]


def test_a_worker_runs_a_task(cluster: FakeCluster) -> None:
    found = trial()
    assert len(found) == 3, found
    did, image, way = found
    assert (did["state"], image["state"], way["state"]) == ("ok", "ok", "ok")
    assert "task done" in did["what"]
    assert f"Fiber {fiber.__version__}" in image["what"]
    assert sys.version.split()[0] in image["what"]
    assert way["what"] == "pods reach this program"


def test_an_image_that_cannot_be_pulled_is_named(cluster: FakeCluster) -> None:
    cluster.nodes.fails_with = ("ImagePullBackOff", "registry.example: no such host")
    (found,) = trial()
    assert "cannot pull the image" in found["what"], found
    assert "no such host" in found["why"]


def test_a_container_that_ends_is_not_waited_for(cluster: FakeCluster) -> None:
    cluster.nodes.fails_with = ("RunContainerError", 'exec: "python": executable file not found')
    (found,) = trial()
    assert "lacks Fiber, or Python" in found["what"]


@pytest.mark.parametrize("patience", [PATIENCE, 0.0], ids=["ends by itself", "is killed"])
def test_ctrl_c_leaves_nothing(
    cluster: FakeCluster, monkeypatch: pytest.MonkeyPatch, patience: float
) -> None:
    def interrupt(line: str) -> None:
        raise KeyboardInterrupt

    cluster.nodes.fails_with = ("ImagePullBackOff", "registry.example: no such host")
    monkeypatch.setattr(doctor, "_tell", interrupt)
    monkeypatch.setattr(doctor_attempt, "_TO_END", patience)
    assert run("doctor").status == INTERRUPTED
