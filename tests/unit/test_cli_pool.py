"""The commands ``fiber pool``: what they show, ask for and refuse."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fakes.kubernetes_api import Call, Fault
from fiber._backends.kubernetes.api import ApiRequest, ApiSession
from fiber._cli import pool
from fiber._cli.failures import FAILED, NO_RIGHT, NOT_FOUND, USAGE
from fiber_api import names
from unit.kubernetes_rig import MASTER, OTHER, Body, pool_body
from unit.pool_command_rig import Cluster, Outcome, examples_of, run
from unit.pool_command_rig import cluster as make_cluster

EXAMPLES = list(examples_of(pool.command))


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    with make_cluster(tmp_path, monkeypatch) as made:
        yield made


def refused(outcome: Outcome, status: int = FAILED) -> list[str]:
    """Return what happened, why, and what to do."""
    assert outcome.status == status, outcome
    lines = outcome.err.splitlines()
    assert [line[:6] for line in lines] == ["fiber:", "  why:", "  do: "], outcome.err
    return [lines[0][7:], *(line[8:] for line in lines[1:])]


# ---- examples and names


@pytest.mark.parametrize("words", [words for _, words in EXAMPLES], ids=" ".join)
def test_an_example_of_a_help_succeeds(cluster: Cluster, tmp_path: Path, words: list[str]) -> None:
    (tmp_path / "warm.yaml").write_text(json.dumps(pool_body("warm")))
    cluster.attach()
    outcome = run(*words)
    assert outcome.status == 0, outcome
    assert outcome.out or outcome.err


def test_each_help_has_two_examples() -> None:
    named = [name for name, _ in EXAMPLES]
    commands = ["pool", *pool.command.commands]
    assert {name: named.count(name) for name in commands} == dict.fromkeys(commands, 2)


@pytest.mark.parametrize(
    "words",
    [
        ["show", "worm"],
        ["scale", "worm", "3"],
        ["suspend", "worm"],
        ["resume", "worm"],
        ["hand-back", "worm"],
        ["delete", "worm"],
    ],
    ids=lambda words: str(words[0]),
)
def test_a_name_that_does_not_exist_gives_the_nearest(cluster: Cluster, words: list[str]) -> None:
    what, _, remedy = refused(run("pool", *words), NOT_FOUND)
    assert what == "there is no FiberPool 'worm'"
    assert remedy == "did you mean 'warm'?"


# ---- show


def test_show_has_the_problems_the_conditions_and_the_pods(cluster: Cluster) -> None:
    cluster.attach()
    cluster.set_status(
        phase="Degraded",
        readyReplicas=1,
        desiredReplicas=4,
        connectedReplicas=1,
        problems=[
            {
                "reason": "ImagePullError",
                "severity": "Error",
                "count": 3,
                "pod": "warm-2",
                "message": "the registry has no worker:2. Push it.",
                "terminal": True,
            }
        ],
        conditions=[
            {"type": "Ready", "status": "False", "reason": "TooFew", "message": "1 of 4"},
            {"type": "MasterAlive", "status": "True", "lastTransitionTime": "2026-01-01T00:00:00Z"},
        ],
    )
    ready = {"phase": "Running", "conditions": [{"type": "Ready", "status": "True"}]}
    cluster.add_pod("warm-1", ready)
    waiting = {"state": {"waiting": {"reason": "ErrImagePull", "message": "not\nfound"}}}
    cluster.add_pod("warm-2", {"phase": "Pending", "containerStatuses": [waiting]})
    shown = run("pool", "show", "warm").out
    assert "1 ready of 4 wanted (between 2 and 8), 1 connected" in shown
    assert f"{OTHER.identity} (alive since 2026-01-01T00:00:00Z)" in shown
    assert "Error ImagePullError (3 times), pod warm-2: the registry has no worker:2" in shown
    assert "waiting cannot help" in shown
    assert "TooFew" in shown
    pods = json.loads(run("pool", "show", "warm", "-o", "json").out)["pods"]
    found = [(each["name"], each["ready"], each["node"], each["reason"]) for each in pods]
    assert found == [
        ("warm-1", True, "node-1", ""),
        ("warm-2", False, "node-1", "ErrImagePull: not found"),
    ]


def test_show_has_the_spec_where_no_operator_has_looked(cluster: Cluster) -> None:
    assert "does the operator run?" in run("pool", "show", "warm").out
    facts = json.loads(run("pool", "show", "warm", "-o", "json").out)
    assert facts["phase"] == "Unknown"
    assert facts["image"] == "worker"
    assert (facts["master"], facts["problems"], facts["pods"]) == (None, [], [])


# ---- scale, suspend, resume


def test_scale_writes_replicas_and_says_what_limits_them(cluster: Cluster) -> None:
    outcome = run("pool", "scale", "warm", "4")
    assert (outcome.status, outcome.err) == (0, "")
    assert cluster.pool()["spec"]["replicas"] == 4
    assert "fiber pool warm warm --workers 1" in run("pool", "scale", "warm", "1").err
    cluster.merge({"spec": {"suspend": True}})
    cluster.attach()
    said = run("pool", "scale", "warm", "9").err
    for words in ("gets 8, its maxReplicas", "fiber pool resume warm", OTHER.identity):
        assert words in said


def test_suspend_and_resume(cluster: Cluster) -> None:
    assert run("pool", "suspend", "warm").status == 0
    assert cluster.pool()["spec"]["suspend"] is True
    assert run("pool", "resume", "warm").status == 0
    assert cluster.pool()["spec"]["suspend"] is False


def test_a_missing_right_is_named(cluster: Cluster) -> None:
    def allows(call: Call) -> bool:
        return call.verb != "patch"

    cluster.server.api.allows = allows
    what, why, _ = refused(run("pool", "scale", "warm", "4"), NO_RIGHT)
    assert what == "cannot scale the FiberPool 'warm'"
    assert "you may not patch fiberpools" in why


# ---- apply


def test_apply_makes_and_changes_the_pools_of_a_file(cluster: Cluster, tmp_path: Path) -> None:
    bodies = [pool_body("one"), pool_body("warm")]
    bodies[1]["spec"]["minReplicas"] = 5
    file = tmp_path / "pools.yaml"
    file.write_text("---\n".join(f"{json.dumps(body)}\n" for body in bodies))
    outcome = run("pool", "apply", str(file))
    assert outcome.out.splitlines() == [
        "the FiberPool 'one' is made",
        "the FiberPool 'warm' is changed",
    ]
    assert cluster.pool("one")["spec"]["template"] == bodies[0]["spec"]["template"]
    assert cluster.pool()["spec"]["minReplicas"] == 5


def test_what_a_person_writes_has_another_manager_than_a_programs_fields(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise a program's next apply would remove the template."""
    queries = []

    def send(session: ApiSession, request: ApiRequest, seconds: float) -> Any:
        queries.append((request.method, dict(request.query)))
        return as_before(session, request, seconds)

    as_before = ApiSession.send
    monkeypatch.setattr(ApiSession, "send", send)
    file = tmp_path / "pool.yaml"
    file.write_text(json.dumps(pool_body()))
    for words in (["apply", str(file)], ["apply", str(file), "--force"], ["scale", "warm", "3"]):
        assert run("pool", *words).status == 0
    manager = {"fieldManager": "fiber-cli"}
    strict = {**manager, "fieldValidation": "Strict"}
    written = [query for method, query in queries if method == "PATCH"]
    assert written == [strict, {**strict, "force": "true"}, manager]


