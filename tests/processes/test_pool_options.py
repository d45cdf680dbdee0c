"""Options and arguments of a pool that are refused, on the local backend."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import fiber
from fiber.pool import Pool
from patience import PATIENCE
from processes import pool_tasks as tasks


@pytest.fixture
def pool() -> Iterator[Pool]:
    with fiber.Pool(2) as pool:
        yield pool
    pool.join()


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"processes": 0}, ValueError, "Number of processes must be at least 1"),
        ({"processes": -1}, ValueError, "Number of processes must be at least 1"),
        ({"maxtasksperchild": 0}, ValueError, "maxtasksperchild must be a positive int or None"),
        ({"maxtasksperchild": 0.5}, ValueError, "maxtasksperchild must be a positive int or None"),
        ({"maxtasksperchild": "9"}, ValueError, "maxtasksperchild must be a positive int or None"),
        ({"initializer": 1}, TypeError, "initializer must be a callable"),
        ({"processes": 2, "max_workers": 4}, (TypeError, ValueError), "processes"),
        ({"min_workers": 1.5}, TypeError, "min_workers.*1.5"),
        ({"max_workers": "2"}, TypeError, "max_workers.*'2'"),
        ({"retries": True}, TypeError, "retries.*True"),
        ({"task_timeout": "3"}, TypeError, "task_timeout.*'3'"),
        ({"idle_timeout": "x"}, TypeError, "idle_timeout.*'x'"),
        ({"task_timeout": math.nan}, ValueError, "task_timeout.*nan"),
        ({"processes": 2, "min_workers": 1}, ValueError, "processes="),
        ({"min_workers": 3, "max_workers": 2}, ValueError, "min_workers=3"),
        ({"min_workers": -1, "max_workers": 2}, ValueError, "min_workers=-1"),
        ({"min_workers": 0, "max_workers": 0}, ValueError, "max_workers"),
        ({"retries": -1}, ValueError, "retries"),
        ({"retries": 1.5}, TypeError, "retries must be a whole number, not 1.5"),
        ({"processes": 2.0}, TypeError, "processes must be a whole number, not 2.0"),
        ({"task_timeout": 0}, ValueError, "task_timeout"),
        ({"idle_timeout": -1}, ValueError, "idle_timeout"),
        ({"retry_exceptions": [1]}, TypeError, "retry_exceptions must be exception classes"),
        ({"retry_exceptions": int}, TypeError, "retry_exceptions"),
    ],
)
def test_bad_options_are_named(options: dict[str, Any], error: Any, text: str) -> None:
    with pytest.raises(error, match=text):
        fiber.Pool(**options)


def test_bad_arguments_are_named(pool: Pool) -> None:
    calls: list[Any] = [pool.map, pool.map_async, pool.imap, pool.imap_unordered]
    for call in calls:
        with pytest.raises(ValueError, match="Chunksize must be 1"):
            call(tasks.square, range(3), 0)
        for size in (1.5, "2", True):
            with pytest.raises(TypeError, match=f"chunksize must be a whole number, not {size!r}"):
                call(tasks.square, range(3), size)
        with pytest.raises(TypeError, match=r"timeout must be a number of seconds .* '2'"):
            call(tasks.square, range(3), timeout="2")
        with pytest.raises(TypeError, match="progress must be True, False or a text, not 1"):
            call(tasks.square, range(3), progress=1)
    with pytest.raises(TypeError, match="chunksize"):
        pool.imap(tasks.square, range(3), cast("Any", None))
    with pytest.raises(TypeError, match="buffersize"):
        pool.imap(tasks.square, range(3), buffersize=cast("Any", 1.5))
    with pytest.raises(ValueError, match="timeout"):
        pool.apply(tasks.square, (1,), timeout=0)
    with pytest.raises(ValueError, match="buffersize"):
        pool.imap(tasks.square, range(3), buffersize=0)
    with pytest.raises(TypeError):
        pool.map(tasks.square, 3)  # type: ignore[arg-type]


CALLS: dict[str, Callable[[Any, Any], Any]] = {
    "map": lambda pool, function: pool.map(function, [1]),
    "map_async": lambda pool, function: pool.map_async(function, [1]).get(PATIENCE),
    "starmap": lambda pool, function: pool.starmap(function, [(1,)]),
    "imap": lambda pool, function: pool.imap(function, [1]).next(PATIENCE),
    "apply": lambda pool, function: pool.apply_async(function).get(PATIENCE),
    "broadcast": lambda pool, function: pool.broadcast(function),
}


@pytest.mark.parametrize("call", CALLS)
def test_a_function_that_cannot_be_called_is_an_error_and_no_hang(pool: Pool, call: str) -> None:
    with pytest.raises(TypeError, match="'NoneType' object is not callable"):
        CALLS[call](pool, None)


@pytest.mark.parametrize("size", [2**32 - 1, 2**32, sys.maxsize])
def test_all_in_one_chunk(pool: Pool, size: int) -> None:
    assert pool.map(tasks.square, range(10), size) == [x * x for x in range(10)]
    assert list(pool.imap(tasks.square, iter(range(10)), size)) == [x * x for x in range(10)]


def test_numbers_may_be_numpys(pool: Pool) -> None:
    size: Any = np.int64(2)
    timeout: Any = np.float32(9)
    assert pool.map(tasks.square, range(4), size, timeout=timeout) == [0, 1, 4, 9]


def test_a_timeout_says_how_long_it_waited(pool: Pool, tmp_path: Path) -> None:
    result = pool.apply_async(tasks.wait_for, (tmp_path / "gate",))
    iterator = pool.imap(tasks.wait_for, [tmp_path / "gate"])
    with pytest.raises(fiber.TimeoutError, match=r"no result within 0\.02 s"):
        result.get(0.02)
    with pytest.raises(fiber.TimeoutError, match=r"no result within 0\.02 s"):
        iterator.next(0.02)
    (tmp_path / "gate").touch()
    assert result.get(PATIENCE) == next(iterator) == "gate"
