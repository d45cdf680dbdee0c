"""Deaths of pods under vector environments, executors and rings: the errors, and the work after."""

from __future__ import annotations

import re
import signal

import pytest

from e2e.clusters import Cluster
from e2e.kube import Body
from e2e.leftovers import leaves_nothing
from e2e.program import Program, Programs
from e2e.scene import Scene
from e2e.test_program_faults import LOST

pytestmark = pytest.mark.timeout(240, func_only=True)

VERDICT = 60
"""Seconds: a pod that is deleted has 30 of them to end."""


@pytest.fixture
def programs(programs: Programs, cluster: Cluster) -> Programs:
    """Programs in the image that has Gymnasium."""
    programs.image = cluster.images["fiber-worker-rl"]
    return programs


def delete(scene: Scene, pod: str) -> None:
    scene.kube.delete(scene.path("pods", pod))


def sent(program: Program) -> Body:
    """Return the program's report when two environments are done, and two others are not."""
    said = program.says("sent")
    assert said["steps"] == {"0": 2.0, "1": 2.0}
    assert said["truncated"] == {"0": False, "1": False}
    return said


def test_environments_whose_pod_is_deleted_are_made_anew(programs: Programs, scene: Scene) -> None:
    program = programs.start("outside", "environments.py", "--on-error", "restart")
    pod = sent(program)["hosts"][2]
    delete(scene, pod)
    received = program.says("received", seconds=VERDICT)
    assert received["truncated"] == {"2": True, "3": True}
    assert all(pod in told for told in received["restarted"].values()), received
    program.says("goes on")
    assert "environments 2 to 3 replaced: " in program.ends()
    leaves_nothing(program)


@pytest.mark.long
@pytest.mark.parametrize("place", ["outside", "inside"])
def test_environments_whose_pod_is_deleted_are_an_error(
    place: str, programs: Programs, scene: Scene
) -> None:
    program = programs.start(place, "environments.py")
    pod = sent(program)["hosts"][2]
    delete(scene, pod)
    lost = program.says("lost", seconds=VERDICT)
    assert lost["pod"] == pod
    for word in ("environments 2 to 3", "VectorEnv-worker-1", pod):
        assert word in lost["text"]
    program.ends()
    leaves_nothing(program)


@pytest.mark.long
def test_an_environment_that_needs_too_much_memory_is_named(programs: Programs) -> None:
    program = programs.start("outside", "environments.py", "--accident", "swell")
    sent(program)
    text = program.says("lost", seconds=VERDICT)["text"]
    assert "OOMKilled" in text
    assert "192Mi" in text
    program.ends()
    leaves_nothing(program)


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("swell",), ("OOMKilled", "192Mi")),
        (("crash",), ("SIGSEGV", "environments 2 to 3")),
        (("hang", "--timeout", 2), ("took longer than 2 s", "environments 2 to 3")),
    ],
    ids=["swell", "crash", "hang"],
)
def test_environments_that_end_their_worker_are_made_anew(
    arguments: tuple[object, ...], words: tuple[str, ...], programs: Programs
) -> None:
    restart = ("--on-error", "restart", "--accident")
    program = programs.start("outside", "environments.py", *restart, *arguments)
    sent(program)
    received = program.says("received", seconds=VERDICT)
    assert received["truncated"] == {"2": True, "3": True}
    assert all(word in told for told in received["restarted"].values() for word in words), received
    program.says("goes on")
    program.ends()
    leaves_nothing(program)


@pytest.mark.long
def test_a_learner_that_is_killed_takes_its_environments_with_it(programs: Programs) -> None:
    program = programs.start("outside", "environments.py")
    sent(program)
    program.kill()
    program.ends(status=-signal.SIGKILL)
    leaves_nothing(program, seconds=LOST + 30)


@pytest.mark.long
def test_a_learner_whose_pod_is_deleted_takes_its_environments_with_it(
    programs: Programs, scene: Scene
) -> None:
    program = programs.start("inside", "environments.py")
    sent(program)
    assert program.pod is not None
    scene.kube.delete(scene.path("pods", program.pod), {"gracePeriodSeconds": 0})
    leaves_nothing(program)


def test_a_task_whose_pod_is_deleted_runs_again(programs: Programs, scene: Scene) -> None:
    program = programs.start("outside", "executor.py", "--lose")
    delete(scene, waiting(program))
    assert program.says("done", seconds=VERDICT)["times"] == 2
    assert program.says("goes on")["result"] == 49
    program.ends()
    leaves_nothing(program)


@pytest.mark.long
def test_a_task_that_must_not_run_again_says_whose_pod_went(
    programs: Programs, scene: Scene
) -> None:
    program = programs.start("outside", "executor.py", "--lose", "--retries", 0)
    pod = waiting(program)
    delete(scene, pod)
    lost = program.says("lost", seconds=VERDICT)
    assert lost["kind"] == "WorkerDied"
    assert pod in lost["text"]
    assert program.says("goes on")["result"] == 49
    program.ends()
    leaves_nothing(program)


@pytest.mark.long
@pytest.mark.parametrize("place", ["outside", "inside"])
def test_the_members_of_a_ring_get_an_error_if_a_pod_is_deleted(
    place: str, programs: Programs, scene: Scene
) -> None:
    program = programs.start(place, "ring.py")
    hosts = {rank: host_of(program, f"member {rank} is in") for rank in range(4)}
    delete(scene, hosts[1])
    lost = program.says("lost", seconds=VERDICT)
    assert lost["rank"] == 1
    assert hosts[1] in lost["text"]
    program.ends()
    told = re.findall(r"member (\d) is told: (.*)", program.output)
    assert sorted(rank for rank, _ in told) == ["0", "2", "3"]
    assert all("member 1" in text and hosts[1] in text for _, text in told), told
    leaves_nothing(program)


def waiting(program: Program) -> str:
    return host_of(program, "a task waits in")


def host_of(program: Program, words: str) -> str:
    """The host that a line of the program ends with."""
    program.prints(words)
    found = re.search(rf"{words} (\S+)\.$", program.output, re.MULTILINE)
    assert found is not None
    return found[1]