def test_apply_reads_the_standard_input(cluster: Cluster) -> None:
    assert run("pool", "apply", "-", typed=json.dumps(pool_body("one"))).status == 0
    assert cluster.names() == ["one", "warm"]


@pytest.mark.parametrize(
    ("text", "words", "why"),
    [
        ("{", [], "while parsing a flow"),
        ("kind: Pod", [], "kind Pod"),
        ("- 1", [], "kind list"),
        ("", [], "no document"),
        ("kind: FiberPool\napiVersion: fiber.dev/v9", [], "fiber.dev/v9"),
        (json.dumps({**pool_body(), "metadata": {}}), [], "no name"),
        (json.dumps({**pool_body(), "spec": None}), [], "no spec"),
        (
            json.dumps({**pool_body(), "metadata": {"name": "a", "namespace": "one"}}),
            ["--namespace", "two"],
            "'one', and --namespace names 'two'",
        ),
    ],
)
def test_apply_refuses_what_is_no_pool(
    cluster: Cluster, tmp_path: Path, text: str, words: list[str], why: str
) -> None:
    file = tmp_path / "pool.yaml"
    file.write_text(text)
    assert why in refused(run("pool", "apply", str(file), *words))[1]
    assert cluster.server.api.calls == []


@pytest.mark.parametrize(
    ("status", "reason", "remedy"),
    [
        (409, "Conflict", "--force"),
        (422, "Invalid", "kubectl explain"),
        (404, "NotFound", "kubectl create namespace lab"),
    ],
)
def test_apply_says_what_the_server_refuses(
    cluster: Cluster, tmp_path: Path, status: int, reason: str, remedy: str
) -> None:
    file = tmp_path / "pool.yaml"
    file.write_text(json.dumps(pool_body("one")))
    cluster.server.api.faults.append(
        Fault("patch", names.PLURAL, status, reason, "words of\nthe server")
    )
    what, why, do = refused(run("pool", "apply", str(file)))
    assert what.startswith("cannot apply the FiberPool 'one' of ")
    assert why == "words of the server"
    assert remedy in do


