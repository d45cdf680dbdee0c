"""Callbacks that wait for other results of their pool or executor."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest

import fiber
from census import wait_until
from fiber import futures
from fiber.pool import MaybeEncodingError
from patience import PATIENCE
from processes import pool_tasks as tasks


class Waits:
    """Waits for another call when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _ask, ()


class WaitsWhenPickled:
    """Waits for another call when it is pickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return str, (_ask(),)


_asked: list[tuple[fiber.Executor, Path]] = []
"""The executor, and the file without which the call does not end: the caller does wait for it."""


def _ask() -> object:
    executor, gate = _asked[0]
    return executor.submit(return_later, gate, 3).result(PATIENCE)


def return_later(gate: Path, value: object) -> object:
    tasks.wait_for(gate)
    return value


def make_waits() -> Waits:
    return Waits()


@pytest.fixture
def executor() -> Iterator[fiber.Executor]:
    with fiber.Executor(2) as executor:
        yield executor


def test_a_callback_may_wait_for_results_that_have_callbacks() -> None:
    with fiber.Pool(2) as pool:
        later: list[object] = []
        found: list[object] = []
        known, finished = threading.Event(), threading.Event()

        def call_back(value: int) -> None:
            known.wait(PATIENCE)
            single = pool.apply_async(tasks.square, (value,), callback=later.append)
            several = pool.map_async(tasks.square, [1, 2], callback=later.append)
            failed = pool.apply_async(tasks.raise_value_error, (1,), error_callback=later.append)
            found.append(outer.get(PATIENCE))  # its callback is this very one
            found.extend((single.get(PATIENCE), several.get(PATIENCE)))
            failed.wait(PATIENCE)
            found.extend((failed.ready(), failed.successful()))
            found.extend(later)
            finished.set()

        outer = pool.apply_async(tasks.square, (2,), callback=call_back)
        known.set()
        assert finished.wait(PATIENCE)
        assert found == [4, 16, [1, 4], True, False]  # one callback after the other
        assert wait_until(lambda: len(later) == 3, PATIENCE)


@pytest.mark.parametrize(
    "wait",
    [
        lambda future: future.result(PATIENCE),
        lambda future: future.exception(PATIENCE),
        lambda future: futures.wait([future], PATIENCE),
        lambda future: list(futures.as_completed([future], PATIENCE)),
    ],
    ids=["result", "exception", "wait", "as_completed"],
)
@pytest.mark.parametrize("value", [3, Decimal(3)], ids=["plain", "unpickled"])
def test_a_callback_may_wait_for_other_futures(
    executor: fiber.Executor,
    tmp_path: Path,
    wait: Callable[[futures.Future[Any]], object],
    value: Any,
) -> None:
    waited: futures.Future[list[object]] = futures.Future()

    def call_back(_: futures.Future[int]) -> None:
        other = executor.submit(return_later, tmp_path / "gate", value)
        other.add_done_callback(lambda future: later.set_result(waited.done()))
        (tmp_path / "gate").touch()
        wait(other)
        waited.set_result([other.done(), other.result()])

    later: futures.Future[bool] = futures.Future()
    executor.submit(tasks.square, 2).add_done_callback(call_back)
    assert waited.result(PATIENCE) == [True, value]
    assert later.result(PATIENCE)  # one callback after the other


def test_pickling_and_unpickling_cannot_wait_for_results_of_the_same_executor(
    executor: fiber.Executor, tmp_path: Path
) -> None:
    gate = tmp_path / "gate"
    _asked[:] = [(executor, gate)]
    with pytest.raises(MaybeEncodingError, match="cannot wait for another result"):
        executor.submit(make_waits).result(PATIENCE)
    with pytest.raises(RuntimeError, match="cannot wait for a result of the same pool"):
        list(executor.map(tasks.identity, [WaitsWhenPickled()]))
    gate.touch()
    _asked.clear()
