"""Timeouts longer than the kernel can wait at once, which is 2**31 milliseconds."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import fiber
from faults import pool_targets as tasks
from faults import targets
from faults.program import Program
from faults.runtime import running
from patience import PATIENCE

LONG = pytest.mark.parametrize("long", [math.inf, 1e7])


@pytest.fixture
def soon() -> Iterator[Callable[..., None]]:
    """Calls something while the test waits."""
    timers: list[threading.Timer] = []

    def call(action: Callable[..., object], *args: Any) -> None:
        timers.append(threading.Timer(0.05, action, args))
        timers[-1].start()

    yield call
    for timer in timers:
        timer.join()
    timers.clear()  # they keep the callee alive


def works(pool: Any) -> bool:
    return bool(pool.map_async(abs, [-1, -2]).get(PATIENCE) == [1, 2])


@LONG
@pytest.mark.parametrize("name", ["task_timeout", "idle_timeout"])
def test_a_pool_accepts_long_timeouts(name: str, long: float) -> None:
    options: dict[str, Any] = {name: long}
    with fiber.Pool(min_workers=0, max_workers=2, **options) as pool:
        assert works(pool)
        assert works(pool)


@LONG
def test_calls_and_results_accept_long_timeouts(long: float) -> None:
    with fiber.Pool(2) as pool:
        assert pool.apply_async(abs, (-1,), timeout=long).get(long) == 1
        assert pool.map_async(abs, [-1], timeout=long).get(long) == [1]
        assert pool.imap(abs, [-1], timeout=long).next(long) == 1
        assert works(pool)


def test_an_infinite_one_of_a_call_goes_before_that_of_the_pool() -> None:
    with fiber.Pool(1, task_timeout=0.05) as pool:
        with pytest.raises(fiber.TimeoutError):
            pool.apply(tasks.nap, (0.2,))
        assert pool.apply(tasks.nap, (0.2,), timeout=math.inf) == 0.2


def test_workers_of_a_pool_without_an_idle_timeout_stay() -> None:
    with fiber.Pool(min_workers=0, max_workers=1, idle_timeout=None) as pool:
        assert works(pool)
        assert pool._executor._wake is None, "no event makes the scheduler decide again"
        assert len(pool._pool) == 1


@LONG
@pytest.mark.parametrize("what", ["semaphore", "event", "queue", "pipe"])
def test_shared_objects_accept_long_timeouts(
    soon: Callable[..., None], what: str, long: float
) -> None:
    if what == "semaphore":
        semaphore = fiber.Semaphore(0)
        soon(semaphore.release)
        assert semaphore.acquire(True, long)
    elif what == "event":
        event = fiber.Event()
        soon(event.set)
        assert event.wait(long)
    elif what == "queue":
        queue: fiber.SimpleQueue[Any] = fiber.SimpleQueue()
        soon(queue.put, 1)
        assert queue._reader.poll(long)
    else:
        ours, theirs = fiber.Pipe()
        soon(theirs.send, 1)
        assert ours.poll(long)


@LONG
def test_join_accepts_long_timeouts(long: float) -> None:
    child = fiber.Process(target=targets.nothing)
    child.start()
    child.join(long)
    assert child.exitcode == 0
    child.close()


@pytest.mark.parametrize("backend", ["local", "loopback"])
def test_a_start_accepts_long_timeouts(backend: str) -> None:
    with running(backend=backend, agents=1, start_timeout=1e7), fiber.Pool(1) as pool:
        assert works(pool)


def test_agents_accept_long_timeouts() -> None:
    patience = {"heartbeat_interval": 1e7, "suspect_after": 2e7, "lost_after": 4e7}
    with running(backend="loopback", agents=1, **patience), fiber.Pool(1) as pool:
        assert works(pool)


BROKEN = """
    import fiber, os, threading, time
    from faults import targets
    from fiber._runtime.state import runtime

    def told(action):
        try:
            print(type(action()).__name__, flush=True)
        except fiber.FiberError as error:
            print("told" if "os.closerange" in str(error) else error, flush=True)

    if __name__ == "__main__":
        pool = fiber.Pool(2)
        pool.map(abs, range(10))
        child = fiber.Process(target=targets.block)
        child.start()
        results = [pool.apply_async(time.sleep, (600,)), pool.map_async(time.sleep, [600])]
        iterator = pool.imap(time.sleep, [600])
        loop = runtime().loop
        loop.call_soon(os.close, loop._epoll.fileno())
        for result in results:
            told(result.get)
        told(lambda: next(iterator))
        child.join()
        print(child.exitcode, flush=True)
        told(lambda: pool.map(abs, [1]))
        told(lambda: fiber.Pool(1))
        told(lambda: fiber.Process(target=targets.nothing).start())
        pool.terminate()
        pool.join()
"""


def test_a_failure_of_the_waiting_thread_ends_all_waits(
    launch: Callable[..., Program],
) -> None:
    program = launch(BROKEN)
    assert program.rest() == "told\n" * 3 + "255\n" + "told\n" * 3
    assert program.wait() == 0
    assert program.left() == []