# ---- warm


def template_of(body: Body) -> Body:
    found: Body = body["spec"]["template"]["spec"]["containers"][0]
    return found


def test_warm_makes_a_pool_as_a_program_would(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIBER_IMAGE", "registry.example/mine:1")
    outcome = run("pool", "warm", "big", "--workers", "3", "--cpu", "500m", "--memory", "512")
    assert outcome.out.splitlines() == [
        "the FiberPool 'big' is made, with 3 workers",
        "programs use it with FIBER_POOL=big",
    ]
    made = cluster.pool("big")
    assert made["spec"]["minReplicas"] == 3
    container = template_of(made)
    assert container["image"] == "registry.example/mine:1"
    assert container["resources"]["requests"] == {"cpu": "500m", "memory": "512Mi"}
    assert container["command"] == ["python", "-m", "fiber.agent"]


def test_warm_needs_an_image(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FIBER_IMAGE")
    outcome = run("pool", "warm", "big", "--workers", "3")
    what, why, do = refused(outcome, USAGE)
    assert what == "there is no image for workers"
    assert "development build" in why
    assert "--image" in do
    assert cluster.names() == ["warm"]


def test_warm_changes_what_is_given_alone(cluster: Cluster) -> None:
    sidecar = {"name": "logs", "image": "logs:1"}
    worker = {"name": "worker", "image": "worker:1", "env": [{"name": "A", "value": "1"}]}
    pod = {"containers": [sidecar, worker], "priorityClassName": "low"}
    cluster.merge({"spec": {"template": {"spec": pod}}})
    run("pool", "warm", "warm", "--workers", "20")
    spec = cluster.pool()["spec"]
    assert (spec["minReplicas"], spec["maxReplicas"]) == (20, 20)
    assert spec["template"]["spec"] == pod
    run("pool", "warm", "warm", "--workers", "1", "--image", "worker:2", "--gpu", "1")
    now = cluster.pool()["spec"]["template"]["spec"]
    amounts = {"nvidia.com/gpu": "1"}
    changed = {"image": "worker:2", "resources": {"limits": amounts, "requests": amounts}}
    assert now == {**pod, "containers": [sidecar, {**worker, **changed}]}


def test_warm_goes_on_if_the_pool_changes_or_comes_meanwhile(cluster: Cluster) -> None:
    fault = Fault("patch", names.PLURAL, 409, "Conflict")
    cluster.server.api.faults.append(fault)
    assert run("pool", "warm", "warm", "--workers", "5").status == 0
    assert cluster.pool()["spec"]["minReplicas"] == 5
    fault = Fault("create", names.PLURAL, 409, "AlreadyExists", carried_out=True)
    cluster.server.api.faults.append(fault)
    assert "is changed" in run("pool", "warm", "new", "--workers", "5").out


@pytest.mark.parametrize(("number", "words"), [(0, "0 workers"), (1, "1 worker"), (2, "2 workers")])
def test_a_number_of_workers_has_its_noun(number: int, words: str, cluster: Cluster) -> None:
    made, changed = (run("pool", "warm", "new", "--workers", str(number)).out for _ in range(2))
    assert f"is made, with {words}\n" in made
    assert f"it keeps {words}\n" in changed
    assert f"is asked for {words}\n" in run("pool", "scale", "new", str(number)).out


@pytest.mark.parametrize(
    "words",
    [
        ["Bad_Name", "--workers", "1"],
        ["new", "--workers", "1", "--cpu", "lots"],
        ["new", "--workers", "1", "--memory", "1TB"],
        ["new", "--workers", "-1"],
        ["new"],
    ],
    ids=" ".join,
)
def test_warm_refuses_a_mistake_of_the_command_line(cluster: Cluster, words: list[str]) -> None:
    assert run("pool", "warm", *words).status == USAGE
    assert cluster.names() == ["warm"]


def test_warm_leaves_the_pool_of_a_program(cluster: Cluster) -> None:
    cluster.merge({"metadata": {"labels": {names.LABEL_MANAGED_BY: names.SDK_MANAGER}}})
    assert "another name" in refused(run("pool", "warm", "warm", "--workers", "3"))[2]


# ---- hand-back, delete


def test_hand_back_names_the_program_and_detaches_it(cluster: Cluster) -> None:
    cluster.attach()
    outcome = run("pool", "hand-back", "warm", typed="y\n")
    assert f"Detach {OTHER.identity} (not known to be alive)" in outcome.out
    spec = cluster.pool()["spec"]
    assert spec["replicas"] == 0
    assert not {"master", "relay"} & spec.keys()
    assert spec["minReplicas"] == 2
    assert "no program uses" in run("pool", "hand-back", "warm").out


@pytest.mark.parametrize("command", ["hand-back", "delete"])
def test_without_an_agreement_nothing_changes(cluster: Cluster, command: str) -> None:
    cluster.attach()
    assert "nothing is changed" in run("pool", command, "warm", typed="n\n").out
    assert "--yes" in refused(run("pool", command, "warm"))[2].splitlines()[-1]
    assert cluster.pool()["spec"]["master"]["identity"] == OTHER.identity


def test_hand_back_leaves_a_program_that_came_meanwhile(cluster: Cluster) -> None:
    cluster.attach()

    def after(call: Call) -> None:
        if call.verb == "get":
            other = {"spec": {"master": MASTER.spec("warm", 9)}}
            cluster.server.store.merge(names.PLURAL, "lab", "warm", other)

    cluster.server.api.after = after
    assert MASTER.identity in refused(run("pool", "hand-back", "warm", "--yes"))[1]
    assert cluster.pool()["spec"]["master"]["identity"] == MASTER.identity


def test_hand_back_leaves_a_pool_that_its_program_made(cluster: Cluster) -> None:
    cluster.attach()
    cluster.merge({"metadata": {"labels": {names.LABEL_MANAGED_BY: names.SDK_MANAGER}}})
    assert "fiber pool delete warm" in refused(run("pool", "hand-back", "warm", "--yes"))[2]


def test_a_pool_that_changes_without_end_is_given_up(cluster: Cluster) -> None:
    cluster.attach()
    cluster.server.api.faults.append(Fault("patch", names.PLURAL, 409, "Conflict", times=1000))
    assert "--watch" in refused(run("pool", "hand-back", "warm", "--yes"))[2]


def test_delete_asks_only_if_a_program_uses_the_pool(cluster: Cluster) -> None:
    assert run("pool", "delete", "warm").out == "the FiberPool 'warm' is deleted\n"
    assert cluster.names() == []


def test_delete_leaves_a_new_pool_of_the_same_name(cluster: Cluster) -> None:
    fault = Fault("delete", names.PLURAL, 409, "Conflict", "uid in precondition")
    cluster.server.api.faults.append(fault)
    assert run("pool", "delete", "warm").status == NOT_FOUND
    assert cluster.names() == ["warm"]
