"""Functions of a pool worker: which of them each chunk gets a copy of, and what copies share."""

from __future__ import annotations

import math
import operator
import pickle
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

import fiber
from fiber import reduction
from fiber._agent.functions import LARGE, KnownFunctions
from fiber._wire import packet


class Counter:
    """Object that changes with each call of its method."""

    def __init__(self, **shared: Any) -> None:
        self.shared = shared
        self.table = np.zeros(1)
        self.calls = 0

    def count(self, _: object = None) -> int:
        self.calls += 1
        self.table += 1
        assert self.table[0] == self.calls
        return self.calls

    def named(self, name: str) -> Any:
        self.calls += 1
        return self.calls, self.shared[name]

    @classmethod
    def make(cls, _: object = None) -> type[Counter]:
        return cls


def log(seen: list[int], item: int) -> int:
    seen.append(item)
    return len(seen)


def known(function: Callable[..., Any]) -> KnownFunctions:
    functions = KnownFunctions()
    data, buffers = packet.dumps(function)
    functions.learn(1, data, [memoryview(bytearray(buffer)) for buffer in buffers])
    return functions


def batch(
    functions: KnownFunctions, items: int, *, chunk: int = 1, eager: bool = False
) -> list[Any]:
    function = functions.get(1, chunk, eager=eager)
    return [function(item) for item in range(items)]


@pytest.mark.parametrize("function", [Counter().count, partial(log, [])], ids=["method", "partial"])
def test_each_chunk_has_its_own_copy(function: Callable[..., Any]) -> None:
    functions = known(function)
    assert batch(functions, 3) == [1, 1, 1]
    assert batch(functions, 5, chunk=2) == [1, 2, 1, 2, 1]
    assert batch(functions, 5, chunk=2) == [1, 2, 1, 2, 1]


def test_the_tasks_of_a_message_share_the_copy_of_a_large_function() -> None:
    counter = Counter()
    counter.table = np.zeros(LARGE)
    functions = known(counter.count)
    assert batch(functions, 3) == [1, 2, 3]
    assert batch(functions, 3) == [1, 2, 3]
    assert batch(functions, 3, eager=True) == [1, 1, 1]
    assert batch(functions, 3, chunk=2) == [1, 2, 1]


@pytest.mark.parametrize(
    "function",
    [
        log,
        Counter,
        Counter.make,
        math.sqrt,
        str.upper,
        partial(math.pow, 2.0),
        partial(partial(operator.add, 1), y=("a", 2, None)),
    ],
    ids=["function", "class", "classmethod", "builtin", "method", "partial", "nested partial"],
)
def test_what_cannot_change_is_unpickled_once(function: Callable[..., Any]) -> None:
    functions = known(function)
    assert functions.get(1, 1, eager=False) is functions.get(1, 1, eager=True)


@pytest.mark.parametrize(
    "make", [fiber.Queue, fiber.Lock, partial(fiber.RawValue, "i")], ids=["queue", "lock", "memory"]
)
def test_copies_share_what_stands_for_something_shared(make: Callable[[], Any]) -> None:
    functions = KnownFunctions()
    functions.learn(1, reduction.dumps(Counter(it=make()).named), [])
    function = functions.get(1, 1, eager=True)
    (first, it), (second, the_same), (third, too) = [function("it") for _ in range(3)]
    assert first == second == third == 1
    assert it is the_same is too


def test_an_object_that_pickles_only_in_the_program_is_copied_all_the_same() -> None:
    functions = known(Unrepeatable().count)
    assert batch(functions, 3) == [1, 1, 1]


class Unrepeatable(Counter):
    """Object whose copies do not pickle, and whose pickle names fiber."""

    def __reduce__(self) -> Any:
        return _refusing, ("fiber",)  # so the worker looks for shared objects


class Refusing(Counter):
    def __reduce__(self) -> Any:
        raise pickle.PicklingError("a copy")


def _refusing(_: str) -> Refusing:
    return Refusing()
