"""Shared memory when its processes die, on one host and between hosts."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest

import fiber
from faults import targets
from faults.program import wait_for
from faults.runtime import running
from fiber._backends.loopback import LoopbackBackend
from fiber._hub import client
from fiber._hub.client import ObjectUnreachable
from fiber.managers import SharedMemoryManager
from patience import PATIENCE


def start(target: Any, *args: Any) -> Any:
    child = fiber.Process(target=target, args=args)
    child.start()
    return child


@pytest.fixture
def agents() -> Iterator[LoopbackBackend]:
    with running(backend="loopback", agents=1) as runtime:
        assert isinstance(runtime.backend, LoopbackBackend)
        yield runtime.backend


def kill(agents: LoopbackBackend) -> None:
    pid = agents._slots[0].process.pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)


def test_writes_of_a_killed_process_stay(backend: str) -> None:
    array = fiber.RawArray("i", 4)
    child = start(targets.write_half_and_die, array)
    child.join(PATIENCE)
    assert child.exitcode == -signal.SIGKILL
    assert list(array) == [1, 2, 0, 0]


def test_a_manager_of_memory_on_another_host_names_the_replacement(agents: LoopbackBackend) -> None:
    with (
        SharedMemoryManager() as manager,
        pytest.raises(RuntimeError, match=r"host 'loopback-0' .*fiber\.RawArray"),
    ):
        manager.SharedMemory(size=10)


def test_the_home_of_an_array_is_gone(agents: LoopbackBackend) -> None:
    hears, tells = fiber.Pipe()
    child = start(targets.make_and_send_an_array, tells)
    array = hears.recv()
    kill(agents)
    child.join(PATIENCE)
    array[0] += 10
    assert list(array) == [11, 2, 3]
    with pytest.raises(ObjectUnreachable, match="loopback-0"):
        hears.send(array)


def test_a_host_that_has_a_replica_is_gone(agents: LoopbackBackend) -> None:
    array = fiber.RawArray("i", 2)
    hears, tells = fiber.Pipe()
    child = start(targets.write_and_block, array, tells)
    hears.recv()
    assert list(array) == [1, 0]
    kill(agents)
    child.join(PATIENCE)
    hub: Any = client.local_hub()
    wait_for(lambda: not hub.replicas._replicas)
    array[1] = 5
    again = start(targets.write_half_and_die, array)
    again.join(PATIENCE)
    assert list(array) == [1, 5]
