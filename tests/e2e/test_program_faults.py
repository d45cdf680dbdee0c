"""Faults in the middle of a program: it ends right, or with the right error, in time."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest

from e2e.clusters import Cluster
from e2e.faults import OUTAGE, Trouble, api_server_stopped
from e2e.kube import Body
from e2e.leftovers import leaves_nothing
from e2e.pools import is_ready
from e2e.program import PLACES, Program, Programs
from e2e.release import Release
from e2e.scene import Scene
from e2e.test_program import SQUARES, ever, is_worker, workers
from fiber_api import names

pytestmark = pytest.mark.timeout(300, func_only=True)

RUNNING = ("--seconds", 0.1)
"""Arguments for 1,000 tasks on three workers: half a minute in which a fault can strike."""
LOST = 30 + 60
"""Seconds after which a program that is gone without a word is lost: its Lease and the grace."""
SILENCE = 15
"""Seconds without messages after which a worker is lost."""
BRIEF = 8
"""Seconds of silence that cause no loss."""


class OperatorTrouble(Trouble):
    """Trouble that may strike the operator, too."""

    def __init__(self, cluster: Cluster, release: Release, scene: Scene, program: Program) -> None:
        super().__init__(cluster, scene, program)
        self.release = release

    def a_worker(self) -> Body:
        """A pod that works."""
        ready = self.scene.wait(
            "a worker is Ready", lambda: list(filter(is_ready, workers(self.scene)))
        )
        return ready[0]

    def a_node(self) -> str:
        """A node with workers, and neither the program nor the operator."""
        spared = {self.release.pod()["spec"]["nodeName"]}
        if self.program.pod:
            spared.add(self.scene.now["pods"][self.program.pod]["spec"]["nodeName"])
        nodes = {pod["spec"]["nodeName"] for pod in workers(self.scene)} - spared
        if not nodes:
            pytest.skip("every node with workers has the program or the operator, too")
        return str(nodes.pop())

    def gone(self, pod: Body) -> None:
        """Wait until the pod is no more."""
        name = pod["metadata"]["name"]
        self.scene.wait(f"{name} is gone", lambda: name not in self.scene.now["pods"])


Fault = Callable[[OperatorTrouble], AbstractContextManager[None]]


@contextmanager
def pod_deleted(trouble: OperatorTrouble) -> Iterator[None]:
    victim = trouble.a_worker()
    trouble.scene.kube.delete(trouble.scene.path("pods", victim["metadata"]["name"]))
    trouble.gone(victim)
    yield


@contextmanager
def container_killed(trouble: OperatorTrouble) -> Iterator[None]:
    trouble.cluster.kill(trouble.a_worker(), names.WORKER_CONTAINER)
    yield


@contextmanager
def operator_killed(trouble: OperatorTrouble) -> Iterator[None]:
    trouble.cluster.kill(trouble.release.pod(), "operator")
    yield
    trouble.release.wait_until_ready()


@contextmanager
def node_cut_off(trouble: OperatorTrouble) -> Iterator[None]:
    """Until the work is done elsewhere."""
    with trouble.cluster.cut_off(trouble.a_node()):
        trouble.program.says("done", seconds=90)
        yield


@contextmanager
def node_back_in_time(trouble: OperatorTrouble) -> Iterator[None]:
    """Before its workers count as lost."""
    with trouble.cluster.cut_off(trouble.a_node()):
        trouble.lasts(BRIEF)
    trouble.program.says("done", seconds=90)
    assert len(list(filter(is_worker, ever(trouble.scene, "pods").values()))) <= 3
    yield


@contextmanager
def node_back_too_late(trouble: OperatorTrouble) -> Iterator[None]:
    """Reconnect a node after its workers were lost: their late results do not count."""
    with trouble.cluster.cut_off(trouble.a_node()):
        trouble.lasts(SILENCE + 10)
    yield


@pytest.mark.parametrize("place", ["outside", pytest.param("inside", marks=pytest.mark.long)])
@pytest.mark.parametrize(
    ("fault", "seconds"),
    [
        (pod_deleted, 0.06),
        (container_killed, 0.06),
        (operator_killed, 0.04),
        pytest.param(api_server_stopped, 0.25, marks=pytest.mark.long),
        pytest.param(node_cut_off, 0.1, marks=pytest.mark.long),
        pytest.param(node_back_in_time, 0.1, marks=pytest.mark.long),
        pytest.param(node_back_too_late, 0.25, marks=pytest.mark.long),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_map_survives_a_fault_unchanged(
    fault: Fault,
    seconds: float,
    place: str,
    programs: Programs,
    cluster: Cluster,
    release: Release,
    scene: Scene,
) -> None:
    programs.node = release.pod()["spec"]["nodeName"]  # the other ones are there for faults
    program = programs.start(place, "mapping.py", "--seconds", seconds)
    program.says("first")
    with fault(OperatorTrouble(cluster, release, scene, program)):
        assert program.says("done", seconds=120)["total"] == SQUARES
    program.ends(seconds=90)
    leaves_nothing(program, seconds=90)


@pytest.mark.long
def test_a_program_that_ends_without_an_api_server_names_the_leftovers(
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


def test_a_task_that_needs_too_much_memory_is_named(programs: Programs) -> None:
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


@pytest.mark.long
def test_a_vector_environment_stands_still_while_a_node_is_cut_off(
    programs: Programs, cluster: Cluster, scene: Scene
) -> None:
    program = programs.start("outside", "stepping.py", "--steps", 2000)
    host = program.says("stepping")["hosts"][0]
    with cluster.cut_off(node_of(scene, host)):
        scene.never("it ends", lambda: program.status is not None, BRIEF)
    assert program.says("done")["total"] == 4 * sum(range(2000))
    program.ends()
    leaves_nothing(program)


@pytest.mark.long
def test_a_vector_environment_whose_node_is_cut_off_for_long(
    programs: Programs, cluster: Cluster, scene: Scene
) -> None:
    program = programs.start("outside", "stepping.py", "--steps", 3000)
    hosts = program.says("stepping")["hosts"]
    node = node_of(scene, hosts[0])
    with cluster.cut_off(node):
        lost = program.says("lost", seconds=SILENCE + 10)
        assert any(host in lost["text"] and node_of(scene, host) == node for host in hosts)
        assert None not in program.says("left")["exitcodes"]
    program.ends()
    leaves_nothing(program, seconds=90)


def node_of(scene: Scene, pod: str) -> str:
    return str(scene.now["pods"][pod]["spec"]["nodeName"])


# -- The program itself


@pytest.mark.long
@pytest.mark.parametrize("place", PLACES)
def test_a_killed_program_leaves_no_objects_after_its_grace(place: str, programs: Programs) -> None:
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
