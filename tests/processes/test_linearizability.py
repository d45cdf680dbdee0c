"""Locks, semaphores and queues behave as if each operation happened at one moment."""

from __future__ import annotations

import itertools
import random
import threading
from collections.abc import Callable, Iterator
from queue import SimpleQueue
from typing import Any

import pytest

import fiber
from fiber import queues
from hosts import Far, Hosts, background
from linearizability import Operation, call, is_linearizable, queue, semaphore
from patience import PATIENCE

PROCESSES = 3
OPERATIONS = 12


def use_lock(lock: Any, seed: int, start: Any, histories: Any) -> None:
    """Acquire and release at random."""
    chance, seen = random.Random(seed), []
    start.wait(PATIENCE)
    for _ in range(OPERATIONS):
        acquired = call("acquire", lock.acquire, chance.random() < 0.5)
        seen.append(acquired)
        if acquired.result:
            seen.append(call("release", lock.release))
    histories.put(seen)


def use_queue(shared: Any, seed: int, start: Any, histories: Any) -> None:
    """Put and get by turns: there is always something to get."""
    seen = []
    start.wait(PATIENCE)
    for number in range(OPERATIONS):
        seen.append(call("put", shared.put, (seed, number)))
        seen.append(call("get", shared.get))
    histories.put(seen)


def history(target: Callable[..., None], shared: Any) -> list[Operation]:
    """Return the operations of some processes."""
    start = fiber.Barrier(PROCESSES)
    histories: queues.Queue[list[tuple[Any, ...]]] = fiber.Queue()
    processes = [
        fiber.Process(target=target, args=(shared, seed, start, histories))
        for seed in range(PROCESSES)
    ]
    for process in processes:
        process.start()
    seen = [histories.get(timeout=PATIENCE) for _ in processes]
    for process in processes:
        process.join(PATIENCE)
    return [Operation(*operation) for operations in seen for operation in operations]


CASES: dict[str, tuple[Callable[..., None], Callable[[], Any], Any, Any]] = {
    "Lock": (use_lock, fiber.Lock, semaphore(1), 1),
    "RLock": (use_lock, fiber.RLock, semaphore(1), 1),
    "Semaphore": (use_lock, lambda: fiber.Semaphore(2), semaphore(2), 2),
    "BoundedSemaphore": (use_lock, lambda: fiber.BoundedSemaphore(2), semaphore(2), 2),
    "SimpleQueue": (use_queue, fiber.SimpleQueue, queue, ()),
    "Queue": (use_queue, fiber.Queue, queue, ()),
}


@pytest.mark.parametrize("case", CASES)
def test_histories_of_one_host_are_linearizable(case: str) -> None:
    target, make, model, state = CASES[case]
    assert is_linearizable(history(target, make()), model, state)


@pytest.mark.parametrize("case", ["Lock", "RLock", "Semaphore", "BoundedSemaphore", "SimpleQueue"])
def test_histories_between_hosts_are_linearizable(case: str) -> None:
    target, make, model, state = CASES[case]
    hosts = Hosts()
    hosts.link("b", "a")
    try:
        with hosts.at("b"):
            here = make()
            there = Far(hosts)(here)
            start, histories = threading.Barrier(PROCESSES), SimpleQueue[list[Operation]]()
            for seed, shared in enumerate((here, there, there)):
                background(target, shared, seed, start, histories)
            seen = [histories.get(timeout=PATIENCE) for _ in range(PROCESSES)]
    finally:
        hosts.close()
    assert is_linearizable(itertools.chain(*seen), model, state)


# The checker


def one_after_another(*operations: tuple[str, Any, Any]) -> Iterator[Operation]:
    for number, (name, argument, result) in enumerate(operations):
        yield Operation(name, argument, result, 2 * number, 2 * number + 1)


FAULTS: dict[str, tuple[list[tuple[str, Any, Any]], Any, Any]] = {
    "two have it": ([("acquire", (), True), ("acquire", (), True)], semaphore(1), 1),
    "nobody gets it": ([("acquire", (), False)], semaphore(1), 1),
    "it was lost": (
        [("acquire", (), True), ("release", (), None), ("acquire", (), False)],
        semaphore(1),
        1,
    ),
    "one too many": ([("release", (), None)], semaphore(2), 2),
    "out of order": (
        [("put", (1,), None), ("put", (2,), None), ("get", (), 2), ("get", (), 1)],
        queue,
        (),
    ),
    "twice": ([("put", (1,), None), ("get", (), 1), ("get", (), 1)], queue, ()),
    "before it was put": ([("get", (), 1), ("put", (1,), None)], queue, ()),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_an_injected_fault_is_found(fault: str) -> None:
    operations, model, state = FAULTS[fault]
    assert not is_linearizable(one_after_another(*operations), model, state)


def test_overlapping_operations_may_have_happened_in_either_order() -> None:
    put, other = Operation("put", (1,), None, 0, 9), Operation("put", (2,), None, 0, 9)
    for first, second in ((1, 2), (2, 1)):
        gets = [Operation("get", (), first, 10, 11), Operation("get", (), second, 12, 13)]
        assert is_linearizable([put, other, *gets], queue, ())


@pytest.mark.parametrize("case", ["Lock", "SimpleQueue"])
def test_a_changed_result_in_a_true_history_is_found(case: str) -> None:
    target, make, model, state = CASES[case]
    seen = history(target, make())
    gets = [n for n, operation in enumerate(seen) if operation.name in ("get", "acquire")]
    first, last = min(gets, key=lambda n: seen[n].end), max(gets, key=lambda n: seen[n].start)
    if case == "Lock":
        seen[last] = seen[last]._replace(result=not seen[last].result)
    else:
        results = seen[first].result, seen[last].result
        seen[last] = seen[last]._replace(result=results[0])
        seen[first] = seen[first]._replace(result=results[1])
    assert not is_linearizable(seen, model, state)
