"""The chart's admission policy on a real API server: refused and accepted templates."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from chart.policy_cases import ALLOWED, FORBIDDEN, of_pod, with_more
from e2e.accounts import ACCOUNT, may_use_pools
from e2e.kube import Body, Failed, Refused, path_of
from e2e.leftovers import leaves_nothing
from e2e.pools import Pool, says, template
from e2e.program import Programs
from e2e.release import Release
from e2e.scene import Scene
from e2e.test_drain import squares

pytestmark = pytest.mark.timeout(240, func_only=True)

DRY = {"dryRun": "All"}
GROUP = "rbac.authorization.k8s.io"


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


def refusal(scene: Scene, manifest: Body) -> str:
    """Return why the API server would not take it; empty if it would."""
    try:
        scene.kube.create(scene.path("fiberpools"), manifest, **DRY)
    except Refused as refused:
        return str(refused)
    return ""


def test_forbidden_template_fields_are_refused(guarded: Scene, agent: Body) -> None:
    pool = Pool(guarded, "es")
    for case, (more, reason) in FORBIDDEN.items():
        said = refusal(guarded, pool.manifest(with_more(agent, more)))
        words = ("HTTP 403", "denied request: the template of ", reason, "ask an administrator")
        assert says(said, *words), case


def test_allowed_template_fields_pass(guarded: Scene, agent: Body) -> None:
    pool = Pool(guarded, "es")
    for case, more in ALLOWED.items():
        assert refusal(guarded, pool.manifest(with_more(agent, more))) == "", case


def test_a_person_who_is_named_like_an_account_is_not_that_account(
    guarded: Scene, agent: Body
) -> None:
    may_use_pools(guarded)
    account = f"system:serviceaccount:{guarded.namespace}:{ACCOUNT}"
    subjects = [{"kind": "User", "name": ACCOUNT, "apiGroup": GROUP}]
    role = {"apiGroup": GROUP, "kind": "ClusterRole", "name": "fiber-user"}
    binding = {"metadata": {"name": "person"}, "roleRef": role, "subjects": subjects}
    guarded.kube.create(guarded.path("rolebindings"), binding)
    asked = with_more(agent, of_pod(serviceAccountName=ACCOUNT))
    manifest = json.dumps(Pool(guarded, "es").manifest(asked))
    create = ("create", "--dry-run=server", "--filename", "-", "--as")
    assert "created" in guarded.kube.kubectl(*create, account, stdin=manifest)
    with pytest.raises(Failed, match=f"the template of {ACCOUNT} asks for a ServiceAccount"):
        guarded.kube.kubectl(*create, ACCOUNT, stdin=manifest)


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
