"""Results that nobody reads hold back the tasks that would bring more."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest

import fiber
from fiber import results
from fiber.pool import Pool
from processes.pool_programs import run_program, wait_until

RESULT = 1 << 16
HELD = 16 * RESULT
MANY = 400

Imap = Callable[..., Iterator[bytearray]]


def row_of(kind: Callable[[int], Any], size: int) -> tuple[Any]:
    """Something plain that holds much."""
    return (kind(size),)


@pytest.fixture
def pool(monkeypatch: pytest.MonkeyPatch) -> Iterator[Pool]:
    monkeypatch.setattr(results, "HELD", HELD)
    with fiber.Pool(2) as made:
        yield made
    made.join()


def _is_held_back(pool: Pool) -> bool:
    return any(job.paused for job in list(pool._executor._scheduler.ledger.jobs))


def _unread(iterator: Any) -> int:
    return len(iterator._buffer.items)


@pytest.mark.parametrize("method", ["imap", "imap_unordered"])
@pytest.mark.parametrize("source", [list, iter], ids=["a list", "an iterator"])
def test_an_unread_iterator_holds_back_its_tasks(
    pool: Pool, method: str, source: Callable[[Any], Any]
) -> None:
    imap: Imap = getattr(pool, method)
    iterator = imap(bytearray, source([RESULT] * MANY))
    wait_until(lambda: _is_held_back(pool), "it is held back")
    # The results that the workers had already computed come, and no more.
    assert _unread(iterator) < MANY // 2
    assert sum(map(len, iterator)) == MANY * RESULT


@pytest.mark.parametrize("chunksize", [1, 7])
@pytest.mark.parametrize("function", [bytes, partial(row_of, bytes), " ".__mul__])
def test_plain_results_count_too(
    pool: Pool, function: Callable[[int], Any], chunksize: int
) -> None:
    iterator = pool.imap(function, [RESULT] * MANY, chunksize)
    wait_until(lambda: _is_held_back(pool), "it is held back")
    assert _unread(iterator) < MANY // 2
    assert list(iterator) == [function(RESULT)] * MANY


def test_other_calls_go_on_meanwhile(pool: Pool) -> None:
    iterator = pool.imap(bytearray, [RESULT] * MANY)
    wait_until(lambda: _is_held_back(pool), "it is held back")
    assert pool.map(abs, range(-9, 0)) == list(range(9, 0, -1))
    assert len(list(iterator)) == MANY


def test_results_can_all_be_read_after_the_pool_is_joined(pool: Pool) -> None:
    iterator = pool.imap(bytearray, [RESULT] * MANY)
    wait_until(lambda: _is_held_back(pool), "it is held back")
    pool.close()
    pool.join()
    assert len(list(iterator)) == MANY


@pytest.mark.parametrize("bounds", [{}, {"buffersize": 5}], ids=["no bound", "buffersize"])
@pytest.mark.parametrize("dropped", ["when done", "before"])
def test_results_are_freed_when_their_iterator_is_dropped(
    bounds: dict[str, Any], dropped: str
) -> None:
    with fiber.Pool(1) as pool:
        gc.collect()
        gc.disable()
        try:
            iterator: Any = pool.imap(bytearray, iter([10, 20, 30]), **bounds)
            buffer = weakref.ref(iterator._buffer)
            if dropped == "when done":
                assert len(next(iterator)) == 10
                wait_until(lambda: iterator._buffer.finished, "all results are there")
            iterator = None
            wait_until(lambda: buffer() is None, "it is freed, by no collector")
        finally:
            gc.enable()
    pool.join()


def test_small_results_are_never_held_back(pool: Pool) -> None:
    iterator = pool.imap(abs, range(100_000))
    pool.close()
    wait_until(lambda: _unread(iterator) == 100_000, "all results are there")
    assert next(iterator) == 0


@pytest.mark.parametrize("method", ["imap", "imap_unordered"])
def test_an_iterator_that_is_dropped_keeps_no_results_and_holds_back_no_task(
    pool: Pool, method: str
) -> None:
    iterator: Any = getattr(pool, method)(bytearray, [RESULT] * MANY)
    wait_until(lambda: _is_held_back(pool), "it is held back")
    buffer = iterator._buffer
    iterator = None
    wait_until(lambda: buffer.finished, "its tasks are run")
    assert not buffer.items


def test_the_end_of_a_program_reads_no_more_than_the_buffer_of_a_map() -> None:
    done = run_program(
        """
        import atexit, fiber
        read = []
        atexit.register(lambda: print(len(read)))  # the last of the exit functions
        executor = fiber.Executor(1)
        results = executor.map(abs, map(lambda n: read.append(n) or n, range(3000)), buffersize=5)
        next(results)
        """
    )
    assert done.stdout == "6\n", done.stderr
