"""A node that is drained: under a program's tasks, and under a warm pool with a budget."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from e2e.clusters import Cluster
from e2e.cordons import cordoned, uncordon
from e2e.kube import Body, Kube
from e2e.leftovers import leaves_nothing
from e2e.pools import Pool, is_ready
from e2e.program import Program, Programs
from e2e.scene import Scene
from e2e.test_program import ever, ran, workers
from e2e.test_program_faults import node_of
from fiber_api import names

pytestmark = pytest.mark.timeout(240, func_only=True)

WORKERS = 3


@contextmanager
def drained(scene: Scene, node: str) -> Iterator[set[str]]:
    """Drain the node as an administrator does, and yield the workers that were on it.

    All of them are gone then. The node takes pods again at the end.
    """
    pods = {pod["metadata"]["name"] for pod in workers(scene) if pod["spec"]["nodeName"] == node}
    # The workers alone: the operator may be on this node, too.
    chosen = ("--pod-selector", names.LABEL_POOL, "--delete-emptydir-data", "--timeout=50s")
    with cordoned(scene.kube, node):
        scene.kube.kubectl("drain", node, *chosen)
        scene.wait("they are gone", lambda: not pods & scene.now["pods"].keys())
        yield pods


def test_tasks_that_end_in_time_run_once(programs: Programs, scene: Scene) -> None:
    program = start(programs, tasks=9, seconds=5)
    _, busy = tasks_under_way(scene, program)[-1]
    with drained(scene, node_of(scene, busy)) as pods:
        assert program.says("done", seconds=90)["total"] == squares(9)
    assert sorted(ran(program)) == list(range(9))
    assert {ever(scene, "pods")[pod]["status"]["phase"] for pod in pods} == {"Succeeded"}
    program.ends()
    leaves_nothing(program)


@pytest.mark.parametrize(
    ("grace", "seconds"), [(6, 30), pytest.param(30, 60, marks=pytest.mark.long)]
)
def test_tasks_that_do_not_end_in_time_run_elsewhere(
    grace: int, seconds: int, programs: Programs, scene: Scene, tmp_path: Path
) -> None:
    """No task may be retried after a death, and each may be moved once."""
    template = tmp_path / "template.json"
    template.write_text(json.dumps({"spec": {"terminationGracePeriodSeconds": grace}}))
    program = start(programs, tasks=WORKERS, seconds=seconds, disruptions=1, template=template)
    began = tasks_under_way(scene, program)
    with drained(scene, node_of(scene, began[-1][1])) as pods:
        scene.wait("the status counts the linked workers", lambda: connected(scene), 60)
        done = program.says("done", seconds=90)
    assert done["total"] == squares(WORKERS)
    assert not pods & set(done["hosts"])
    assert Counter(ran(program)) == {task: 1 + (host in pods) for task, host in began}
    program.ends()
    leaves_nothing(program)


def test_a_budget_keeps_a_warm_pool_ready(pool: Pool, agent: Body, cluster: Cluster) -> None:
    """Drain one of two nodes: its worker goes once the other node has a replacement."""
    scene = pool.scene
    *others, node = cluster.workers()
    with cordoned(scene.kube, *others):
        before = pool.apply(agent, minReplicas=2, minAvailable=1).ready(2)
    with drained(scene, node) as pods:
        assert sorted(pods) == before
        pool.ready(2)
    came = scene.first("pods", lambda pod: name_of(pod) not in pods and is_ready(pod))
    went = sorted(scene.first("pods", partial(is_ending, name=name)) for name in pods)
    assert went[0] < came <= went[1]


def test_a_killed_test_leaves_no_node_cordoned(cluster: Cluster, kube: Kube) -> None:
    nodes = cluster.workers()
    killed = cordoned(kube, nodes[0])
    killed.__enter__()
    assert nodes[0] not in cluster.workers()
    uncordon(kube)  # as the next session begins
    assert cluster.workers() == nodes


def connected(scene: Scene) -> int:
    """Return the workers that are linked to the program, by its pool's status."""
    (pool,) = scene.now["fiberpools"].values()
    return int(pool.get("status", {}).get("connectedReplicas") or 0)


def is_ending(pod: Body, *, name: str) -> bool:
    return name_of(pod) == name and "deletionTimestamp" in pod["metadata"]


def name_of(pod: Body) -> str:
    return str(pod["metadata"]["name"])


def start(
    programs: Programs, *, tasks: int, seconds: int, disruptions: int = 0, **settings: object
) -> Program:
    """A program whose tasks say that they run, and are never to run again after a death."""
    limits = ("--retries", 0, "--disruptions", disruptions)
    work = ("--task", "loud", "--workers", WORKERS, "--tasks", tasks, "--seconds", seconds)
    return programs.start("outside", "mapping.py", *work, *limits, "--together", **settings)


def tasks_under_way(scene: Scene, program: Program) -> list[tuple[int, str]]:
    """Wait until each worker has begun a task; the tasks with their hosts, the latest last."""

    def begun() -> list[tuple[int, str]]:
        found = re.findall(r"@(\S+)\] task (\d+) runs", program.output)
        return [(int(task), host) for host, task in found]

    scene.wait(f"{WORKERS} tasks run", lambda: len(begun()) >= WORKERS, 90)
    return begun()


def squares(count: int) -> int:
    return sum(number * number for number in range(count))
