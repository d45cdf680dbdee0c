"""``fiber doctor``: each mistake is named, rightly and first."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from fakes.doctor_cluster import RESOURCES, ROOT, DoctorCluster
from fakes.kubernetes_api import Fault
from fakes.rights import FIBER_USER
from fakes.served import served
from fiber import config
from fiber._backends.kubernetes.problems import AgentRoute, PoolName, failure, unreachable
from fiber._backends.kubernetes.template import fiber_pool_body
from fiber._cli import doctor
from fiber._cli.doctor_attempt import TrialCourse
from fiber._cli.doctor_rights import PROGRAM_RIGHTS, RUN_RIGHTS, SPEC_OF_PROGRAMS, Right
from fiber._cli.doctor_trial_verdicts import Program
from fiber._transport.authentication import Identity, version_mismatch
from fiber.errors import FiberPoolError
from fiber_api import names
from fiber_api.names import Reason
from unit.kubernetes_rig import NAMESPACE, OTHER, Body, kubeconfig, pool_body
from unit.pool_command_rig import Outcome, examples_of, run

ANSWER = {"python": "3.11.2", "fiber": Program("", "").fiber, "packages": 7}
POOL = PoolName("doctor-trial-1", NAMESPACE)


class Rig:
    """Cluster, environment and trial of a test."""

    def __init__(
        self, cluster: DoctorCluster, folder: Path, patch: pytest.MonkeyPatch, url: str
    ) -> None:
        self.cluster = cluster
        self.folder = folder
        self.patch = patch
        self.url = url
        self.course = TrialCourse({"pool": 0.5, "task": 2.0}, ANSWER)
        self.trials = 0

    def attempt(self, *_: Any) -> TrialCourse:
        self.trials += 1
        return self.course

    def setenv(self, name: str, value: object) -> None:
        self.patch.setenv(f"FIBER_{name}", str(value))

    def template(self, **container: Any) -> None:
        """Configure a pod template whose worker has these fields."""
        worker = {"name": names.WORKER_CONTAINER, **container}
        file = self.folder / "template.json"
        file.write_text(json.dumps({"spec": {"containers": [worker]}}))
        self.setenv("TEMPLATE", file)

    def warm(self, **spec: Any) -> None:
        """Configure the FiberPool warm, which exists."""
        body = pool_body("warm")
        body["spec"] |= spec
        self.cluster.add(names.PLURAL, body)
        self.setenv("POOL", "warm")

    def problem(self, reason: Reason, message: str) -> None:
        """Let the trial end with a problem of its FiberPool, as the SDK reports it."""
        problem = {"reason": reason, "message": message, "severity": "Error", "terminal": True}
        error = failure(POOL, {"problems": [problem]}, 0)
        assert error is not None
        self.fails(error)

    def fails(self, error: FiberPoolError) -> None:
        said = {"kind": "FiberPoolError", "reason": error.reason, "message": str(error)}
        self.course = TrialCourse({"pool": 0.5}, error=said)


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    with served() as server:
        monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, server.api.url)))
        monkeypatch.chdir(tmp_path)
        made = Rig(DoctorCluster(server, NAMESPACE), tmp_path, monkeypatch, server.api.url)
        monkeypatch.setattr(doctor, "attempt", made.attempt)
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


def test_a_healthy_cluster_has_only_ticks(rig: Rig) -> None:
    outcome = run("doctor")
    assert outcome.status == 0, outcome
    lines = outcome.out.splitlines()
    assert {line[0] for line in lines} == {"✓"}, outcome.out
    for words in ("namespace 'lab'", "9.8.7", "task done 1.5 s", "pods reach this program"):
        assert words in outcome.out
    assert rig.trials == 1


def test_the_examples_of_the_help_succeed(rig: Rig) -> None:
    rig.cluster.add("namespaces", {"metadata": {"name": "team-a"}}, "")
    examples = [words for _, words in examples_of(doctor.command)]
    assert len(examples) == 2
    assert [run(*words).status for words in examples] == [0, 0]


def test_without_a_trial_none_is_made(rig: Rig) -> None:
    assert run("doctor", "--no-trial").status == 0
    rig.cluster.end_operator()
    assert run("doctor", "--no-trial").status == 1
    assert rig.trials == 0


def test_a_fault_that_the_trial_disproves_does_not_count(rig: Rig) -> None:
    rig.cluster.set_node(spec={"unschedulable": True})
    assert run("doctor").status == 0


def test_a_trial_that_cannot_succeed_is_not_made(rig: Rig) -> None:
    rig.cluster.end_operator()
    outcome = run("doctor")
    assert outcome.status == 1
    assert outcome.out.splitlines()[-1] == (
        "- trial: not checked, because of the fault above (operator)"
    )
    assert rig.trials == 0


def test_an_account_that_sees_only_its_namespace_has_no_fault(rig: Rig) -> None:
    hidden = ("resourcequotas", "limitranges")
    rig.cluster.api.allows = lambda call: call.namespace == NAMESPACE and call.plural not in hidden
    found = verdicts()
    unknown = {verdict["check"] for verdict in found if verdict["state"] == "unknown"}
    assert unknown == {"namespace", "operator", "operator's version", "quota", "nodes"}
    assert rig.trials == 1


# ---- mistakes


class Mistake(NamedTuple):
    """Mistake that is forced, and the words that must name it."""

    name: str
    force: Callable[[Rig], object]
    check: str
    what: str
    do: str = ""
    words: tuple[str, ...] = ()


def _no_kubeconfig(rig: Rig) -> None:
    rig.patch.setenv("KUBECONFIG", str(rig.folder / "nowhere"))


def _broken_kubeconfig(rig: Rig) -> None:
    (rig.folder / "kubeconfig").write_text("{")


def _no_definition(rig: Rig) -> None:
    rig.cluster.api.documents[RESOURCES] = None
    rig.cluster.api.faults.append(
        Fault(plural=names.PLURAL, status=404, text="404 page not found", times=9)
    )


def _quota(**hard: str) -> Callable[[Rig], None]:
    spec = {"hard": {key.replace("_", "."): value for key, value in hard.items()}}

    def force(rig: Rig) -> None:
        rig.cluster.add("resourcequotas", {"metadata": {"name": "team"}, "spec": spec})

    return force


def _range(**item: Any) -> Callable[[Rig], None]:
    body = {"metadata": {"name": "small"}, "spec": {"limits": [{"type": "Container", **item}]}}
    return lambda rig: rig.cluster.add("limitranges", body)


def _no_room(rig: Rig) -> None:
    requests = {"containers": [{"name": "a", "resources": {"requests": {"memory": "8190Mi"}}}]}
    body = {"metadata": {"name": "big"}, "spec": {"nodeName": "node-1", **requests}}
    rig.cluster.add("pods", body, "other")


def _gpu(rig: Rig) -> None:
    rig.template(resources={"limits": {"nvidia.com/gpu": "1"}})


def _taint(rig: Rig) -> None:
    rig.cluster.set_node(spec={"taints": [{"key": "team", "value": "a", "effect": "NoSchedule"}]})


def _other_python(rig: Rig) -> None:
    here = Identity.of_this_process("")
    error = version_mismatch(here, replace(here, python="3.99.1", name="doctor-trial-1-a"))
    rig.course = TrialCourse(refusal=str(error))


def _other_protocol(rig: Rig) -> None:
    here = Identity.of_this_process("")
    error = version_mismatch(here, replace(here, protocol=0, name="doctor-trial-1-a"))
    rig.course = TrialCourse(refusal=str(error))


def _cut_off(relay: str) -> Callable[[Rig], None]:
    route = AgentRoute(f"the relay {relay}" if relay else "192.168.1.7:4711", relay=relay)
    status = {"replicas": 1, "pendingReplicas": 0}
    return lambda rig: rig.fails(unreachable(POOL, status, 68.0, route))


def _no_namespace_and_no_right_to_see(rig: Rig) -> None:
    rig.cluster.remove("namespaces", NAMESPACE)
    rig.cluster.forbid_all("namespaces")
    rig.fails(POOL.error('namespaces "lab" not found', "NamespaceNotFound"))


def _fails(reason: Reason, message: str) -> Callable[[Rig], None]:
    return lambda rig: rig.problem(reason, message)


def _ends(reason: Reason, message: str) -> Callable[[Rig], None]:
    """Let the trial be ended because of a problem that does not end by waiting."""
    interrupted = {"kind": "KeyboardInterrupt", "reason": "", "message": "KeyboardInterrupt"}
    problem = {"reason": reason, "message": message}

    def force(rig: Rig) -> None:
        rig.course = TrialCourse(error=interrupted, problem=problem)

    return force


MISTAKES = [
    Mistake("no kubeconfig", _no_kubeconfig, "kubeconfig", "no kubeconfig", "KUBECONFIG"),
    Mistake("broken kubeconfig", _broken_kubeconfig, "kubeconfig", "cannot be used", "config view"),
    Mistake(
        "wrong context",
        lambda rig: None,
        "kubeconfig",
        "no context 'there'",
        "get-contexts",
        ("--context", "there"),
    ),
    Mistake(
        "wrong key",
        lambda rig: rig.setenv("IMAGES", "a"),
        "kubeconfig",
        "configuration cannot be read",
        "correct the named key",
    ),
    Mistake(
        "server is silent",
        lambda rig: setattr(rig.cluster.api, "down", True),
        "API server",
        "does not answer",
        "VPN",
    ),
    Mistake(
        "no API server there",
        lambda rig: rig.cluster.api.documents.update({"/version": None}),
        "API server",
        "no API server",
        "address",
    ),
    Mistake(
        "expired login",
        lambda rig: setattr(rig.cluster.api, "accepts", set()),
        "API server",
        "login is not accepted",
        "log in again",
    ),
    Mistake(
        "slow clock", lambda rig: rig.cluster.set_clock(900.0), "clock", "behind", "timedatectl"
    ),
    Mistake(
        "fast clock", lambda rig: rig.cluster.set_clock(-900.0), "clock", "ahead", "timedatectl"
    ),
    Mistake(
        "no namespace",
        lambda rig: rig.cluster.remove("namespaces", NAMESPACE),
        "namespace",
        "no namespace 'lab'",
        "kubectl create namespace lab",
    ),
    Mistake("no CRD", _no_definition, "FiberPools", "knows no FiberPools", "helm install"),
    Mistake(
        "old CRD",
        lambda rig: rig.cluster.drop_field("relay"),
        "FiberPools",
        "lacks spec.relay",
        "helm upgrade",
    ),
    Mistake(
        "no operator",
        lambda rig: rig.cluster.end_operator(),
        "operator",
        "no operator serves",
        "helm install",
    ),
    Mistake(
        "stale Lease",
        lambda rig: rig.cluster.renew(time.time() - 3600),
        "operator",
        "does not run any more",
        "log of its pod",
    ),
    Mistake(
        "bad template",
        lambda rig: rig.setenv("TEMPLATE", rig.folder / "none.yaml"),
        "image",
        "template cannot be made",
        "template",
    ),
    Mistake("full quota", _quota(pods="0"), "quota", "quota refuses", "larger quota"),
    Mistake("quota of limits", _quota(limits_cpu="4"), "quota", "quota refuses", "cpu_request"),
    Mistake(
        "quota of memory", _quota(requests_memory="32Mi"), "quota", "quota refuses", "larger quota"
    ),
    Mistake("LimitRange", _range(max={"memory": "32Mi"}), "quota", "LimitRange", "memory_request"),
    Mistake("minimum", _range(min={"cpu": "500m"}), "quota", "LimitRange", "cpu_request"),
    Mistake(
        "default limit", _range(default={"memory": "32Mi"}), "quota", "LimitRange", "memory_request"
    ),
    Mistake("no room", _no_room, "nodes", "no node has room", "add nodes"),
    Mistake("taint", _taint, "nodes", "no node has room", "tolerations"),
    Mistake(
        "node selector",
        lambda rig: rig.setenv("NODE_SELECTOR", "disk=ssd"),
        "nodes",
        "no node has room",
        "node_selector",
    ),
    Mistake("no GPU", _gpu, "nodes", "no node has a GPU", "device plugin"),
    Mistake(
        "pool of another",
        lambda rig: rig.warm(master=OTHER.spec("warm", 3)),
        "warm pools",
        "another program uses",
        "wait",
    ),
    Mistake(
        "suspended pool", lambda rig: rig.warm(suspend=True), "warm pools", "suspended", "resume"
    ),
    Mistake(
        "no such pool",
        lambda rig: rig.setenv("POOL", "warm"),
        "warm pools",
        "no FiberPool 'warm'",
        "fiber pool warm warm",
    ),
    Mistake(
        "no image",
        _fails(Reason.IMAGE_PULL_ERROR, "doctor-trial-1-a cannot get its image: not found."),
        "trial",
        "cannot pull the image 'mine:1'",
        "registry",
        ("--image", "mine:1"),
    ),
    Mistake(
        "image without Fiber",
        _ends(
            Reason.CONTAINER_FAILED, "Its last lines:\nModuleNotFoundError: No module named 'fiber'"
        ),
        "trial",
        "'mine:1' lacks Fiber",
        "fiber image",
        ("--image", "mine:1"),
    ),
    Mistake(
        "image without Python",
        _fails(Reason.BACKOFF_LIMIT_EXCEEDED, 'exec: "python": executable file not found in $PATH'),
        "trial",
        "lacks Fiber, or Python",
        "fiber image",
    ),
    Mistake(
        "image that crashes",
        _ends(Reason.CONTAINER_FAILED, "exited with code 139"),
        "trial",
        "ends at once",
        "kubectl logs",
    ),
    Mistake(
        "image of root",
        _fails(Reason.CONTAINER_CONFIG_ERROR, "container has runAsNonRoot and image runs as root"),
        "trial",
        "runs as root",
        "USER",
    ),
    Mistake("other Python", _other_python, "trial", "another Python", "fiber image"),
    Mistake("other Fiber", _other_protocol, "trial", "another Fiber", "fiber image"),
    Mistake("NetworkPolicy", _cut_off("a-relay"), "trial", "nor its relay", "NetworkPolicy"),
    Mistake("no relay wanted", _cut_off(""), "trial", "do not reach this program", "FIBER_RELAY"),
    Mistake(
        "pod security",
        _fails(Reason.FORBIDDEN, 'violates PodSecurity "restricted:latest": runAsUser=0'),
        "trial",
        "pod security",
        "securityContext",
    ),
    Mistake(
        "policy",
        _fails(Reason.FORBIDDEN, "a webhook denied the request"),
        "trial",
        "refuses the trial",
    ),
    Mistake(
        "hidden quota",
        _fails(Reason.QUOTA_EXCEEDED, "exceeded quota: team"),
        "trial",
        "a quota of the namespace",
        "larger quota",
    ),
    Mistake(
        "no node takes it",
        _fails(Reason.UNSCHEDULABLE, "No node takes it: 0/3 nodes are available"),
        "trial",
        "no node takes",
        "add nodes",
    ),
    Mistake(
        "hidden namespace",
        _no_namespace_and_no_right_to_see,
        "trial",
        "no namespace 'lab'",
        "kubectl create namespace lab",
    ),
    Mistake(
        "no answer of the trial",
        lambda rig: setattr(rig, "course", TrialCourse(said=["Segmentation fault"])),
        "trial",
        "no worker ran the task",
        "kubectl describe",
    ),
]


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: str(mistake.name))
def test_a_mistake_is_named_first(rig: Rig, mistake: Mistake) -> None:
    mistake.force(rig)
    found = first_fault(verdicts(*mistake.words))
    assert found["check"] == mistake.check, found
    assert mistake.what in found["what"], found
    assert mistake.do in found["do"], found


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: str(mistake.name))
def test_a_mistake_gives_a_status(rig: Rig, mistake: Mistake) -> None:
    mistake.force(rig)
    trial_is_told = mistake.check == "trial"
    outcome = run("doctor", *mistake.words, *([] if trial_is_told else ["--no-trial"]))
    assert outcome.status == 1
    assert "✗" in outcome.out
    assert not outcome.err or trial_is_told


def test_what_a_fault_hides_is_not_checked(rig: Rig) -> None:
    rig.cluster.api.down = True
    found = verdicts()
    states = {verdict["check"]: verdict["state"] for verdict in found}
    assert states.pop("kubeconfig") == "ok"
    assert states.pop("API server") == "fault"
    assert states.pop("image") == "ok"
    assert set(states.values()) == {"unknown"}


def test_what_is_left_of_a_trial_is_a_fault(rig: Rig) -> None:
    rig.course.left = "the FiberPool 'doctor-trial-1'"
    assert "something is left" in first_fault(verdicts())["what"]
    assert run("doctor").status == 1


def test_the_way_of_the_worker_is_said(rig: Rig) -> None:
    rig.course.relay = True
    assert "came by a relay" in run("doctor").out
    rig.setenv("RELAY", "always")
    assert "as relay='always' asks" in run("doctor").out


def test_another_fiber_that_works_is_a_fault(rig: Rig) -> None:
    rig.course.answer = {**ANSWER, "fiber": "0.0.1"}
    assert "the image has Fiber 0.0.1" in first_fault(verdicts())["what"]


# ---- rights


@pytest.mark.parametrize("right", PROGRAM_RIGHTS, ids=str)
def test_a_missing_right_is_named(rig: Rig, right: Right) -> None:
    rig.cluster.forbid(right.verb, right.resource)
    found = first_fault(verdicts())
    assert found["check"] == ("special rights" if right.only else "rights")
    assert found["what"] == f"this account may not {right}"
    assert "fiber-user" in found["do"]
    assert rig.trials == bool(right.only)


@pytest.mark.parametrize("right", sorted({*RUN_RIGHTS} - {*PROGRAM_RIGHTS}), ids=str)
def test_a_missing_right_of_run_is_named(rig: Rig, right: Right) -> None:
    rig.cluster.forbid(right.verb, right.resource)
    found = [verdict for verdict in verdicts() if verdict["state"] == "fault"]
    assert {verdict["check"] for verdict in found} <= {"special rights", "rights of fiber run"}
    assert found[-1]["what"] == f"this account may not {right}"
    assert rig.trials == 1


def by_resource(rights: tuple[Right, ...]) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for right in rights:
        found.setdefault(right.resource, set()).add(right.verb)
    return found


def test_the_rights_of_a_program_are_those_of_the_chart() -> None:
    rules = (ROOT / "charts/fiber-operator/templates/_rules.tpl").read_text()
    text = re.search(r"^user:\n(.*?)^\w", rules, re.MULTILINE | re.DOTALL)
    assert text is not None
    given = {
        (group, resource, verb)
        for rule in yaml.safe_load(text[1])
        for group in rule["apiGroups"]
        for resource in rule["resources"]
        for verb in rule["verbs"]
    }
    wanted = {(right.group, right.resource, right.verb) for right in PROGRAM_RIGHTS}
    # The role may also have rights for `fiber run`.
    runs = {(right.group, right.resource, right.verb) for right in RUN_RIGHTS}
    assert wanted <= given <= wanted | runs
    assert by_resource(PROGRAM_RIGHTS).items() <= FIBER_USER.items()


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
    rig: Rig, source: str, force: Callable[[Rig], object]
) -> None:
    force(rig)
    (line,) = (v["what"] for v in verdicts("--no-trial") if v["check"] == "image")
    assert source in line
    assert line.startswith("fiber-worker:" if source == "the default" else "mine:1 ")


def test_warm_pools_and_their_programs_are_listed(rig: Rig) -> None:
    body = pool_body("used")
    body["spec"]["master"] = OTHER.spec("used", 1)
    for each in (body, pool_body("warm")):
        rig.cluster.add(names.PLURAL, each)
    outcome: Outcome = run("doctor", "--no-trial")
    assert f"used (0 workers ready, used by {OTHER.identity}" in outcome.out
    assert "warm (0 workers ready, free)" in outcome.out
