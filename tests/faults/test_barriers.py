"""Barriers whose processes are killed or interrupted: on this host, and on loopback agents."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from typing import Any

import pytest

import fiber
from census import wait_until
from faults.runtime import running
from patience import PATIENCE


@pytest.fixture(params=["local", "loopback"])
def _backend(request: pytest.FixtureRequest) -> Iterator[None]:
    with running(backend=request.param, agents=1):
        yield


def wait_often(barrier: Any, times: int, indices: Any) -> None:
    for _ in range(times):
        indices.put(barrier.wait(PATIENCE))


def wait_until_interrupted(barrier: Any, outcomes: Any) -> None:
    with pytest.raises(KeyboardInterrupt):
        barrier.wait()
    outcomes.put((barrier.n_waiting, barrier.broken))
    outcomes.put(barrier.wait(PATIENCE))


def started(target: Any, *args: Any) -> Any:
    process = fiber.Process(target=target, args=args)
    process.start()
    return process


@pytest.mark.usefixtures("_backend")
def test_a_killed_process_that_waits_breaks_the_barrier() -> None:
    barrier: Any = fiber.Barrier(3)
    indices: Any = fiber.SimpleQueue()
    process = started(wait_often, barrier, 1, indices)
    assert wait_until(lambda: barrier.n_waiting == 1, PATIENCE)
    process.kill()
    process.join(PATIENCE)
    with pytest.raises(threading.BrokenBarrierError, match="a process that took part has died"):
        barrier.wait(PATIENCE)
    assert barrier.broken
    barrier.reset()
    processes = [started(wait_often, barrier, 5, indices) for _ in range(2)]
    for _ in range(5):
        assert {barrier.wait(PATIENCE), indices.get(), indices.get()} == {0, 1, 2}
    for process in processes:
        process.join(PATIENCE)


@pytest.mark.usefixtures("_backend")
def test_an_interrupted_process_that_waits_comes_again() -> None:
    barrier: Any = fiber.Barrier(2)
    outcomes: Any = fiber.SimpleQueue()
    process = started(wait_until_interrupted, barrier, outcomes)
    assert wait_until(lambda: barrier.n_waiting == 1, PATIENCE)
    os.kill(process.pid, signal.SIGINT)
    assert outcomes.get() == (0, False)
    assert {barrier.wait(PATIENCE), outcomes.get()} == {0, 1}
    process.join(PATIENCE)
