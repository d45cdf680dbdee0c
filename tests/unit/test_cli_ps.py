"""The command ``fiber ps``: programs in pods, and others."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fakes.kubernetes_api import Fault
from fiber._cli import ps
from fiber_api import names
from unit.kubernetes_rig import NAMESPACE, Body
from unit.pool_command_rig import Cluster, examples_of, run
from unit.pool_command_rig import cluster as make_cluster

KEYS = ["name", "state", "workers", "host", "created", "age", "command", "job"]
"""Keys of the JSON, which programs use: never rename one."""


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    with make_cluster(tmp_path, monkeypatch) as made:
        yield made


def add_program(cluster: Cluster, name: str, pods: int = 1, **status: Any) -> None:
    """Add the Job of a program and its pods."""
    labels = {names.LABEL_PROGRAM: name}
    typed = {names.ANNOTATION_COMMAND: "python train.py\n--workers 8"}
    cluster.add({"metadata": {"name": name, "labels": labels, "annotations": typed}}, "jobs")
    store = cluster.server.store
    cluster.server.do(store.set_status, "jobs", NAMESPACE, name, status)
    for number in range(pods):
        cluster.add({"metadata": {"name": f"{name}-pod{number}", "labels": labels}}, "pods")


def use_pool(cluster: Cluster, host: str, **status: Any) -> None:
    """Let a program on a host use the pool ``warm``, with three ready workers."""
    master = {"identity": f"{host}:41", "host": host, "epoch": 1}
    cluster.merge({"spec": {"master": master}})
    cluster.set_status(readyReplicas=3, **status)


def rows() -> list[Body]:
    outcome = run("ps", "-o", "json")
    assert outcome.status == 0, outcome
    found: list[Body] = json.loads(outcome.out)
    return found


@pytest.mark.parametrize("words", [words for _, words in examples_of(ps.command)], ids=" ".join)
def test_an_example_of_the_help_succeeds(cluster: Cluster, words: list[str]) -> None:
    outcome = run(*words)
    assert outcome.status == 0
    assert outcome.out or outcome.err


def test_programs_in_pods_have_their_workers(cluster: Cluster) -> None:
    add_program(cluster, "train-1", pods=2, ready=1)
    add_program(cluster, "other", pods=0)
    use_pool(cluster, "train-1-pod1")
    found = {row["name"]: row for row in rows()}
    assert [list(row) for row in found.values()] == [KEYS, KEYS]
    train = found["train-1"]
    assert (train["state"], train["workers"], train["job"]) == ("running", 3, True)
    assert train["host"] in ("train-1-pod0", "train-1-pod1")
    assert train["command"] == "python train.py --workers 8"
    assert (found["other"]["state"], found["other"]["host"]) == ("starting", None)


def test_other_programs_are_listed_by_their_pools(cluster: Cluster) -> None:
    add_program(cluster, "laptop", ready=1)  # a name that the host's begins with
    use_pool(cluster, "laptop-7")
    (_, elsewhere) = rows()
    assert list(elsewhere) == KEYS
    facts = ("name", "state", "workers", "host", "command", "job")
    assert [elsewhere[key] for key in facts] == ["warm", "running", 3, "laptop-7", None, False]
    use_pool(cluster, "laptop-7", conditions=[{"type": "MasterAlive", "status": "False"}])
    assert rows()[1]["state"] == "lost"


@pytest.mark.parametrize(
    ("kind", "state"), [("Complete", "succeeded"), ("Failed", "failed"), ("Suspended", "starting")]
)
def test_the_state_of_a_program_that_ended(cluster: Cluster, kind: str, state: str) -> None:
    add_program(cluster, "train-1", conditions=[{"type": kind, "status": "True"}])
    assert rows()[0]["state"] == state


@pytest.mark.parametrize(
    ("state", "word"),
    [
        ({"running": {}}, "running"),
        ({"terminated": {"exitCode": 0}}, "succeeded"),
        ({"terminated": {"exitCode": 3}}, "failed"),
        ({"waiting": {"reason": "ContainerCreating"}}, "starting"),
    ],
)
def test_the_pod_knows_the_state_before_the_job(cluster: Cluster, state: Body, word: str) -> None:
    add_program(cluster, "train-1")
    containers = [{"name": names.PROGRAM_CONTAINER, "state": state}]
    status = {"phase": "Running", "containerStatuses": containers}
    store = cluster.server.store
    cluster.server.do(store.set_status, "pods", NAMESPACE, "train-1-pod0", status)
    assert rows()[0]["state"] == word


@pytest.mark.parametrize(
    "words",
    [
        ["ps", "--namespace", "../../x"],
        ["stop", ".."],
        ["logs", "a/b"],
        ["pool", "show", ".."],
        ["pool", "scale", "a?b", "1"],
    ],
    ids=" ".join,
)
def test_a_name_that_would_change_the_path_is_refused(cluster: Cluster, words: list[str]) -> None:
    outcome = run(*words)
    assert outcome.status == 2
    assert "cannot be the name of a" in outcome.err
    assert cluster.server.api.calls == []


def test_each_list_is_asked_for_once(cluster: Cluster) -> None:
    add_program(cluster, "train-1", ready=1)
    outcome = run("ps")
    assert [line.split()[0] for line in outcome.out.splitlines()] == ["NAME", "train-1"]
    assert "--attach" in outcome.err
    asked = [(call.verb, call.plural) for call in cluster.server.api.calls]
    assert asked == [("list", "jobs"), ("list", names.PLURAL), ("list", "pods")]


def test_a_cluster_without_the_operator_has_programs(cluster: Cluster) -> None:
    add_program(cluster, "train-1", ready=1)
    fault = Fault("list", names.PLURAL, 404, text="404 page not found")
    cluster.server.api.faults.append(fault)
    assert [row["name"] for row in rows()] == ["train-1"]


def test_no_program(cluster: Cluster) -> None:
    outcome = run("ps")
    assert (outcome.status, outcome.out) == (0, "")
    assert "no program runs on this machine or in the namespace 'lab'" in outcome.err
    assert rows() == []
