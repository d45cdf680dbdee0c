"""The chart's admission policy on a real API server: what it refuses, and what it lets pass."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from e2e.kube import Body, Refused, path_of
from e2e.leftovers import leaves_nothing
from e2e.pools import Pool, says, template
from e2e.program import Programs
from e2e.release import Release
from e2e.scene import Scene
from e2e.test_drain import squares

pytestmark = pytest.mark.timeout(240, func_only=True)

DRY = {"dryRun": "All"}
PORT = {"containerPort": 80, "hostPort": 80}


def of_pod(**spec: object) -> Body:
    return {"spec": spec}


def of_container(kind: str = "containers", **fields: object) -> Body:
    return {"spec": {kind: [{"name": "worker", "image": "fiber-worker", **fields}]}}


ASKED = {
    "the node's network": (of_pod(hostNetwork=True), "network, processes or IPC"),
    "the node's processes": (of_pod(hostPID=True), "network, processes or IPC"),
    "the node's IPC": (of_pod(hostIPC=True), "network, processes or IPC"),
    "a folder of the node": (
        of_pod(volumes=[{"name": "root", "hostPath": {"path": "/"}}]),
        "hostPath",
    ),
    "privilege": (of_container(securityContext={"privileged": True}), "a privileged container"),
    "privilege at first": (
        of_container("initContainers", securityContext={"privileged": True}),
        "a privileged container",
    ),
    "a capability": (
        of_container(securityContext={"capabilities": {"add": ["NET_ADMIN"]}}),
        "more capabilities",
    ),
    "a driver of the node": (
        of_pod(volumes=[{"name": "driver", "flexVolume": {"driver": "example.com/any"}}]),
        "flexVolume",
    ),
    "a process of the node": (
        of_pod(securityContext={"windowsOptions": {"hostProcess": True}}),
        "hostProcess",
    ),
    "the whole of /proc": (of_container(securityContext={"procMount": "Unmasked"}), "procMount"),
    "no seccomp": (
        of_pod(securityContext={"seccompProfile": {"type": "Unconfined"}}),
        "Unconfined",
    ),
    "no seccomp in the container": (
        of_container(securityContext={"seccompProfile": {"type": "Unconfined"}}),
        "Unconfined",
    ),
    "kernel parameters": (
        of_pod(securityContext={"sysctls": [{"name": "kernel.msgmax", "value": "1"}]}),
        "sysctls",
    ),
    "a node by its name": (of_pod(nodeName="node-1"), "nodeName"),
    "a priority class of the system": (
        of_pod(priorityClassName="system-node-critical"),
        "priority class of the system",
    ),
    "a port of the node": (of_container(ports=[PORT]), "hostPort"),
    "another account": (of_pod(serviceAccountName="master"), "ServiceAccount"),
    "another account, by its old name": (of_pod(serviceAccount="master"), "ServiceAccount"),
}
"""Changes of a good template, and a word of the policy's refusal."""


@pytest.fixture(scope="module", autouse=True)
def policy(release: Release) -> Iterator[None]:
    """The policy, as the chart brings it."""
    release.install({"admissionPolicy": {"create": True}})
    yield
    release.install()


@pytest.fixture
def guarded(scene: Scene) -> Scene:
    """A namespace in which the policy is in force."""
    bad = Pool(scene, "probe").manifest(with_more(template("fiber-worker"), of_pod(hostPID=True)))
    scene.wait("the policy is in force", lambda: refusal(scene, bad), poll=0.2)
    return scene


def with_more(agent: Body, more: Body) -> Body:
    """Merge it into the template; a list replaces one of the same name."""
    changed = copy.deepcopy(agent)
    changed["spec"].update(copy.deepcopy(more["spec"]))
    return changed


def refusal(scene: Scene, manifest: Body) -> str:
    """Return why the API server would not take it; empty if it would."""
    try:
        scene.kube.create(scene.path("fiberpools"), manifest, **DRY)
    except Refused as refused:
        return str(refused)
    return ""


def test_forbidden_template_fields_are_refused(guarded: Scene, agent: Body) -> None:
    pool = Pool(guarded, "es")
    for case, (more, word) in ASKED.items():
        said = refusal(guarded, pool.manifest(with_more(agent, more)))
        words = (
            "HTTP 403",
            "denied request: the template of ",
            word,
            "Take it out",
            "ask an administrator",
        )
        assert says(said, *words), case


def test_allowed_template_fields_pass(guarded: Scene, agent: Body) -> None:
    context = {"runAsNonRoot": True, "capabilities": {"drop": ["ALL"]}, "privileged": False}
    more = {
        "hostNetwork": False,
        "serviceAccountName": "default",
        "volumes": [
            {"name": "tmp", "emptyDir": {}},
            {"name": "anothers", "secret": {"secretName": "warm-fiber-key"}},
        ],
        "initContainers": [{"name": "first", "image": "x", "securityContext": context}],
    }
    pool = Pool(guarded, "es")
    absent = dict.fromkeys(["volumes", "initContainers", "securityContext", "serviceAccount"])
    nothing = {"add": None, "drop": ["ALL"]}
    for good in (
        of_pod(),
        of_pod(**more),
        of_pod(**absent),
        of_container(securityContext=None, ports=None),
        of_container(securityContext={"capabilities": None}),
        of_container(securityContext={"capabilities": nothing}, ports=[{"hostPort": None}]),
    ):
        assert refusal(guarded, pool.manifest(with_more(agent, good))) == ""


def test_a_label_excepts_a_namespace_and_pools_that_are_there_go_on(
    guarded: Scene, agent: Body
) -> None:
    pool = Pool(guarded, "es")
    bad = with_more(agent, of_pod(hostIPC=True))
    path = path_of("namespaces", name=guarded.namespace)

    def label(value: str | None) -> None:
        labels = {"fiber.dev/unrestricted": value}
        guarded.kube.patch(path, {"metadata": {"labels": labels}})

    label("true")
    guarded.wait("it is excepted", lambda: not refusal(guarded, pool.manifest(bad)), poll=0.2)
    pool.apply(bad)
    label(None)
    other = Pool(guarded, "other").manifest(bad)
    guarded.wait("it is excepted no more", lambda: refusal(guarded, other), poll=0.2)
    pool.scale(1)
    pool.kubectl("label", "fiberpool", "es", "team=research")
    with pytest.raises(Refused, match="processes or IPC of the node"):
        pool.patch(template={"spec": {"hostPID": True}})


def test_a_program_gets_the_policys_refusal(
    guarded: Scene, programs: Programs, tmp_path: Path
) -> None:
    wishes = tmp_path / "template.json"
    wishes.write_text(json.dumps(of_pod(hostNetwork=True)))
    output = programs.start("outside", "mapping.py", template=wishes).ends(status=1)
    words = ("FiberPoolError", "system:serviceaccount:", "network, processes or IPC", "template=")
    assert says(output, *words)


def test_a_program_in_a_pod_passes(guarded: Scene, programs: Programs) -> None:
    """Workers have the pool's own account."""
    program = programs.start("inside", "mapping.py", "--tasks", 60)
    assert program.says("done")["total"] == squares(60)
    program.ends()
    leaves_nothing(program)
