"""Shared values and arrays: multiprocessing's objects, in memory that goes wherever they do."""

from __future__ import annotations

import copy
import ctypes
import gc
import multiprocessing.sharedctypes
import pickle
import threading
from collections.abc import Callable
from multiprocessing import resource_tracker
from typing import Any

import numpy as np
import pytest

import fiber
from fiber import queues, sharedctypes
from fiber._hub.heap import LARGE, allocate
from patience import PATIENCE
from unit.test_heap import SharedBytes


class Point(ctypes.Structure):
    _fields_ = (("x", ctypes.c_double), ("y", ctypes.c_double))


def start(target: Callable[..., Any], *args: Any) -> fiber.Process:
    process = fiber.Process(target=target, args=args, daemon=True)
    process.start()
    return process


def fill(array: Any, number: float) -> Any:
    array[:] = [number] * len(array)
    return array


def count_up(value: Any, times: int) -> None:
    for _ in range(times):
        with value.get_lock():
            value.value += 1


def pass_on(inbox: Any, outbox: Any) -> None:
    array = inbox.get()
    array[0] += 1
    outbox.put(array)


# The objects


@pytest.mark.parametrize(
    ("made", "cls"),
    [
        (lambda: fiber.Value("d", 1.5), "Synchronized"),
        (lambda: fiber.Array("i", 3), "SynchronizedArray"),
        (lambda: fiber.Array("c", 3), "SynchronizedString"),
    ],
)
def test_classes_are_multiprocessings_own(made: Callable[[], Any], cls: str) -> None:
    value = made()
    assert type(value) is getattr(multiprocessing.sharedctypes, cls)
    assert type(value) is getattr(sharedctypes, cls)


def test_a_structure_has_attributes_under_its_lock() -> None:
    point: Any = fiber.Value(Point, 1, 2)
    with point:
        point.x += 10
    assert (point.x, point.y) == (11, 2)
    assert isinstance(point.get_obj(), Point)


def test_a_lock_of_ones_own() -> None:
    lock = fiber.Lock()
    guarded: Any = fiber.Value("i", 0, lock=lock)
    assert guarded.get_lock() is lock
    assert isinstance(fiber.Value("i", 3, lock=False), ctypes.c_int)
    with pytest.raises(AttributeError, match="'yes' has no method 'acquire'"):
        fiber.Array("i", 3, lock="yes")  # type: ignore[call-overload]  # no lock


def test_arrays_are_zero_or_as_given() -> None:
    zeros: Any = fiber.Array("i", 3)
    assert list(zeros) == [0, 0, 0]
    assert list(fiber.RawArray(ctypes.c_short, (1, 2))) == [1, 2]
    halves: Any = np.array([0.5, 1.5])
    assert list(fiber.RawArray("d", halves)) == [0.5, 1.5]
    assert list(fiber.RawArray("d", 0)) == []
    with pytest.raises(ValueError):
        fiber.RawArray("d", -1)


def test_numpy_sees_the_memory_itself() -> None:
    array: Any = fiber.Array("d", 4)
    view = np.frombuffer(array.get_obj())
    view[2] = 2.5
    assert array[2] == 2.5
    del array
    gc.collect()
    assert [fiber.RawArray("d", 4)[2] for _ in range(3)] == [0] * 3
    assert view[2] == 2.5, "the memory was used again while NumPy looked at it"


def test_copy_and_synchronized() -> None:
    point = Point(1, 2)
    shared = sharedctypes.copy(point)
    point.x = 5
    assert (shared.x, shared.y) == (1, 2)
    guarded: Any = sharedctypes.synchronized(shared)
    with guarded.get_lock():
        guarded.x = 7
    assert shared.x == 7


def test_values_of_a_context() -> None:
    context = fiber.get_context("spawn")
    assert context.Value("i", 1).value == 1
    assert context.Array("i", [1, 2])[:] == [1, 2]
    assert context.RawValue("i", 1).value == 1
    assert list(context.RawArray("i", [1, 2])) == [1, 2]


