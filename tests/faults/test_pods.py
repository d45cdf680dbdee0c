"""A program whose processes are pods: the whole way, on a cluster played in this process."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np
import pytest

import fiber
from fakes.cluster import FakeCluster
from faults import drained
from faults.program import Program
from faults.proxy import Proxy
from faults.runtime import running
from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.provisioner import _local_address
from fiber._runtime import state
from fiber.errors import ConfigError, FiberPoolError, MemberLost, WorkerDied
from fiber_api import names
from patience import PATIENCE
from ports import reserved_port

KEPT = ("fiberpools", "pods", "secrets", "leases", "services", "endpointslices")
OPERATORS = {names.operator_lease_name("fiber-operator"), names.SERVING_LEASE}
"""Leases that stay."""


pytestmark = [
    pytest.mark.may_leak("the operator's connections, for as long as the cluster is there"),
]


cluster = drained.played_cluster


@pytest.fixture(autouse=True)
def _nothing_is_left(cluster: FakeCluster) -> Iterator[None]:
    yield
    cluster.nodes.fails_with = None
    cluster.nodes.cut_off = False

    def left() -> set[str]:
        found = [object_ for plural in KEPT for object_ in cluster.world.store.list(plural)]
        return {object_["metadata"]["name"] for object_ in found} - OPERATORS

    cluster.wait(lambda: not left())
    assert cluster.take_forced() == []


def pods_of(cluster: FakeCluster) -> list[str]:
    return [pod["metadata"]["name"] for pod in cluster.objects("pods")]


@pytest.fixture
def port() -> Iterator[int]:
    """A port at which a program can listen again, for its next FiberPool."""
    with reserved_port() as found:
        yield found


def square(number: int) -> int:
    return number * number


def own_pod(_: object = None) -> str:
    return os.environ[names.ENV_NAME]


shared: list[Any] = []


def share(*memory: Any) -> None:
    shared[:] = memory


def add_turn(index: int) -> None:
    sums, turn = shared
    sums[index] += turn.value


def acquire_and_die(lock: Any) -> None:
    lock.acquire()
    os.kill(os.getpid(), signal.SIGKILL)


def acquired_after(process: fiber.Process, lock: Any) -> Any:
    process.start()
    process.join(PATIENCE)
    return lock.acquire(timeout=PATIENCE)


def wait_twice(barrier: Any) -> None:
    barrier.wait(PATIENCE)
    signal.pause()


def slow_square(number: int) -> int:
    time.sleep(0.02)
    return number * number


def die(how: int) -> None:
    os.kill(os.getpid(), how)


def say(word: str) -> None:
    print(word, flush=True)


def send(channel: Any, word: str) -> None:
    channel.send(word)


def send_and_wait(channel: Any, word: str) -> None:
    channel.send(word)
    time.sleep(PATIENCE)


def hear(channel: Any) -> None:
    channel.recv()


def test_a_pool_is_pods_that_come_with_the_work_and_go_with_the_program(
    cluster: FakeCluster,
) -> None:
    with running(backend="kubernetes"), fiber.Pool(2) as pool:
        assert pods_of(cluster) == []
        assert pool.map(square, range(100)) == [n * n for n in range(100)]
        pool.wait_until_workers_up(PATIENCE)
        assert sorted(info.host for info in pool.workers()) == pods_of(cluster)
        assert {info.node for info in pool.workers()} == {"node-1"}
        assert sum(info.tasks for info in pool.workers()) == 100


def test_a_program_without_an_image_is_told_before_any_pod_is_made(
    cluster: FakeCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FIBER_IMAGE")
    with (
        running(backend="kubernetes"),
        fiber.Pool(2) as pool,
        pytest.raises(ConfigError, match=r"no image for workers: .*development build.*FIBER_IMAGE"),
    ):
        pool.map(square, range(10))


def test_pods_share_memory_with_the_program_and_each_other(cluster: FakeCluster) -> None:
    with running(backend="kubernetes"):
        sums, turn = fiber.RawArray("i", 20), fiber.RawValue("i", 0)
        with fiber.Pool(2, share, (sums, turn)) as pool:
            for number in range(1, 4):
                turn.value = number
                pool.map(add_turn, range(20), chunksize=1)
        assert list(sums) == [6] * 20


def test_gymnasium_has_its_observations_in_memory_that_pods_share(cluster: FakeCluster) -> None:
    import gymnasium
    from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

    makes = [partial(gymnasium.make, "CartPole-v1")] * 2
    with (
        running(backend="kubernetes"),
        fiber.adopt("gymnasium.vector.async_vector_env"),
        closing(SyncVectorEnv(makes)) as here,
        closing(AsyncVectorEnv(makes, shared_memory=True)) as there,
    ):
        assert pods_of(cluster)
        assert np.array_equal(here.reset(seed=1)[0], there.reset(seed=1)[0])
        for action in (0, 1, 1, 0):
            actions = np.full(2, action)
            assert np.array_equal(here.step(actions)[0], there.step(actions)[0])


def test_a_killed_process_of_a_pod_releases_its_locks(cluster: FakeCluster) -> None:
    with running(backend="kubernetes"):
        lock = fiber.Lock()
        process = fiber.Process(target=acquire_and_die, args=(lock,))
        died = rf"{process.name} \(pid \d+ on .*ended while it held"
        with pytest.warns(RuntimeWarning, match=died):
            acquired = acquired_after(process, lock)
        assert isinstance(acquired, fiber.synchronize.Abandoned)
        assert process.name in acquired.holder


def test_a_barrier_is_broken_if_a_pod_of_its_parties_is_deleted(cluster: FakeCluster) -> None:
    with running(backend="kubernetes"):
        barrier = fiber.Barrier(2)
        process = fiber.Process(target=wait_twice, args=(barrier,))
        process.start()
        assert barrier.wait(PATIENCE) in (0, 1)
        (pod,) = pods_of(cluster)
        cluster.do(cluster.world.store.delete, "pods", "lab", pod)
        with pytest.raises(threading.BrokenBarrierError, match="a process that took part has died"):
            barrier.wait(PATIENCE)
        process.join(PATIENCE)


def test_the_next_pool_begins_on_pods_that_are_there(cluster: FakeCluster) -> None:
    with running(backend="kubernetes"):
        with fiber.Pool(2) as pool:
            first = set(pool.map(own_pod, range(20), chunksize=1))
        before = pods_of(cluster)
        with fiber.Pool(2) as pool:
            second = set(pool.map(own_pod, range(20), chunksize=1))
        assert pods_of(cluster) == before
        assert first | second <= set(before)
        assert len(cluster.objects("fiberpools")) == 1


def test_idle_pods_are_released_by_name(cluster: FakeCluster) -> None:
    with running(backend="kubernetes", idle_timeout=0.2):
        with fiber.Pool(2) as pool:
            pool.map(square, range(10))
        cluster.wait(lambda: not cluster.world.pods("lab"))
        (fiber_pool,) = cluster.objects("fiberpools")
        assert fiber_pool["spec"]["replicas"] == 0
        with fiber.Pool(1) as pool:  # and others come when there is work again
            assert pool.apply(square, (3,)) == 9


def test_functions_with_greater_needs_run_in_other_pods(cluster: FakeCluster) -> None:
    with running(backend="kubernetes"):
        large = fiber.meta(cpu=0.5, memory=64)(square)
        with fiber.Pool(1) as pool, fiber.Pool(1) as other:
            assert pool.apply(square, (2,)) == other.apply(large, (2,)) == 4
            with pytest.raises(ValueError, match="Make another pool"):
                pool.apply(large, (2,))
        templates = [pool["spec"]["template"] for pool in cluster.objects("fiberpools")]
        workers = [template["spec"]["containers"][0] for template in templates]
        assert {str(worker.get("resources", {}).get("limits")) for worker in workers} == {
            "None",
            "{'cpu': '500m', 'memory': '64Mi'}",
        }


def test_an_executors_tasks_run_in_pods_as_their_options_say(cluster: FakeCluster) -> None:
    with running(backend="kubernetes"), fiber.Executor(1) as executor:
        large = executor.options(cpu=0.5, memory="64Mi")
        pod, other = executor.submit(own_pod).result(PATIENCE), large.submit(own_pod)
        assert {pod, other.result(PATIENCE)} == set(pods_of(cluster))
        assert pod != other.result()
        assert set(large.map(own_pod, range(5))) == {other.result()}
        templates = [pool["spec"]["template"] for pool in cluster.objects("fiberpools")]
        workers = [template["spec"]["containers"][0] for template in templates]
        assert {"cpu": "500m", "memory": "64Mi"} in [
            worker.get("resources", {}).get("limits") for worker in workers
        ]


def test_an_executors_task_that_dies_with_its_pod_says_so(cluster: FakeCluster) -> None:
    with running(backend="kubernetes"), fiber.Executor(1) as executor:
        pod = executor.submit(own_pod).result(PATIENCE)
        future = executor.options(retries=0).submit(time.sleep, PATIENCE)
        cluster.wait(future.running)
        cluster.do(cluster.nodes.kill, pod)
        with pytest.raises(BrokenProcessPool, match="OOMKilled") as caught:
            future.result(PATIENCE)
        assert isinstance(caught.value, WorkerDied)


def stay_in_ring(channel: Any, rank: int, size: int) -> None:
    member = fiber.ring.current()
    for step in itertools.count():
        pod = member.exchange(own_pod())
        if rank == 0 and step == 0:
            channel.send(pod)


def test_a_rings_members_are_in_pods_and_get_an_error_if_one_is_lost(cluster: FakeCluster) -> None:
    with running(backend="kubernetes"):
        ring = fiber.Ring(2, lambda rank, size: fiber.ring.current().exchange(own_pod()))
        assert sorted(ring.run()) == pods_of(cluster)
        ours, theirs = fiber.Pipe()
        killing = threading.Thread(target=lambda: cluster.do(cluster.nodes.kill, ours.recv()))
        killing.start()
        with pytest.raises(MemberLost, match="member 1 of the ring is lost"):
            fiber.Ring(2, partial(stay_in_ring, theirs)).run()
        killing.join()
        ours.close()
        theirs.close()


def test_processes_and_pipes(cluster: FakeCluster) -> None:
    with running(backend="kubernetes", processes_per_pod=2):
        ours, theirs = fiber.Pipe()
        children = [fiber.Process(target=send, args=(theirs, word)) for word in "abc"]
        for child in children:
            child.start()  # this call waits for no pod
        theirs.close()
        assert sorted(ours.recv() for _ in children) == ["a", "b", "c"]
        for child in children:
            child.join(PATIENCE)
            assert child.exitcode == 0
        assert pods_of(cluster)
        ours.close()


def test_a_child_that_is_killed_before_it_has_a_pod_is_gone_and_its_pod_not_wanted(
    cluster: FakeCluster,
) -> None:
    cluster.nodes.fails_with = ("ContainerCreating", "")
    with running(backend="kubernetes"):
        child = fiber.Process(target=time.sleep, args=(PATIENCE,))
        child.start()
        cluster.wait(lambda: cluster.world.pods("lab"))
        child.kill()
        child.join(PATIENCE)
        assert child.exitcode == -signal.SIGKILL
        cluster.wait(lambda: not cluster.world.pods("lab"))


def test_a_killed_pod_costs_its_tasks_another_run(cluster: FakeCluster, port: int) -> None:
    with running(backend="kubernetes", listen_port=port), fiber.Pool(2) as pool:
        result = pool.map_async(slow_square, range(200), chunksize=1)
        pool.wait_until_workers_up(PATIENCE)
        victim = pool.workers()[0].host
        cluster.do(cluster.nodes.kill, victim)
        assert result.get(PATIENCE) == [n * n for n in range(200)]
        cluster.wait(lambda: len(cluster.world.pods("lab")) >= 2)


def test_a_task_that_dies_with_its_pod_says_so(cluster: FakeCluster) -> None:
    with running(backend="kubernetes"), fiber.Pool(1, retries=0) as pool:
        result = pool.apply_async(time.sleep, (PATIENCE,))
        pool.wait_until_workers_up(PATIENCE)
        (worker,) = pool.workers()
        cluster.do(cluster.nodes.kill, worker.host)
        with pytest.raises(WorkerDied, match="OOMKilled") as caught:
            result.get(PATIENCE)
        assert (caught.value.pod, caught.value.node) == (worker.host, "node-1")
        assert "@fiber.meta(memory=)" in str(caught.value)


def test_a_deleted_pod_costs_its_tasks_another_run(cluster: FakeCluster, port: int) -> None:
    with running(backend="kubernetes", listen_port=port), fiber.Pool(2) as pool:
        result = pool.map_async(slow_square, range(200), chunksize=1)
        pool.wait_until_workers_up(PATIENCE)
        victim = pool.workers()[0].host
        cluster.do(cluster.world.store.delete, "pods", "lab", victim)
        assert result.get(PATIENCE) == [n * n for n in range(200)]


def test_the_output_of_workers_has_their_pods_names(
    cluster: FakeCluster, capfd: pytest.CaptureFixture[str]
) -> None:
    with running(backend="kubernetes"), fiber.Pool(1) as pool:
        pool.apply(say, ("a word",))
        (worker,) = pool.workers()
    assert f"[{worker.name}@{worker.host}] a word" in capfd.readouterr().err


def test_an_image_that_cannot_be_had_is_an_error_within_seconds(
    cluster: FakeCluster, capfd: pytest.CaptureFixture[str]
) -> None:
    cluster.nodes.fails_with = ("ErrImageNeverPull", "image is not present")
    with (
        running(backend="kubernetes", image="nobody/nothing"),
        fiber.Pool(2) as pool,
        pytest.raises(FiberPoolError, match="ErrImageNeverPull") as caught,
    ):
        pool.map(square, range(3))
    assert caught.value.reason == "ErrImageNeverPull"
    with running(backend="kubernetes", image="nobody/nothing"):
        child = fiber.Process(target=square, args=(1,))
        child.start()
        child.join(PATIENCE)
        assert child.exitcode == 1
    assert "ErrImageNeverPull" in capfd.readouterr().err


def test_the_deletion_of_a_fiber_pool_is_reported_and_the_next_pool_gets_another(
    cluster: FakeCluster, capfd: pytest.CaptureFixture[str]
) -> None:
    with running(backend="kubernetes"):
        with fiber.Pool(1) as pool:
            assert pool.apply(square, (3,)) == 9
        (first,) = cluster.objects("fiberpools")
        cluster.do(cluster.world.store.delete, "fiberpools", "lab", first["metadata"]["name"])
        backend: Any = state.runtime().backend
        cluster.wait(lambda: all(pods.over for pods in backend._pods.values()))
        with fiber.Pool(1) as pool:
            assert pool.apply(square, (3,)) == 9
    assert capfd.readouterr().err.count("was deleted, and its processes with it") == 1


def test_a_map_whose_fiber_pool_is_deleted_goes_on_with_another(
    cluster: FakeCluster, port: int
) -> None:
    with running(backend="kubernetes", listen_port=port), fiber.Pool(1) as pool:
        result = pool.map_async(slow_square, range(100), chunksize=1)
        pool.wait_until_workers_up(PATIENCE)
        (first,) = (one["metadata"]["name"] for one in cluster.objects("fiberpools"))
        cluster.do(cluster.world.store.delete, "fiberpools", "lab", first)
        assert result.get(PATIENCE) == [n * n for n in range(100)]
        assert [one["metadata"]["name"] for one in cluster.objects("fiberpools")] == [f"{first}-1"]


def test_processes_for_which_there_will_be_no_room_are_spoken_of(
    cluster: FakeCluster, capfd: pytest.CaptureFixture[str]
) -> None:
    with running(backend="kubernetes", max_pods=1):
        ours, theirs = fiber.Pipe()
        children = [fiber.Process(target=hear, args=(theirs,)) for _ in range(2)]
        for child in children:
            child.start()
        theirs.close()
        for _ in children:
            ours.send("go")
        for child in children:
            child.join(PATIENCE)
            assert child.exitcode == 0
        ours.close()
    assert capfd.readouterr().err.count("processes wait until others end") == 1


def test_a_pool_on_a_warm_pool_leaves_its_pods_unchanged(cluster: FakeCluster) -> None:
    template = {"spec": {"containers": [{"name": "worker", "image": "worker"}]}}
    cluster.do(lambda: cluster.world.make_pool("warm", "lab", minReplicas=2, template=template))
    cluster.wait(lambda: len(cluster.world.pods("lab")) == 2)
    before = pods_of(cluster)
    with running(backend="kubernetes"), fiber.Pool(2, pool="warm") as pool:
        assert set(pool.map(own_pod, range(20), chunksize=1)) <= set(before)
        (held,) = cluster.objects("fiberpools")
        assert held["spec"]["master"]["identity"]
    (left,) = cluster.objects("fiberpools")
    assert "master" not in left["spec"]
    assert pods_of(cluster) == before
    cluster.do(cluster.world.store.delete, "fiberpools", "lab", "warm")


def test_an_outdated_pod_of_a_warm_pool_is_replaced_when_it_is_idle(
    cluster: FakeCluster,
) -> None:
    template = {"spec": {"containers": [{"name": "worker", "image": "worker:1"}]}}
    newer = {"spec": {"containers": [{"name": "worker", "image": "worker:2"}]}}
    cluster.do(lambda: cluster.world.make_pool("warm", "lab", minReplicas=1, template=template))

    def images() -> list[str]:
        pods = cluster.world.pods("lab")
        return [pod["spec"]["containers"][0]["image"] for pod in pods]

    with running(backend="kubernetes"):
        with fiber.Pool(1, pool="warm") as pool:
            assert pool.apply(square, (3,)) == 9
            cluster.do(lambda: cluster.world.edit("warm", "lab", template=newer))
            cluster.wait(lambda: cluster.world.status("warm", "lab")["observedGeneration"] > 2)
            assert pool.apply(square, (4,)) == 16
            assert cluster.do(images) == ["worker:1"]
        cluster.wait(lambda: images() == ["worker:2"])
        with fiber.Pool(1, pool="warm") as pool:
            assert pool.apply(square, (5,)) == 25
    cluster.do(cluster.world.store.delete, "fiberpools", "lab", "warm")


def test_the_end_of_a_pipe_names_the_end_of_the_pod(cluster: FakeCluster) -> None:
    with running(backend="kubernetes"):
        ours, theirs = fiber.Pipe()
        child = fiber.Process(target=send_and_wait, args=(theirs, "ready"))
        child.start()
        theirs.close()
        assert ours.recv() == "ready"
        (victim,) = pods_of(cluster)
        cluster.do(cluster.world.store.delete, "pods", "lab", victim)
        with pytest.raises(EOFError, match=f"Deleted: the pod was deleted, in pod {victim}"):
            ours.recv()
        child.join(PATIENCE)
        assert child.exitcode == -signal.SIGKILL  # after the grace of its pod
        ours.close()


def test_pools_of_all_shapes_end_at_the_same_time(
    cluster: FakeCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    shapes = [fiber.meta(cpu=cpu)(square) for cpu in (0.1, 0.2, 0.3)]
    deleting, met = threading.Barrier(len(shapes)), []
    delete = Api.delete

    def meet(api: Api, *arguments: Any, **options: Any) -> None:
        met.append(deleting.wait(PATIENCE))
        delete(api, *arguments, **options)

    with running(backend="kubernetes"):
        for shape in shapes:
            with fiber.Pool(1) as pool:
                assert pool.apply(shape, (2,)) == 4
        monkeypatch.setattr(Api, "delete", meet)
    assert sorted(met) == [0, 1, 2]


def test_an_api_server_without_answers_is_reported(
    cluster: FakeCluster, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fiber._backends.kubernetes.waiting._FIRST_WRITTEN", 0.1)
    cluster.do(cluster.world.slow, "create", "fiberpools", 0.5)
    with running(backend="kubernetes"), fiber.Pool(1) as pool:
        assert pool.apply(square, (3,)) == 9
    cluster.do(cluster.world.api.faults.clear)
    assert "the API server 127.0.0.1 has not answered yet" in capfd.readouterr().err


def test_pods_that_cannot_reach_the_program_are_an_error(
    cluster: FakeCluster, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fiber._backends.kubernetes.waiting.DOUBTED_AFTER", 0.2)
    monkeypatch.setattr("fiber._backends.kubernetes.waiting.GIVEN_UP_AFTER", 0.5)
    cluster.nodes.cut_off = True
    with running(backend="kubernetes", relay="never"):
        for _ in range(2):  # the second waits for the same pods
            with fiber.Pool(2) as pool, pytest.raises(FiberPoolError) as caught:
                pool.map(square, range(3))
            assert caught.value.reason == "Unreachable"
            assert "has reached this program at " in str(caught.value)
    assert capfd.readouterr().err.count("Waiting for 0.5 s more") == 1


FORKS = """
    import fiber, os, warnings

    # From Python 3.12 on os.fork() warns of any thread, and the loop is one.
    warnings.simplefilter("ignore", DeprecationWarning)

    def square(number):
        return number * number

    if __name__ == "__main__":
        with fiber.Pool(1) as pool:
            pool.map(square, range(3))
            pid = os.fork()
            if pid == 0:
                with fiber.Pool(1) as other:
                    os._exit(other.apply(square, (3,)))
            print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), pool.map(square, range(3)))
