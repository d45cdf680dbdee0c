"""Waits for results, and their interruptions."""

from __future__ import annotations

import contextlib
import itertools
import sys
import threading
from collections import deque
from collections.abc import Iterator
from multiprocessing import TimeoutError
from typing import Any

import pytest

from fiber import results
from fiber._engine.chunks import TARGET
from fiber._runtime import work_items
from fiber._runtime.answers import Pickled, TaskFailure
from fiber._runtime.work_items import InputStream
from fiber._wire import work
from fiber.pool import MaybeEncodingError
from fiber.results import ApplyResult, IMapIterator, IMapUnorderedIterator, MapResult
from unit.interrupting import is_interrupted
from unit.ledger_steps import known


class Stop(BaseException):
    """Exception that a signal's handler raises."""


def result() -> ApplyResult[Any]:
    pool: Any = None
    return ApplyResult(pool)


def test_an_interrupted_wait_leaves_the_result_to_others(monkeypatch: pytest.MonkeyPatch) -> None:
    found = result()
    real = threading.Lock

    class Interrupted:
        """A lock whose acquirer is interrupted right after it got it."""

        def __init__(self) -> None:
            self._lock = real()

        def acquire(self, *args: Any) -> bool:
            taken = self._lock.acquire(*args[:1] and (False,))
            if args:
                raise Stop
            return taken

        def release(self) -> None:
            self._lock.release()

    monkeypatch.setattr(threading, "Lock", Interrupted)
    with pytest.raises(Stop):
        found.wait()
    monkeypatch.undo()
    found.add_results(0, [Pickled(work.VALUE, b"I3\n.", [])], True)
    found.set_done()
    assert found.get(0) == 3


def test_a_timed_out_wait_leaves_no_waiter() -> None:
    found = result()
    for _ in range(3):
        found.wait(0)
    assert found._done._waiters._locks == []


def test_a_latch_wakes_all_waiters() -> None:
    found = result()
    threads = [threading.Thread(target=found.wait) for _ in range(3)]
    for thread in threads:
        thread.start()
    found.add_results(0, [1], False)
    found.set_done()
    for thread in threads:
        thread.join()
    assert found.get() == 1


def iterator() -> IMapIterator[Any]:
    pool: Any = None
    return IMapIterator(pool)


def test_the_last_results_come_before_the_end() -> None:
    found = iterator()
    found._buffer.add_results(0, [1], False)
    found._buffer.set_done()
    assert found._buffer.wait(0) == 1
    with pytest.raises(StopIteration):
        found._buffer.wait(None)


def test_results_that_come_early_wait_for_their_turn() -> None:
    found = iterator()
    found._buffer.add_results(2, [2, 3], False)
    with pytest.raises(TimeoutError):
        found.next(0)
    found._buffer.add_results(0, [0, 1], False)
    assert [found.next(0) for _ in range(4)] == [0, 1, 2, 3]


def test_a_timed_out_wait_for_an_iterator_leaves_no_waiter() -> None:
    found = iterator()
    for _ in range(3):
        with pytest.raises(TimeoutError):
            found.next(0)
    found._buffer.add_results(0, [1], False)
    assert found._buffer.wait(0) == 1
    found._buffer.set_done()
    with pytest.raises(StopIteration):
        next(found)
    assert found._buffer._waiters._locks == []


def test_all_waiters_for_an_iterator_go_on() -> None:
    found = iterator()
    values: list[Any] = []
    threads = [threading.Thread(target=lambda: values.extend(found)) for _ in range(5)]
    for thread in threads:
        thread.start()
    for n in range(100):
        found._buffer.add_results(n, [n], False)
    found._buffer.set_done()
    for thread in threads:
        thread.join()
    assert sorted(values) == list(range(100))