# In other processes


def test_processes_share_values_and_arrays_of_their_arguments() -> None:
    value, array = fiber.Value("i", 0), fiber.RawArray("d", 100_000)
    processes = [start(count_up, value, 100) for _ in range(3)] + [start(fill, array, 1)]
    for process in processes:
        process.join(PATIENCE)
    assert value.value == 300
    assert sum(array) == 100_000


def test_processes_of_multiprocessings_own_share_them() -> None:
    context = multiprocessing.get_context("spawn")
    values = fiber.Value("i", 0), fiber.Value("i", 0)  # whose locks are in one segment
    process = context.Process(target=count_both, args=values)
    process.start()
    process.join(PATIENCE)
    assert process.exitcode == 0
    process.close()
    resource_tracker._resource_tracker._stop()  # type: ignore[attr-defined]
    assert [value.value for value in values] == [1, 1]


def count_both(*values: Any) -> None:
    for value in values:
        count_up(value, 1)


def test_arrays_travel_through_queues_and_keep_their_lock() -> None:
    there: queues.Queue[Any] = fiber.Queue()
    back: queues.SimpleQueue[Any] = fiber.SimpleQueue()
    process = start(pass_on, there, back)
    array = fiber.Array("i", 2)
    there.put(array)
    again = back.get()
    process.join(PATIENCE)
    assert (array[0], again[0]) == (1, 1)
    with array.get_lock():
        assert repr(again.get_lock()) == "<RLock(MainProcess, 1)>"


def test_tasks_take_and_return_them() -> None:
    array = fiber.Array("i", 3)
    with fiber.Pool(1) as pool:
        again = pool.apply(fill, (array, 4))
    assert array[:] == [4, 4, 4]
    again[0] = 1
    assert array[0] == 1


def test_pool_initializers_get_them() -> None:
    array = fiber.RawArray("i", 3)
    with fiber.Pool(2, fill, (array, 4)) as pool:
        pool.map(abs, range(4))
    assert list(array) == [4, 4, 4]


def test_a_shared_value_outlives_the_process_that_made_it() -> None:
    back: queues.SimpleQueue[Any] = fiber.SimpleQueue()
    process = start(_send_new, back)
    array = back.get()
    process.join(PATIENCE)
    assert array[:] == [1, 2, 3]


def _send_new(back: Any) -> None:
    back.put(fiber.Array("i", [1, 2, 3]))


# What pickles otherwise


def test_other_objects_of_the_same_types_pickle_as_before() -> None:
    fiber.RawValue("i", 2), fiber.RawValue(Point)
    assert pickle.loads(pickle.dumps(ctypes.c_int(5))).value == 5
    assert copy.copy(Point(3, 4)).y == 4
    theirs: Any = ctypes.c_int(1)
    theirs._wrapper = object()  # where multiprocessing's have their memory
    lock: Any = threading.RLock()
    guarded = multiprocessing.sharedctypes.synchronized(theirs, lock)
    for each in (theirs, guarded):
        with pytest.raises(RuntimeError, match="through inheritance"):
            pickle.dumps(each)


def test_part_of_a_shared_array_pickles_by_value() -> None:
    points = fiber.RawArray(Point, [(1, 2), (3, 4)])
    part = pickle.loads(pickle.dumps(points[1]))
    part.x = 9
    assert points[1].x == 3


def _write_each(*shared: SharedBytes) -> None:
    for number, each in enumerate(shared):
        each.block.view[0] = (number + 1) % 256


def test_a_process_of_this_host_has_the_memory_itself() -> None:
    small = [SharedBytes(allocate(8)) for _ in range(300)]  # more than descriptors in a message
    large = SharedBytes(allocate(LARGE))
    process = fiber.Process(target=_write_each, args=(large, *small))
    process.start()
    process.join()
    assert large.block.view[0] == 1
    assert [each.block.view[0] for each in small] == [n % 256 for n in range(2, 302)]
