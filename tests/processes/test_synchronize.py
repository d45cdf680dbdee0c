"""Locks, semaphores, events and barriers among processes."""

from __future__ import annotations

import math
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable
from typing import Any

import pytest

import fiber
from fiber import queues, synchronize
from patience import PATIENCE
from processes.test_loopback import running


def start(target: Callable[..., Any], *args: Any) -> fiber.Process:
    process = fiber.Process(target=target, args=args, daemon=True)
    process.start()
    return process


@pytest.mark.parametrize("value", [-1, synchronize.SEM_VALUE_MAX + 1])
def test_a_value_that_cannot_be(value: int) -> None:
    with pytest.raises((OSError, OverflowError), match=str(value)):
        fiber.Semaphore(value)


def refusal(make: Callable[[Any], object], value: Any) -> type[Exception] | None:
    try:
        make(value)
    except Exception as error:
        return type(error)
    return None


@pytest.mark.parametrize("value", [2.0, -1, "2", None, math.nan, 1 << 80])
@pytest.mark.parametrize("name", ["Semaphore", "BoundedSemaphore", "Queue", "JoinableQueue"])
def test_a_wrong_number_is_refused_as_by_multiprocessing(name: str, value: Any) -> None:
    expected = refusal(getattr(multiprocessing, name), value)
    assert refusal(getattr(fiber, name), value) is expected


def test_a_notify_with_a_negative_number_wakes_no_thread() -> None:
    condition = fiber.Condition()
    with condition:
        condition.notify(-1)
        assert not condition.wait(0.01)


def hold_and_fork(lock: Any, forks: Any) -> None:
    lock.acquire()
    fork = os.fork()
    if fork:
        forks.put(fork)
    signal.pause()


def test_a_fork_of_a_dead_holder_on_another_host_does_not_keep_the_lock() -> None:
    with running(agents=1):
        lock = fiber.Lock()
        forks: queues.SimpleQueue[int] = fiber.SimpleQueue()
        holder = start(hold_and_fork, lock, forks)
        fork = forks.get()
        try:
            holder.kill()
            assert lock.acquire(timeout=PATIENCE)
            os.kill(fork, 0)
        finally:
            os.kill(fork, signal.SIGKILL)


def in_turn(semaphore: Any, inside: Any, times: int) -> None:
    for _ in range(times):
        with semaphore:
            assert inside.acquire(False)  # the condition has no other users
            inside.release()


def test_a_semaphore_of_one_excludes() -> None:
    semaphore, inside = fiber.Semaphore(1), fiber.Semaphore(1)
    processes = [start(in_turn, semaphore, inside, 300) for _ in range(3)]
    for process in processes:
        process.join(PATIENCE)
        assert process.exitcode == 0
    assert semaphore.get_value() == 1


def announce_and_acquire(semaphore: Any, ready: Any) -> None:
    ready.set()
    semaphore.acquire()


def test_a_waiter_killed_while_waiting_takes_no_token() -> None:
    semaphore, ready = fiber.Semaphore(0), fiber.Event()
    process = start(announce_and_acquire, semaphore, ready)
    assert ready.wait(PATIENCE)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join(PATIENCE)
    semaphore.release()
    assert semaphore.acquire(timeout=PATIENCE)


def wait_and_answer(event: Any, ready: Any, answers: Any) -> None:
    ready.release()
    answers.put(event.wait(PATIENCE))


def test_an_event_wakes_all_processes() -> None:
    event, ready = fiber.Event(), fiber.Semaphore(0)
    answers: queues.Queue[bool] = fiber.Queue()
    processes = [start(wait_and_answer, event, ready, answers) for _ in range(3)]
    for _ in processes:
        assert ready.acquire(timeout=PATIENCE)
    event.set()
    assert [answers.get(timeout=PATIENCE) for _ in processes] == [True] * 3
    for process in processes:
        process.join(PATIENCE)


def test_a_waiter_is_woken_even_if_the_event_is_cleared_at_once() -> None:
    event = fiber.Event()
    woken: list[bool] = []
    for _ in range(50):
        threads = [
            threading.Thread(target=lambda: woken.append(event.wait(PATIENCE))) for _ in range(2)
        ]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            event.set()
            event.clear()
    assert woken == [True] * 100


def add(lock: Any, count: Any, times: int) -> None:
    for _ in range(times):
        with lock:
            count.put(count.get() + 1)


def test_a_waiter_gets_the_lock() -> None:
    lock = fiber.Lock()
    count: queues.SimpleQueue[int] = fiber.SimpleQueue()
    count.put(0)
    processes = [fiber.Process(target=add, args=(lock, count, 100)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(PATIENCE)
    assert count.get() == 300


def test_pickled_anywhere_it_is_the_same() -> None:
    lock = fiber.RLock()
    queue: queues.Queue[Any] = fiber.Queue()
    queue.put(lock)
    with lock, queue.get(timeout=PATIENCE) as again:
        assert again
    with fiber.Pool(1) as pool:
        assert pool.apply(repr, (lock,)) == "<RLock(None, 0)>"


def take_part(barrier: Any) -> None:
    barrier.wait(PATIENCE)


def test_members_that_end_in_good_order_are_not_missed() -> None:
    barrier = fiber.Barrier(2)
    for _ in range(2):
        process = fiber.Process(target=take_part, args=(barrier,))
        process.start()
        barrier.wait(PATIENCE)
        process.join(PATIENCE)
    with barrier._cond:
        assert not barrier._bury()
    assert pickle.loads(pickle.dumps(barrier)).parties == 2
