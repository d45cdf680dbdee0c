"""``fiber doctor``: each mistake is named, rightly and first."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from fakes.doctor_cluster import ROOT, DoctorCluster
from fakes.rights import FIBER_USER
from fakes.served import served
from fiber import config
from fiber._backends.kubernetes import published
from fiber._backends.kubernetes.template import fiber_pool_body
from fiber._cli import doctor
from fiber._cli.doctor_attempt import LONGEST_START, settings_of
from fiber._cli.doctor_rights import (
    ACCOUNT_RIGHTS,
    PROGRAM_RIGHTS,
    RUN_RIGHTS,
    RUNNER_RIGHTS,
    SPEC_OF_PROGRAMS,
    Right,
)
from fiber._cli.image_packages import Package
from fiber_api import names
from unit.doctor_mistakes import ANSWER, MISTAKES, DoctorRig, Mistake
from unit.kubernetes_rig import NAMESPACE, OTHER, Body, kubeconfig, pool_body
from unit.pool_command_rig import Outcome, examples_of, run


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[DoctorRig]:
    with served() as server:
        monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, server.api.url)))
        monkeypatch.delenv("FIBER_IMAGE", raising=False)  # that of `make cluster`
        monkeypatch.setattr(published, "REGISTRY", "registry.example/fiber")
        monkeypatch.chdir(tmp_path)
        made = DoctorRig(DoctorCluster(server, NAMESPACE), tmp_path, monkeypatch, server.api.url)
        monkeypatch.setattr(doctor, "attempt", made.attempt)
        packages_of(monkeypatch, "fiberpool")
        yield made


def verdicts(*words: str) -> list[Body]:
    outcome = run("doctor", *words, "--output", "json")
    found: list[Body] = json.loads(outcome.out)
    assert outcome.status in (0, 1), outcome
    return found


def first_fault(found: list[Body]) -> Body:
    faults = [verdict for verdict in found if verdict["state"] == "fault"]
    assert faults, found
    assert all(faults[0][key] for key in ("what", "why", "do"))
    return faults[0]


# ---- a cluster without a fault


def test_a_healthy_cluster_has_only_ticks(rig: DoctorRig) -> None:
    outcome = run("doctor")
    assert outcome.status == 0, outcome
    lines = outcome.out.splitlines()
    assert {line[0] for line in lines} == {"✓"}, outcome.out
    for words in ("namespace 'lab'", "9.8.7", "task done 1.5 s", "pods reach this program"):
        assert words in outcome.out
    assert rig.trials == 1


def test_the_examples_of_the_help_succeed(rig: DoctorRig) -> None:
    rig.cluster.add("namespaces", {"metadata": {"name": "team-a"}}, "")
    examples = [words for _, words in examples_of(doctor.command)]
    assert len(examples) == 2
    assert [run(*words).status for words in examples] == [0, 0]


def test_without_a_trial_none_is_made(rig: DoctorRig) -> None:
    assert run("doctor", "--no-trial").status == 0
    rig.cluster.end_operator()
    assert run("doctor", "--no-trial").status == 1
    assert rig.trials == 0


def test_a_fault_that_the_trial_disproves_does_not_count(rig: DoctorRig) -> None:
    rig.cluster.set_node(spec={"unschedulable": True})
    assert run("doctor").status == 0


def test_a_trial_that_cannot_succeed_is_not_made(rig: DoctorRig) -> None:
    rig.cluster.end_operator()
    outcome = run("doctor")
    assert outcome.status == 1
    assert outcome.out.splitlines()[-1] == (
        "- trial: not checked, because of the fault above (operator)"
    )
    assert rig.trials == 0


def test_an_account_that_sees_only_its_namespace_has_no_fault(rig: DoctorRig) -> None:
    hidden = ("resourcequotas", "limitranges")
    rig.cluster.api.allows = lambda call: call.namespace == NAMESPACE and call.plural not in hidden
    found = verdicts()
    unknown = {verdict["check"] for verdict in found if verdict["state"] == "unknown"}
    where = {"namespace", "operator", "operator's version", "quota", "nodes"}
    assert unknown == where
    assert rig.trials == 1


# ---- mistakes


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: str(mistake.name))
def test_a_mistake_is_named_first(rig: DoctorRig, mistake: Mistake) -> None:
    mistake.force(rig)
    found = first_fault(verdicts(*mistake.words))
    assert found["check"] == mistake.check, found
    assert mistake.what in found["what"], found
    assert mistake.do in found["do"], found


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: str(mistake.name))
def test_a_mistake_gives_a_status(rig: DoctorRig, mistake: Mistake) -> None:
    mistake.force(rig)
    trial_is_told = mistake.check == "trial"
    outcome = run("doctor", *mistake.words, *([] if trial_is_told else ["--no-trial"]))
    assert outcome.status == 1
    assert "✗" in outcome.out
    assert not outcome.err or trial_is_told


def test_what_a_fault_hides_is_not_checked(rig: DoctorRig) -> None:
    rig.cluster.api.down = True
    found = verdicts()
    states = {verdict["check"]: verdict["state"] for verdict in found}
    assert states.pop("kubeconfig") == "ok"
    assert states.pop("API server") == "fault"
    assert states.pop("image") == "ok"
    assert set(states.values()) == {"unknown"}


def test_what_is_left_of_a_trial_is_a_fault(rig: DoctorRig) -> None:
    rig.course.left = "the FiberPool 'doctor-trial-1'"
    assert "something is left" in first_fault(verdicts())["what"]
    assert run("doctor").status == 1


def test_the_way_of_the_worker_is_said(rig: DoctorRig) -> None:
    rig.course.relay = True
    assert "came by a relay" in run("doctor").out
    rig.setenv("RELAY", "always")
    assert "as relay='always' asks" in run("doctor").out


def test_another_fiber_that_works_is_a_fault(rig: DoctorRig) -> None:
    rig.course.answer = {**ANSWER, "fiber": "0.0.1"}
    assert "the image has Fiber 0.0.1" in first_fault(verdicts())["what"]


def packages_of(patch: pytest.MonkeyPatch, *names: str) -> None:
    """Let this program have these packages."""
    patch.setattr(doctor, "installed", lambda: [Package(name, "1") for name in names])


def test_packages_that_the_image_lacks_are_a_note(
    rig: DoctorRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    packages_of(monkeypatch, "fiberpool", "numpy", "ruamel_yaml", "pip", *"gfedcba")
    (found,) = [verdict for verdict in verdicts() if verdict["state"] == "note"]
    words = "the image lacks 7 packages of this program: a, b, c, d, e and 2 more"
    assert (found["check"], found["what"]) == ("trial", words)
    assert "fiber image build" in found["do"]
    assert run("doctor").status == 0
    packages_of(monkeypatch, "numpy", "scipy")
    assert "the image lacks 1 package of this program: scipy\n" in run("doctor").out


# ---- rights


@pytest.mark.parametrize("right", PROGRAM_RIGHTS, ids=str)
def test_a_missing_right_is_named(rig: DoctorRig, right: Right) -> None:
    rig.cluster.forbid(right.verb, right.resource)
    found = first_fault(verdicts())
    assert found["check"] == ("special rights" if right.only else "rights")
    assert found["what"] == f"this account may not {right}"
    assert "fiber-user" in found["do"]
    assert rig.trials == bool(right.only)


@pytest.mark.parametrize("right", RUN_RIGHTS, ids=str)
def test_a_missing_right_of_run_is_named(rig: DoctorRig, right: Right) -> None:
    rig.cluster.forbid(right.verb, right.resource)
    (found,) = [verdict for verdict in verdicts() if verdict["state"] == "note"]
    assert found["check"] == "rights of fiber run"
    assert found["what"] == f"this account may not {right}"
    assert found["why"].startswith("only `fiber run` needs this")
    assert "fiber-runner" in found["do"]


def test_programs_do_without_the_rights_and_the_account_of_fiber_run(rig: DoctorRig) -> None:
    for right in (*RUNNER_RIGHTS, *ACCOUNT_RIGHTS):
        rig.cluster.forbid(right.verb, right.resource)
    outcome = run("doctor", "--no-trial")
    assert outcome.status == run("doctor").status == 0
    assert {line[0] for line in outcome.out.splitlines() if line[0] != " "} == {"✓", "!", "-"}
    assert outcome.out.count("kubectl create rolebinding") == 1


def test_an_account_of_programs_that_cannot_be_made_is_a_note(rig: DoctorRig) -> None:
    rig.cluster.forbid("create", "rolebindings")
    (found,) = [verdict for verdict in verdicts() if verdict["state"] == "note"]
    assert found["check"] == "account of fiber run"
    assert "no account 'fiber-program'" in found["what"]
    assert "kubectl create serviceaccount" in found["do"]


def by_resource(rights: tuple[Right, ...]) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for right in rights:
        found.setdefault(right.resource, set()).add(right.verb)
    return found


def rights_in_chart(role: str) -> set[tuple[str, str, str]]:
    rules = (ROOT / "charts/fiber-operator/templates/_rules.tpl").read_text()
    text = re.search(rf"^{role}:\n(.*?)^\w", rules, re.MULTILINE | re.DOTALL)
    assert text is not None
    return {
        (group, resource, verb)
        for rule in yaml.safe_load(text[1])
        for group in rule["apiGroups"]
        for resource in rule["resources"]
        for verb in rule["verbs"]
    }


@pytest.mark.parametrize(("role", "rights"), [("user", PROGRAM_RIGHTS), ("runner", RUNNER_RIGHTS)])
def test_the_rights_are_those_of_the_charts_role(role: str, rights: tuple[Right, ...]) -> None:
    wanted = {(right.group, right.resource, right.verb) for right in rights}
    assert wanted == rights_in_chart(role)


def test_both_roles_are_enough_for_fiber_run() -> None:
    assert {*RUN_RIGHTS} <= {right._replace(only="") for right in (*PROGRAM_RIGHTS, *RUNNER_RIGHTS)}


def test_the_rights_of_the_fake_account_are_those_of_programs() -> None:
    assert by_resource(PROGRAM_RIGHTS) == FIBER_USER


# ---- facts


def test_the_fields_that_programs_write_are_those_of_the_sdk() -> None:
    body = fiber_pool_body("a", {}, config.load(environ={}))
    assert {*body["spec"], "replicas", "master", "relay"} == SPEC_OF_PROGRAMS


@pytest.mark.parametrize(
    ("source", "force"),
    [
        ("the default", lambda rig: None),
        ("FIBER_IMAGE", lambda rig: rig.setenv("IMAGE", "mine:1")),
        (
            "pyproject.toml",
            lambda rig: (rig.folder / "pyproject.toml").write_text(
                "[tool.fiber]\nimage = 'mine:1'\n"
            ),
        ),
        ("template", lambda rig: rig.template(image="mine:1")),
    ],
)
def test_the_source_of_the_image_is_said(
    rig: DoctorRig, source: str, force: Callable[[DoctorRig], object]
) -> None:
    force(rig)
    (line,) = (v["what"] for v in verdicts("--no-trial") if v["check"] == "image")
    assert source in line
    default = f"{published.worker_image()} "
    assert line.startswith(default if source == "the default" else "mine:1 ")


def test_a_program_with_a_warm_pool_needs_no_image(rig: DoctorRig) -> None:
    rig.unpublish()
    rig.cluster.add(names.PLURAL, pool_body("warm"))
    rig.setenv("POOL", "warm")
    outcome = run("doctor")
    assert outcome.status == 0, outcome.out
    assert "image: that of its pods (from the FiberPool 'warm')" in outcome.out


def test_warm_pools_and_their_programs_are_listed(rig: DoctorRig) -> None:
    body = pool_body("used")
    body["spec"]["master"] = OTHER.spec("used", 1)
    for each in (body, pool_body("warm")):
        rig.cluster.add(names.PLURAL, each)
    outcome: Outcome = run("doctor", "--no-trial")
    assert f"used (0 workers ready, used by {OTHER.identity}" in outcome.out
    assert "warm (0 workers ready, free)" in outcome.out


def test_the_trial_has_the_configuration_of_this_machine() -> None:
    environ = {
        "FIBER_NAMESPACE": "lab",
        "FIBER_NODE_SELECTOR": "disk=ssd",
        "FIBER_TOLERATIONS": "spot,team=a:NoSchedule",
        "FIBER_SHM": "2Gi",
        "FIBER_LISTEN_PORT": "9000-9009",
        "FIBER_POD_TIMEOUT": "60",
    }
    here = config.load(environ=environ)
    sent = json.loads(json.dumps(settings_of(here)))
    assert config.load(sent, environ={}) == replace(here, backend="kubernetes")
    assert settings_of(config.load(environ={}))["pod_timeout"] == LONGEST_START
