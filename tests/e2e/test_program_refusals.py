"""Requests that cannot be met: the program gets an error with a remedy at once."""

from __future__ import annotations

import copy
import signal
import socket
from collections.abc import Callable, Iterator

import pytest

from e2e.accounts import ACCOUNT
from e2e.clusters import Cluster
from e2e.kube import Body, Refused, path_of
from e2e.leftovers import leaves_nothing
from e2e.pools import Pool, says
from e2e.program import Programs
from e2e.quotas import make_quota
from e2e.release import Release
from e2e.scene import Scene
from fiber_api import names


def nothing_done(_: Scene) -> None: ...


def no_pods_allowed(scene: Scene) -> None:
    make_quota(scene, "none", pods="0")


def quota_on_requests(scene: Scene) -> None:
    make_quota(scene, "counted", **{"requests.memory": "1Gi"})


def limits(**kinds: str) -> Callable[[Scene], None]:
    """A LimitRange with these bounds of memory for each container."""

    def make(scene: Scene) -> None:
        limit = {"type": "Container", **{k: {"memory": v} for k, v in kinds.items()}}
        body = {"metadata": {"name": "limits"}, "spec": {"limits": [limit]}}
        scene.kube.create(scene.path("limitranges"), body)

    return make


def role_taken_away(scene: Scene) -> None:
    scene.kube.delete(scene.path("rolebindings", ACCOUNT))


REFUSED: dict[str, tuple[Callable[[Scene], None], Body, tuple[str, ...], float]] = {
    "an image that is not there": (
        nothing_done,
        {"image": "registry.invalid/none:1"},
        ("ErrImagePull", "registry.invalid/none:1"),
        45,
    ),
    "no name of an image": (nothing_done, {"image": "No:Name:1"}, ("InvalidImageName",), 15),
    "a quota": (no_pods_allowed, {}, ("exceeded quota", "none"), 15),
    "a quota that wants requests": (
        quota_on_requests,
        {"memory_request": 0},
        ("RequestsMissing", "must specify requests.memory", "fiber.init(cpu_request="),
        15,
    ),
    "a limit below the request": (
        limits(default="48Mi"),
        {},
        ("must be less than or equal to memory limit", "fiber.init(cpu_request=0"),
        15,
    ),
    "a request below the minimum": (
        limits(min="96Mi"),
        {},
        ("minimum memory usage per Container is 96Mi", "LimitRange"),
        15,
    ),
    "no right": (role_taken_away, {}, ("fiberpools", "fiber-user"), 10),
    "a namespace that is not there": (nothing_done, {"namespace": "nowhere"}, ("nowhere",), 10),
}
"""State before the program starts, its settings, its output, and its time limit."""


@pytest.mark.parametrize("case", REFUSED)
def test_an_impossible_request_fails_at_once(case: str, programs: Programs, scene: Scene) -> None:
    prepare, settings, words, seconds = REFUSED[case]
    prepare(scene)
    program = programs.start("outside", "mapping.py", **settings)
    program.says("began")
    output = program.ends(status=1, seconds=seconds)
    assert "FiberPoolError" in output
    assert all(word in output for word in words), output
    leaves_nothing(program)


def test_a_port_that_is_taken(programs: Programs, cluster: Cluster) -> None:
    with socket.socket() as taken:
        taken.bind((cluster.outside or "", 0))
        taken.listen()
        port = taken.getsockname()[1]
        program = programs.start("outside", "mapping.py", listen_port=port)
        output = program.ends(status=1)
    words = ("LinkError", f":{port}: another program uses that port", "choose another port")
    assert says(output, *words)
    leaves_nothing(program)


def test_a_program_without_an_operator_does_not_wait(programs: Programs, release: Release) -> None:
    release.stop()
    try:
        program = programs.start("outside", "mapping.py")
        program.says("began")
        program.prints("operator", seconds=15)  # a warning, before it is an error
        output = program.ends(status=1, seconds=45)
        assert "FiberPoolError" in output
        assert "helm install" in output
    finally:
        release.start()
    leaves_nothing(program)


@pytest.mark.usefixtures("bare_cluster")
def test_a_cluster_without_fiber(programs: Programs, cluster: Cluster) -> None:
    programs.kubeconfig = cluster.kubeconfig  # an administrator's: the role went with the rest
    program = programs.start("outside", "mapping.py")
    program.says("began")
    output = program.ends(status=1, seconds=15)
    assert "FiberPoolError" in output
    assert "helm install" in output


@pytest.fixture
def older_definition(scene: Scene, agent: Body) -> Iterator[None]:
    """FiberPools as they were before one of the fields that every program sets."""
    path = path_of("customresourcedefinitions", name=names.CRD_NAME)
    definition = scene.kube.get(path)
    assert definition is not None
    versions = definition["spec"]["versions"]
    older = copy.deepcopy(versions)
    del older[0]["schema"]["openAPIV3Schema"]["properties"]["spec"]["properties"]["onLost"]
    pool = Pool(scene, "probe").manifest(agent, onLost="Delete")
    scene.kube.patch(path, {"spec": {"versions": older}})
    scene.wait("the older one is served", lambda: not is_valid(scene, pool), poll=0.2)
    yield
    scene.kube.patch(path, {"spec": {"versions": versions}})
    scene.wait("the newer one is served", lambda: is_valid(scene, pool), poll=0.2)


def is_valid(scene: Scene, pool: Body) -> bool:
    strictly = {"dryRun": "All", "fieldValidation": "Strict"}
    try:
        scene.kube.create(scene.path("fiberpools"), pool, **strictly)
    except Refused:
        return False
    return True


@pytest.mark.usefixtures("older_definition")
def test_fiberpools_of_an_older_version(programs: Programs) -> None:
    program = programs.start("outside", "mapping.py")
    program.says("began")
    output = program.ends(status=1, seconds=15)
    assert all(word in output for word in ("FiberPoolError", "spec.onLost", "chart")), output
    leaves_nothing(program)


def test_a_second_program_learns_which_program_holds_a_pool(
    programs: Programs, scene: Scene, agent: Body
) -> None:
    warm = Pool(scene, "warm").apply(agent, minReplicas=2)
    there = warm.ready(2)
    work = ("--workers", 2, "--tasks", 60, "--stay")
    first = programs.start("outside", "mapping.py", *work, pool="warm")
    assert set(first.says("done")["hosts"]) <= set(there)
    identity = warm.body["spec"]["master"]["identity"]
    second = programs.start("outside", "mapping.py", pool="warm")
    second.says("began")
    output = second.ends(status=1, seconds=15)
    assert "FiberPoolError" in output
    assert identity in output
    first.interrupt()
    first.ends(-signal.SIGINT)
