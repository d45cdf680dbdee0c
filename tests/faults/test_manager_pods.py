"""Managers whose process is a pod's, on a cluster played in this process."""

from __future__ import annotations

from typing import Any, NoReturn

import pytest

import fiber
from fakes.cluster import FakeCluster
from faults import test_pods
from faults.runtime import running
from fiber.errors import ConnectionClosed
from fiber.managers import AsyncManager, BaseManager
from patience import PATIENCE

pytestmark = [
    pytest.mark.may_leak("the operator's connections, for as long as the cluster is there"),
]

cluster = test_pods.cluster
_nothing_is_left = test_pods._nothing_is_left


class Tally:
    def __init__(self) -> None:
        self.count = 0

    def add(self) -> int:
        self.count += 1
        return self.count

    def pod(self) -> str:
        return test_pods.own_pod()


@fiber.meta(cpu=2)
class Tallies(BaseManager):
    pass


class AsyncTallies(AsyncManager):
    pass


Tallies.register("Tally", Tally)
AsyncTallies.register("Tally", Tally)


def add(tally: Any) -> int:
    count: int = tally.add()
    return count


def test_a_manager_takes_a_slot_of_a_pod_of_its_shape(cluster: FakeCluster) -> None:
    with running(backend="kubernetes"), Tallies() as manager, fiber.Pool(1) as pool:
        tally = manager.Tally()  # type: ignore[attr-defined]  # registered
        assert tally.add() == 1
        assert pool.map(add, [tally] * 4) == [2, 3, 4, 5]
        (pod,) = (pod for pod in cluster.objects("pods") if pod["metadata"]["name"] == tally.pod())
        (container,) = pod["spec"]["containers"]
        assert container["resources"]["requests"]["cpu"] == "2"


def add_for_ever(tally: Any) -> NoReturn:
    while True:
        tally.add().get(PATIENCE)


def test_a_deleted_pod_ends_every_call(cluster: FakeCluster) -> None:
    with running(backend="kubernetes"), AsyncTallies() as manager:
        tally = manager.Tally()  # type: ignore[attr-defined]  # registered
        pod = tally.pod().get(PATIENCE)
        cluster.do(cluster.nodes.kill, pod)
        with pytest.raises(ConnectionClosed, match=r"manager 'AsyncTallies-\d+'.*is gone"):
            add_for_ever(tally)
