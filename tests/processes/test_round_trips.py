"""Shared objects come home, and reach another process of their home, by way of another host."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

import fiber
from fiber.queues import SimpleQueuePush
from patience import PATIENCE
from processes.test_loopback import running

MORE_THAN_A_SOCKET = range(1000)
"""Small messages that no socket holds."""


class Kind(NamedTuple):
    """A kind of shared thing; what one holder of it does, the other one sees."""

    make: Callable[[], Any]
    act: Callable[[Any], object]
    see: Callable[[Any], object]


def put(queue: Any) -> None:
    for number in MORE_THAN_A_SOCKET:
        queue.put(number)


def get(queue: Any) -> bool:
    return [queue.get() for _ in MORE_THAN_A_SOCKET] == list(MORE_THAN_A_SOCKET)


def send(pipe: Any) -> None:
    for number in MORE_THAN_A_SOCKET:
        pipe[1].send(number)


def receive(pipe: Any) -> bool:
    return [pipe[0].recv() for _ in MORE_THAN_A_SOCKET] == list(MORE_THAN_A_SOCKET)


def use(lock: Any) -> None:
    with lock:
        pass


def notify(condition: Any) -> None:
    with condition:
        condition.notify_all()


def increment(value: Any) -> None:
    with value.get_lock():
        value.value += 1


def fill(array: Any) -> None:
    array[:] = range(4)


KINDS = {
    "SimpleQueue": Kind(fiber.SimpleQueue, put, get),
    "SimpleQueuePush": Kind(SimpleQueuePush, put, get),
    "Queue": Kind(fiber.Queue, put, get),
    "JoinableQueue": Kind(fiber.JoinableQueue, put, get),
    "a one-way pipe": Kind(lambda: fiber.Pipe(duplex=False), send, receive),
    "a duplex pipe": Kind(fiber.Pipe, lambda ends: ends[0].send(1), lambda ends: ends[1].recv()),
    "Lock": Kind(fiber.Lock, use, lambda lock: lock.acquire(False)),
    "RLock": Kind(fiber.RLock, use, lambda lock: lock.acquire(False)),
    "Semaphore": Kind(
        lambda: fiber.Semaphore(0),
        lambda semaphore: semaphore.release(),
        lambda semaphore: semaphore.acquire(timeout=PATIENCE),
    ),
    "Event": Kind(fiber.Event, lambda event: event.set(), lambda event: event.is_set()),
    "Condition": Kind(fiber.Condition, notify, lambda condition: condition.acquire(False)),
    "Barrier": Kind(
        lambda: fiber.Barrier(2), lambda barrier: barrier.abort(), lambda barrier: barrier.broken
    ),
    "Value": Kind(lambda: fiber.Value("i"), increment, lambda value: value.value == 1),
    "Array": Kind(lambda: fiber.Array("i", 4), fill, lambda array: array[:] == [0, 1, 2, 3]),
}


def made(name: str) -> Any:
    return KINDS[name].make()


def act(name: str, thing: Any) -> None:
    KINDS[name].act(thing)


def itself(thing: Any) -> Any:
    return thing


@pytest.mark.slow
def test_objects_go_from_the_program_to_a_worker_and_back() -> None:
    with running(agents=1), fiber.Pool(1) as pool:
        for name, kind in KINDS.items():
            thing = kind.make()
            kind.act(pool.apply_async(itself, (thing,)).get(PATIENCE))
            assert kind.see(thing), name


@pytest.mark.slow
def test_objects_go_from_a_worker_through_the_program_to_another_worker() -> None:
    with running(agents=1), fiber.Pool(1) as pool, fiber.Pool(1) as other:
        for name, kind in KINDS.items():
            thing = pool.apply_async(made, (name,)).get(PATIENCE)
            other.apply_async(act, (name, thing)).get(PATIENCE)
            assert kind.see(thing), name


def test_through_a_managers_dict() -> None:
    with running(agents=1), fiber.Manager() as manager:
        shelf: Any = manager.dict()
        for name, kind in KINDS.items():
            thing = kind.make()
            shelf[name] = thing
            kind.act(shelf[name])
            assert kind.see(thing), name
