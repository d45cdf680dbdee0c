"""Programs on a laptop, which no pod reaches: Fiber finds that out, and starts a relay."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager

import pytest

from cluster.laptop import Laptop
from e2e.accounts import may_not
from e2e.clusters import Cluster
from e2e.faults import OUTAGE, Trouble, api_server_stopped
from e2e.kube import Body
from e2e.leftovers import leaves_nothing
from e2e.pools import is_ready
from e2e.program import Outside, Programs, local
from e2e.scene import Scene
from e2e.test_examples import ENVS, ES, ES_LINES, PPO, RETURNS, beginning
from e2e.test_program import SQUARES
from fiber_api import names

pytestmark = pytest.mark.timeout(300, func_only=True)

STRANGERS = 1000
PODS = 60
"""Workers, as many as two nodes on a small machine start within minutes."""
RELAY_BUDGET = 150 << 20
"""Bytes of a relay with 200 agents, and so with fewer."""


@pytest.fixture
def laptop(cluster: Cluster, programs: Programs) -> Iterator[Laptop]:
    with cluster.laptop() as made:
        programs.laptop = made
        yield made


def relays(scene: Scene) -> list[Body]:
    """Return the pods of relays that are Ready."""
    pods = scene.now["pods"].values()
    return [pod for pod in pods if names.LABEL_RELAY in pod["metadata"]["labels"] and is_ready(pod)]


@pytest.mark.parametrize(
    ("script", "arguments", "results"),
    [
        ("02-es/main.py", (*ES, "--out", "/tmp/learning-curve.png"), ES_LINES),
        pytest.param(
            "03-vector-env/piped.py", ENVS, beginning(r".*episodes ended.*"), marks=pytest.mark.long
        ),
        pytest.param("04-vector/train_ppo.py", PPO, RETURNS, marks=pytest.mark.long),
    ],
    ids=["es", "piped", "ppo"],
)
def test_an_example_prints_the_same_as_on_one_machine(
    script: str,
    arguments: tuple[object, ...],
    results: Callable[[list[str]], list[str]],
    programs: Programs,
    laptop: Laptop,
) -> None:
    program = programs.on_laptop(script, *arguments)
    lines = program.ends(seconds=120).splitlines()
    assert any("starts a relay in the cluster" in line for line in lines)
    expected = results(local(script, *arguments))
    assert expected
    assert results(lines) == expected
    leaves_nothing(program)


class LaptopTrouble(Trouble):
    """Trouble that may strike the laptop of the program, too."""

    program: Outside

    def __init__(self, cluster: Cluster, laptop: Laptop, scene: Scene, program: Outside) -> None:
        super().__init__(cluster, scene, program)
        self.laptop = laptop


Fault = Callable[[LaptopTrouble], AbstractContextManager[None]]


@contextmanager
def relay_killed(trouble: LaptopTrouble) -> Iterator[None]:
    (pod,) = relays(trouble.scene)
    trouble.cluster.kill(pod, names.RELAY_CONTAINER)
    yield


@contextmanager
def relay_deleted(trouble: LaptopTrouble) -> Iterator[None]:
    (pod,) = relays(trouble.scene)
    name = pod["metadata"]["name"]
    trouble.scene.kube.delete(trouble.scene.path("pods", name), {"gracePeriodSeconds": 0})
    yield


@contextmanager
def address_changed(trouble: LaptopTrouble) -> Iterator[None]:
    trouble.laptop.move()
    yield


@contextmanager
def cable_cut_and_address_changed(trouble: LaptopTrouble) -> Iterator[None]:
    with trouble.laptop.unplugged():
        trouble.lasts(OUTAGE)
    trouble.laptop.move()
    yield


@contextmanager
def program_stopped(trouble: LaptopTrouble) -> Iterator[None]:
    trouble.program.pause()
    trouble.lasts(OUTAGE)
    trouble.program.resume()
    yield


@pytest.mark.parametrize(
    ("fault", "seconds"),
    [
        (relay_killed, 0.06),
        pytest.param(relay_deleted, 0.04, marks=pytest.mark.long),
        (address_changed, 0.06),
        pytest.param(cable_cut_and_address_changed, 0.25, marks=pytest.mark.long),
        pytest.param(api_server_stopped, 0.25, marks=pytest.mark.long),
        pytest.param(program_stopped, 0.25, marks=pytest.mark.long),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_map_survives_a_fault_unchanged(
    fault: Fault,
    seconds: float,
    programs: Programs,
    laptop: Laptop,
    cluster: Cluster,
    scene: Scene,
) -> None:
    program = programs.on_laptop("mapping.py", "--task", "loud", "--seconds", seconds)
    program.says("first")
    with fault(LaptopTrouble(cluster, laptop, scene, program)):
        assert program.says("done", seconds=180)["total"] == SQUARES
    program.ends(seconds=90)
    # Links resumed: no task was lost with its worker, so none ran twice.
    runs = [line for line in program.lines if line.endswith(" runs")]
    assert len(runs) == len({line.rpartition("]")[2] for line in runs})
    leaves_nothing(program, seconds=90)


@pytest.mark.long
@pytest.mark.timeout(600, func_only=True)
def test_one_relay_carries_the_agents_of_many_pods(
    programs: Programs, laptop: Laptop, scene: Scene
) -> None:
    settings = {"relay": "always", "cpu_request": 0, "memory_request": 0}
    program = programs.on_laptop(
        "mapping.py", "--workers", PODS, "--tasks", 6000, "--seconds", 0.2, **settings
    )
    (relay,) = scene.wait("a relay is ready", lambda: relays(scene), 60)

    def workers() -> bool:
        pods = scene.now["pods"].values()
        ours = [pod for pod in pods if names.LABEL_RELAY not in pod["metadata"]["labels"]]
        return len([pod for pod in ours if is_ready(pod)]) == PODS

    scene.wait(f"{PODS} agents are connected", workers, 300)
    status = ("--namespace", scene.namespace, "exec", relay["metadata"]["name"], "--")
    used = resident(scene.kube.kubectl(*status, "cat", "/proc/1/status"))
    done = program.says("done", seconds=240)
    assert done["total"] == sum(number * number for number in range(6000))
    assert len(done["hosts"]) == PODS
    assert used <= RELAY_BUDGET
    program.ends()
    leaves_nothing(program, seconds=120)


def resident(status: str) -> int:
    """Return the resident memory in bytes that ``/proc/PID/status`` has."""
    (line,) = [line for line in status.splitlines() if line.startswith("VmRSS:")]
    return int(line.split()[1]) << 10


def test_two_programs_each_have_a_relay(programs: Programs, laptop: Laptop, scene: Scene) -> None:
    both = [programs.on_laptop("mapping.py", "--workers", 2, relay="always") for _ in range(2)]
    for program in both:
        program.says("first")
    assert len(relays(scene)) == 2
    for program in both:
        assert program.says("done")["total"] == SQUARES
        program.ends()
    leaves_nothing(both[0])


def test_a_thousand_strangers_at_the_relay_delay_nobody_for_long(
    programs: Programs, laptop: Laptop, scene: Scene
) -> None:
    program = programs.on_laptop("mapping.py", "--seconds", 0.04, relay="always")
    program.says("first")
    (pod,) = relays(scene)
    where = (pod["status"]["podIP"], names.MASTER_PORT)
    with ExitStack() as strangers:
        for _ in range(STRANGERS):
            strangers.enter_context(socket.create_connection(where, timeout=10))
        assert program.says("done")["total"] == SQUARES
    program.ends()
    leaves_nothing(program)


def test_an_account_that_may_open_no_port_forward_is_told(
    programs: Programs, laptop: Laptop, scene: Scene
) -> None:
    may_not(scene, "pods/portforward")
    program = programs.on_laptop("mapping.py")
    output = program.ends(status=1)
    assert "pods/portforward" in output
    assert "Traceback (most recent call last)" in output  # of the program, which gets the error
    leaves_nothing(program)
