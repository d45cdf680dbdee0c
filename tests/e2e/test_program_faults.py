"""What goes wrong in the middle of a program: it ends right, or with the right error, in time."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

from e2e.accounts import ACCOUNT, may_read_credentials, write_kubeconfig
from e2e.clusters import Cluster
from e2e.kube import Body
from e2e.leftovers import leaves_nothing
from e2e.pools import Pool, is_ready
from e2e.program import PLACES, Program, Programs
from e2e.release import Release
from e2e.scene import Scene
from e2e.test_program import SQUARES, ever, is_worker, workers
from fiber_api import names

pytestmark = pytest.mark.timeout(300, func_only=True)

RUNNING = ("--seconds", 0.1)
"""1,000 tasks on three workers: half a minute, in which a fault can strike."""
LOST = 30 + 60
"""Seconds after which a program that is gone without a word is lost: its Lease and the grace."""
OUTAGE = 60
"""Seconds."""


class Site:
    """Where a fault strikes: the cluster, what is installed on it, and a program that runs."""

    def __init__(self, cluster: Cluster, release: Release, scene: Scene, program: Program) -> None:
        self.cluster = cluster
        self.release = release
        self.scene = scene
        self.program = program

    def a_worker(self) -> Body:
        """A pod that works."""
        ready = self.scene.wait(
            "a worker is Ready", lambda: list(filter(is_ready, workers(self.scene)))
        )
        return ready[0]

    def gone(self, pod: Body) -> None:
        """Wait until the pod is no more."""
        name = pod["metadata"]["name"]
        self.scene.wait(f"{name} is gone", lambda: name not in self.scene.now["pods"])


Fault = Callable[[Site], AbstractContextManager[None]]


@contextmanager
def pod_deleted(site: Site) -> Iterator[None]:
    victim = site.a_worker()
    site.scene.kube.delete(site.scene.path("pods", victim["metadata"]["name"]))
    site.gone(victim)
    yield


@contextmanager
def container_killed(site: Site) -> Iterator[None]:
    site.cluster.kill(site.a_worker(), names.WORKER_CONTAINER)
    yield


@contextmanager
def operator_killed(site: Site) -> Iterator[None]:
    site.cluster.kill(site.release.pod(), "operator")
    yield
    site.release.wait_until_ready()


@contextmanager
def api_server_stopped(site: Site) -> Iterator[None]:
    """For a minute, in which the work goes on."""
    with site.cluster.without_apiserver():
        site.scene.never("it ends", lambda: site.program.status is not None, OUTAGE)
    yield


@contextmanager
def node_cut_off(site: Site) -> Iterator[None]:
    """A node with workers, and neither the program nor the operator, for as long as agents wait."""
    pods = site.scene.now["pods"]
    spared = {site.release.pod()["spec"]["nodeName"]}
    if site.program.pod:
        spared.add(pods[site.program.pod]["spec"]["nodeName"])
    nodes = {pod["spec"]["nodeName"] for pod in workers(site.scene)} - spared
    if not nodes:
        pytest.skip("every node with workers has the program or the operator, too")
    with site.cluster.cut_off(nodes.pop()):
        site.program.says("done", seconds=90)
        yield


@pytest.mark.parametrize("place", ["outside", pytest.param("inside", marks=pytest.mark.long)])
@pytest.mark.parametrize(
    ("fault", "seconds"),
    [
        (pod_deleted, 0.1),
        (container_killed, 0.1),
        (operator_killed, 0.1),
        pytest.param(api_server_stopped, 0.25, marks=pytest.mark.long),
        pytest.param(node_cut_off, 0.1, marks=pytest.mark.long),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_map_ends_as_if_nothing_had_been(
    fault: Fault,
    seconds: float,
    place: str,
    programs: Programs,
    cluster: Cluster,
    release: Release,
    scene: Scene,
) -> None:
    program = programs.start(place, "mapping.py", "--seconds", seconds)
    program.says("first")
    with fault(Site(cluster, release, scene, program)):
        assert program.says("done", seconds=120)["total"] == SQUARES
    program.ends(seconds=90)
    leaves_nothing(program, seconds=90)


@pytest.mark.long
def test_a_program_that_ends_while_nobody_answers_says_what_stays(
    programs: Programs, cluster: Cluster
) -> None:
    program = programs.outside("mapping.py", *RUNNING)
    program.says("half")
    with cluster.without_apiserver():
        assert "kubectl" in program.ends(seconds=OUTAGE)
    leaves_nothing(program, seconds=LOST + 30)


def test_a_child_that_is_killed_is_replaced_in_its_pod(programs: Programs, scene: Scene) -> None:
    program = programs.start("outside", "mapping.py", "--task", "kill")
    assert program.says("done")["total"] == SQUARES
    assert len(list(filter(is_worker, ever(scene, "pods").values()))) <= 3
    program.ends()
    leaves_nothing(program)


def test_a_task_that_needs_too_much_memory_is_told_so(programs: Programs) -> None:
    program = programs.start("outside", "mapping.py", "--task", "swell", "--retries", 1)
    output = program.ends(status=1, seconds=90)
    assert all(word in output for word in ("WorkerDied", "OOMKilled", "160Mi")), output
    leaves_nothing(program)


def test_a_vector_environment_whose_pod_is_deleted(programs: Programs, scene: Scene) -> None:
    program = programs.start("outside", "stepping.py", "--steps", 3000)
    victim = program.says("stepping")["hosts"][0]
    scene.kube.delete(scene.path("pods", victim))
    lost = program.says("lost", seconds=40)
    assert victim in lost["text"]
    assert None not in program.says("left")["exitcodes"]
    program.ends()
    leaves_nothing(program)


# -- The program itself


@pytest.mark.may_leak("a process that is killed cannot remove its temporary folder")
@pytest.mark.long
@pytest.mark.parametrize("place", PLACES)
def test_a_program_that_is_killed_leaves_nothing_after_its_grace(
    place: str, programs: Programs
) -> None:
    program = programs.start(place, "mapping.py", *RUNNING)
    program.says("first")
    program.kill()
    program.ends(status=137 if place == "inside" else -signal.SIGKILL)
    leaves_nothing(program, seconds=LOST + 30)


def test_a_program_whose_pod_is_deleted_takes_all_with_it(programs: Programs, scene: Scene) -> None:
    program = programs.start("inside", "mapping.py", *RUNNING)
    program.says("first")
    assert program.pod is not None
    scene.kube.delete(scene.path("pods", program.pod), {"gracePeriodSeconds": 0})
    leaves_nothing(program)


@pytest.mark.parametrize("place", PLACES)
def test_an_interrupt_ends_it_all(place: str, programs: Programs) -> None:
    program = programs.start(place, "mapping.py", *RUNNING)
    program.says("first")
    program.interrupt()
    status = 128 + signal.SIGINT if place == "inside" else -signal.SIGINT
    assert "KeyboardInterrupt" in program.ends(status, seconds=20)
    leaves_nothing(program)


@pytest.mark.long
@pytest.mark.parametrize("place", PLACES)
def test_an_interpreter_that_is_held_goes_on(place: str, programs: Programs) -> None:
    program = programs.start(place, "mapping.py", *RUNNING, "--hold", 40)
    assert program.says("done", seconds=150)["total"] == SQUARES
    program.ends()
    leaves_nothing(program)


@pytest.mark.long
def test_a_program_that_is_stopped_and_continued_goes_on(programs: Programs, scene: Scene) -> None:
    program = programs.outside("mapping.py", *RUNNING)
    program.says("first")
    program.pause()
    scene.never("a program that is stopped is lost", lambda: not scene.now["fiberpools"], 30)
    program.resume()
    assert program.says("done", seconds=120)["total"] == SQUARES
    program.ends()
    leaves_nothing(program)


# -- What cannot be


def nothing_done(_: Scene) -> None: ...


def no_pods_allowed(scene: Scene) -> None:
    hard = {"metadata": {"name": "none"}, "spec": {"hard": {"pods": "0"}}}
    scene.kube.create(scene.path("resourcequotas"), hard)


def role_taken_away(scene: Scene) -> None:
    scene.kube.delete(scene.path("rolebindings", ACCOUNT))


REFUSED = {
    "an image that is not there": (
        nothing_done,
        {"image": "registry.invalid/none:1"},
        ("ErrImagePull", "registry.invalid/none:1"),
        45,
    ),
    "no name of an image": (nothing_done, {"image": "No:Name:1"}, ("InvalidImageName",), 15),
    "a quota": (no_pods_allowed, {}, ("exceeded quota", "none"), 15),
    "no right": (role_taken_away, {}, ("fiberpools", "fiber-user"), 10),
    "a namespace that is not there": (nothing_done, {"namespace": "nowhere"}, ("nowhere",), 10),
}
"""What is so before the program starts, what it is told, what it says, and within how long."""


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_come_is_an_error_at_once(case: str, programs: Programs, scene: Scene) -> None:
    prepare, settings, words, seconds = REFUSED[case]
    prepare(scene)
    program = programs.start("outside", "mapping.py", **settings)
    output = program.ends(status=1, seconds=seconds)
    assert "FiberPoolError" in output
    assert all(word in output for word in words), output
    leaves_nothing(program)


def test_a_token_that_is_not_taken(programs: Programs, scene: Scene, tmp_path: Path) -> None:
    programs.kubeconfig = write_kubeconfig(scene, tmp_path / "expired", "expired")
    output = programs.start("outside", "mapping.py").ends(status=1, seconds=15)
    assert "FiberPoolError" in output
    assert "Unauthorized" in output


def test_without_an_operator_nobody_waits(programs: Programs, release: Release) -> None:
    release.stop()
    try:
        program = programs.start("outside", "mapping.py")
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
    output = programs.start("outside", "mapping.py").ends(status=1, seconds=15)
    assert "FiberPoolError" in output
    assert "helm install" in output


def test_a_second_program_is_told_who_holds_a_pool(
    programs: Programs, scene: Scene, agent: Body
) -> None:
    warm = Pool(scene, "warm").apply(agent, minReplicas=2)
    may_read_credentials(scene, "warm")
    there = warm.ready(2)
    first = programs.start("outside", "mapping.py", "--workers", 2, *RUNNING, pool="warm")
    first.says("first")
    identity = warm.body["spec"]["master"]["identity"]
    output = programs.start("outside", "mapping.py", pool="warm").ends(status=1, seconds=15)
    assert "FiberPoolError" in output
    assert identity in output
    assert first.says("done", seconds=90)["hosts"] == there
    first.ends()