def test_an_interrupted_wait_for_an_iterator_loses_no_result(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = iterator()

    class Interrupted:
        """The lock of one who waits, and is interrupted as a result comes."""

        def acquire(self, *args: Any) -> bool:
            if args:
                found._buffer.add_results(0, [3], False)
                raise Stop
            return True

        def release(self) -> None:
            pass

    monkeypatch.setattr(threading, "Lock", Interrupted)
    with pytest.raises(Stop):
        next(found)
    monkeypatch.undo()
    found._buffer.set_done()
    assert list(found) == [3]


def test_a_read_that_was_interrupted_at_any_step_asks_for_more_the_next_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(results, "HELD", 1)
    files = {results.__file__, work_items.__file__}

    def take_two(stop: int) -> bool:
        """Return whether it was interrupted, at step ``stop`` of taking the first."""
        asked: set[str] = set()
        found = iterator()
        buffer = found._buffer
        stream = InputStream(1, lambda: asked.add("input"), 1, buffer.consumed)
        buffer.stream, buffer.resume = stream, lambda: asked.add("results")
        stream.grant(0, 1, known(1.0, 1), TARGET)
        assert buffer.add_results(0, [3], False, 1), "it is full"
        stream._taken = 1
        stream.grant(0, 1, known(1.0, 1), TARGET)
        assert stream._granted == 1
        interrupted = is_interrupted(lambda: next(found), stop, files)
        with contextlib.suppress(TimeoutError):
            while True:
                found.next(0)
        assert asked == {"input", "results"}, f"interrupted at step {stop}"
        stream.grant(0, 1, known(1.0, 1), TARGET)
        assert stream._granted == 2
        assert buffer.has_room()
        return interrupted

    steps = next(stop for stop in itertools.count() if not take_two(stop))
    assert steps > 10, "it was hardly interrupted"


@pytest.mark.parametrize("ordered", [True, False])
def test_unread_results_are_held_back_at_a_cost_independent_of_their_number(
    ordered: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(results, "HELD", 1000)
    pool: Any = None
    found: IMapIterator[int]
    found = IMapIterator(pool) if ordered else IMapUnorderedIterator(pool)
    buffer, looked_at = found._buffer, 0
    buffer.resume = lambda: None

    class Counted(deque[Any]):
        def __iter__(self) -> Iterator[Any]:
            nonlocal looked_at
            looked_at += len(self)
            return super().__iter__()

    buffer.items = Counted()

    def add(start: int, stop: int) -> list[bool]:
        return [buffer.add_results(index, [index], False, 10) for index in range(start, stop)]

    def read(count: int) -> list[bool]:
        return [found.next(0) == -1 or buffer.has_room() for _ in range(count)]

    assert add(0, 200) == 99 * [False] + 101 * [True]
    assert read(99) == 99 * [False]
    assert add(200, 202) == [True, True], "half of all must be read"
    assert read(3) == [False, False, True]
    assert add(202, 203) == [True], "and yet there is more than may be"
    assert read(51) == 50 * [False] + [True]
    assert add(203, 253) == 49 * [False] + [True]
    assert looked_at == 0


@pytest.mark.parametrize(
    "outcome", [Pickled(work.VALUE, b"garbage", []), Pickled(work.ERROR, b"garbage", [])]
)
def test_a_map_whose_getting_is_interrupted_at_any_step_raises_its_error_the_next_time(
    outcome: Pickled,
) -> None:
    pool: Any = None

    def get_twice(stop: int) -> bool:
        """Return whether the first was interrupted, at step ``stop``."""
        found: MapResult[int] = MapResult(pool)
        found.add_results(0, [1, outcome, 3], True)
        found.set_done()

        def get() -> None:
            with contextlib.suppress(MaybeEncodingError):
                found.get()

        interrupted = is_interrupted(get, stop, {results.__file__})
        with pytest.raises(MaybeEncodingError):
            found.get()
        return interrupted

    steps = next(stop for stop in itertools.count() if not get_twice(stop))
    assert steps > 10, "it was hardly interrupted"


def test_an_iterator_raises_a_failed_task_and_goes_on_with_the_next() -> None:
    found = iterator()
    found._buffer.add_results(0, [TaskFailure(KeyError("one")), 2], True)
    with pytest.raises(KeyError):
        next(found)
    assert next(found) == 2


def test_an_iterator_that_is_dropped_lets_go_of_results_that_wait_for_an_earlier_one() -> None:
    pool: Any = None
    iterator: IMapIterator[Any] = IMapIterator(pool)
    buffer = iterator._buffer

    def resume() -> None:
        buffer.has_room()  # as the executor would, later

    buffer.resume = resume
    outcome = Pickled(work.VALUE, b"", [])
    holders = sys.getrefcount(outcome)
    buffer.add_results(1, [outcome], True)
    assert sys.getrefcount(outcome) > holders
    del iterator
    assert sys.getrefcount(outcome) == holders
    buffer.add_results(2, [outcome], True)
    assert sys.getrefcount(outcome) == holders
