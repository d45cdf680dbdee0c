"""Programs run on pods as they run on one machine, from within the cluster and from beside it."""

from __future__ import annotations

import re

import pytest

from e2e.clusters import Cluster
from e2e.delays import record
from e2e.kube import Body, path_of
from e2e.leftovers import leaves_nothing
from e2e.pools import Pool, is_live, is_ready
from e2e.program import PLACES, Program, Programs
from e2e.scene import Scene
from fiber_api import names

pytestmark = pytest.mark.timeout(240, func_only=True)

SQUARES = sum(number * number for number in range(1000))
GPU = "nvidia.com/gpu"


def workers(scene: Scene) -> list[Body]:
    """The pods of pools that are there."""
    return [pod for pod in scene.now["pods"].values() if is_worker(pod)]


def is_worker(pod: Body) -> bool:
    return names.LABEL_POOL in pod["metadata"].get("labels", {})


@pytest.mark.parametrize("place", PLACES)
def test_a_map_from_no_pods_to_none(place: str, programs: Programs, scene: Scene) -> None:
    program = programs.start(place, "mapping.py")
    done = program.says("done")
    assert done["total"] == SQUARES
    program.ends()
    leaves_nothing(program)
    assert set(done["hosts"]) <= ever(scene, "pods").keys()
    (pool,) = ever(scene, "fiberpools").values()
    assert pool["spec"]["minReplicas"] == 0
    assert scene.most_at_once(lambda pod: is_worker(pod) and is_live(pod)) == 3


@pytest.mark.parametrize("place", PLACES)
def test_processes_in_pods_keep_their_state(place: str, programs: Programs) -> None:
    program = programs.start(place, "stepping.py", "--envs", 4, "--steps", 100)
    assert program.says("done")["total"] == 4 * sum(range(100))
    assert program.says("left")["exitcodes"] == [0] * 4
    program.ends()
    leaves_nothing(program)


def test_output_has_the_pods_names_in_front(programs: Programs) -> None:
    program = programs.start("outside", "mapping.py", "--task", "loud", "--tasks", 60)
    program.ends()
    hosts = program.says("done")["hosts"]
    printed = [line for line in program.lines if re.search(r"task \d+ runs", line)]
    assert all(any(host in line for host in hosts) for line in printed), printed
    assert sorted(ran(program)) == list(range(60))


def test_only_the_first_pool_waits_for_pods(programs: Programs, scene: Scene) -> None:
    program = programs.start("outside", "pools.py", 4)
    program.ends(seconds=120)
    # A quick program has ended before Kubernetes calls its first worker Ready.
    first, *others = (said for said in program.said if said["event"] == "first")
    record("a first result of a program without pods", first["took"])
    for said in others:
        record("a first result on pods that are there", said["took"])
    assert len(list(filter(is_worker, ever(scene, "pods").values()))) <= 8
    leaves_nothing(program)


@pytest.mark.long
def test_pods_follow_the_work(programs: Programs, scene: Scene) -> None:
    """From none to fifty and back while the program goes on, and no task runs twice."""
    arguments = ("--task", "loud", "--tasks", 400, "--seconds", 1, "--most", 50, "--stay")
    program = programs.start("outside", "mapping.py", *arguments, idle_timeout=2)
    scene.wait("fifty workers", lambda: len(list(filter(is_ready, workers(scene)))) == 50, 180)
    program.says("done", seconds=120)
    assert sorted(ran(program)) == list(range(400))
    scene.wait("no worker", lambda: not workers(scene))
    assert all(ended_well(pool) for pool in scene.now["fiberpools"].values())
    program.interrupt()
    program.prints("KeyboardInterrupt")
    leaves_nothing(program)


@pytest.mark.parametrize("place", PLACES)
def test_two_programs_in_one_namespace(place: str, programs: Programs, scene: Scene) -> None:
    both = [programs.start(place, "mapping.py", "--workers", 2) for _ in range(2)]
    for program in both:
        assert program.says("done")["total"] == SQUARES
    for program in both:
        program.ends()
    scene.wait("no pool is left", lambda: not scene.now["fiberpools"])
    assert len(ever(scene, "fiberpools")) == 2


def test_each_shape_has_separate_pods(programs: Programs, scene: Scene) -> None:
    program = programs.start("outside", "shapes.py")
    program.ends()
    pods = [body for body in ever(scene, "pods").values() if is_worker(body)]
    limits = {pod["spec"]["containers"][0]["resources"]["limits"]["memory"] for pod in pods}
    assert limits == {"160Mi", "192Mi"}
    leaves_nothing(program)


def test_a_process_with_a_gpu_runs_on_a_node_that_has_one(
    programs: Programs, cluster: Cluster
) -> None:
    scene = programs.scene
    node = cluster.workers()[-1]
    path = path_of("nodes", name=node, subresource="status")
    scene.kube.patch(path, {"status": {"capacity": {GPU: "1"}}})
    try:
        program = programs.start("outside", "gpu.py")
        host = program.says("ran", seconds=90)["host"]
        pod = scene.wait("its pod is seen", lambda: ever(scene, "pods").get(host))
        assert pod is not None
        assert pod["spec"]["nodeName"] == node
        program.ends()
        leaves_nothing(program)
    finally:
        scene.kube.patch(path, {"status": {"capacity": {GPU: None}}})


def test_pods_pass_a_large_array_on(programs: Programs, scene: Scene) -> None:
    program = programs.start("outside", "broadcasting.py")
    done = program.says("done")
    assert done["right"]
    assert len(set(done["hosts"])) == 6
    assert 1 <= done["copies"] < 6
    program.ends()
    leaves_nothing(program)


def test_a_warm_pool_is_given_back_as_it_was(programs: Programs, scene: Scene, agent: Body) -> None:
    warm = Pool(scene, "warm").apply(agent, minReplicas=2)
    there = warm.ready(2)
    program = programs.start("outside", "mapping.py", "--workers", 2, pool="warm")
    assert program.says("done")["hosts"] == there
    program.ends()
    warm.wait("no master", lambda: "master" not in warm.body["spec"])
    assert warm.ready(2) == there


def ever(scene: Scene, resource: str) -> dict[str, Body]:
    """All objects of a kind that there were, as they were last seen."""
    moments = [moment for moment in list(scene.moments) if moment.resource == resource]
    return {moment.name: moment.object for moment in moments}


def ran(program: Program) -> list[int]:
    """The tasks that said that they run."""
    return [int(number) for number in re.findall(r"task (\d+) runs", program.output)]


def ended_well(pool: Body) -> bool:
    """Return whether no worker of the pool ever failed or was lost."""
    failures = pool["status"].get("failures", {})
    return not failures.get("total", 0) and not failures.get("disrupted", 0)