"""


@pytest.mark.usefixtures("cluster")
def test_a_program_with_pods_can_fork_itself(
    launch: Callable[..., Program],
) -> None:
    program = launch(FORKS, env={"FIBER_BACKEND": "kubernetes"})
    assert program.finish(PATIENCE) == "9 [0, 1, 4]\n"


def test_a_program_takes_one_free_port_of_a_range_for_all_its_pools(cluster: FakeCluster) -> None:
    with socket.create_server(("", 0)) as taken:
        first = taken.getsockname()[1]
        with running(backend="kubernetes", listen_port=f"{first}-{first + 20}"):
            with fiber.Pool(1) as pool, fiber.Pool(1) as other:
                assert pool.apply(square, (2,)) == 4
                assert other.apply(fiber.meta(cpu=0.5)(square), (3,)) == 9
            found = [one["spec"]["master"]["port"] for one in cluster.objects("fiberpools")]
    assert len(found) == 2
    assert found[0] == found[1]
    assert found[0] in range(first + 1, first + 21)


def test_pods_dial_the_advertised_address(cluster: FakeCluster, port: int) -> None:
    here = _local_address("192.0.2.1")
    assert here is not None
    with (
        Proxy(f"127.0.0.1:{port}", at=(here, port)) as forwarding,
        running(
            backend="kubernetes", listen_host="127.0.0.1", listen_port=port, advertised_host=here
        ),
        fiber.Pool(1) as pool,
    ):
        assert pool.apply(square, (2,)) == 4
        (found,) = cluster.objects("fiberpools")
        assert found["spec"]["master"]["host"] == here
        assert forwarding.connections > 0


def test_an_agent_that_was_killed_fails_one_test_alone(cluster: FakeCluster) -> None:
    cluster.do(cluster.nodes.forced.append, "es-0123456789")
    assert cluster.take_forced() == ["es-0123456789"]
    assert cluster.take_forced() == []
