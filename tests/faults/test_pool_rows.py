"""The rows of the table of what calls promise, each forced, on each backend."""

from __future__ import annotations

import functools
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import fiber
from faults import pool_targets as tasks
from faults.program import wait_for
from fiber.errors import MaybeEncodingError, StartError, WorkerDied
from fiber.pool import ApplyResult, Pool
from patience import PATIENCE

pytestmark = pytest.mark.usefixtures("backend")


@pytest.fixture
def pool() -> Iterator[Pool]:
    with fiber.Pool(2) as made:
        yield made
    made.join()


def works(pool: Pool) -> None:
    assert pool.map(abs, range(-5, 0)) == [5, 4, 3, 2, 1]


# The task raises


def test_the_exception_comes_with_the_remote_traceback(pool: Pool) -> None:
    with pytest.raises(LookupError, match="task 7 failed on purpose") as caught:
        pool.apply(tasks.fail, (7,))
    assert "pool_targets.py" in str(caught.value.__cause__)
    works(pool)


def test_every_kind_of_call_raises_it(pool: Pool) -> None:
    calls: list[Callable[[], Any]] = [
        lambda: pool.map(tasks.fail_if_odd, range(10)),
        lambda: pool.map(tasks.fail_if_odd, range(10), chunksize=3),
        lambda: list(pool.imap(tasks.fail_if_odd, range(10))),
        lambda: list(pool.imap_unordered(tasks.fail_if_odd, range(10))),
        lambda: pool.starmap(tasks.fail_if_odd, [(1,)] * 3),
        lambda: pool.map_async(tasks.fail_if_odd, range(10)).get(PATIENCE),
        lambda: pool.apply_async(tasks.fail, (3,)).get(PATIENCE),
    ]
    for call in calls:
        with pytest.raises(LookupError, match="on purpose"):
            call()
    works(pool)


# Unpicklable everything


@pytest.mark.parametrize(
    ("function", "error", "words"),
    [
        (tasks.return_lock, MaybeEncodingError, "lock"),
        (tasks.raise_unpicklable, MaybeEncodingError, "does not unpickle"),
    ],
)
def test_a_result_that_cannot_be_pickled_is_an_error_that_shows_it(
    pool: Pool, function: Any, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        pool.apply(function, (1,))
    with pytest.raises(error, match=words):
        pool.map(function, range(5))
    works(pool)


def test_an_argument_that_cannot_be_pickled_is_an_error_at_once(pool: Pool) -> None:
    lock: Any = threading.Lock()
    calls: list[Callable[[], Any]] = [
        lambda: pool.apply(abs, (lock,)),
        lambda: pool.apply(functools.partial(abs, lock)),
        lambda: pool.map(abs, [lock]),
        lambda: pool.starmap(abs, [(lock,)]),
        lambda: list(pool.imap(abs, [lock])),
    ]
    for call in calls:
        with pytest.raises(TypeError, match="lock"):
            call()
    works(pool)


# A child dies in a task


def test_a_task_whose_worker_dies_runs_again(pool: Pool, tmp_path: Path) -> None:
    work = functools.partial(tasks.die_once, str(tmp_path))
    assert pool.map(work, range(6), chunksize=1) == list(range(6))
    works(pool)


def test_a_poison_task_stops_after_its_retries_and_others_are_unaffected(pool: Pool) -> None:
    results = [pool.apply_async(tasks.die_if, (n, 3)) for n in range(8)]
    for number, result in enumerate(results):
        if number == 3:
            with pytest.raises(WorkerDied) as caught:
                result.get(PATIENCE)
        else:
            assert result.get(PATIENCE) == number
    error = caught.value
    assert error.attempts == 4
    assert error.exitcode == -signal.SIGKILL
    for words in ("die_if", "SIGKILL", "PoolWorker", error.host, "tried 4 times"):
        assert words in str(error), words
    works(pool)


def test_the_last_lines_of_a_dead_worker_are_in_the_error(backend: str) -> None:
    with fiber.Pool(1, retries=0) as pool, pytest.raises(WorkerDied) as caught:
        pool.apply(tasks.die)
    if backend == "loopback":  # local children write to the program's own stderr
        assert caught.value.log == ("about to die",)
        assert "  | about to die" in str(caught.value)


def test_a_task_that_ends_its_process(pool: Pool) -> None:
    with pytest.raises(WorkerDied, match="exit status"):
        pool.apply(tasks.leave, ("os._exit",))
    works(pool)


def test_sys_exit_is_an_exception_of_the_task(pool: Pool) -> None:
    calls: list[Callable[[], Any]] = [
        lambda: pool.apply(tasks.leave, ("sys.exit",)),
        lambda: pool.map(tasks.leave, ["sys.exit"] * 3),
        lambda: list(pool.imap(tasks.leave, ["sys.exit"])),
    ]
    for call in calls:
        with pytest.raises(SystemExit) as caught:
            call()
        assert caught.value.code == 4
        assert "in leave" in str(caught.value.__cause__)
        works(pool)


# Workers that never come to be


def test_an_initializer_that_raises_is_the_callers_error() -> None:
    pool = fiber.Pool(2, initializer=tasks.fail_to_initialize)
    with pytest.raises(StartError, match="the data set is not there"):
        pool.apply(abs, (-1,))
    with pytest.raises(StartError):
        pool.map(abs, range(10))
    pool.terminate()
    pool.join()


def test_workers_that_die_at_their_start_are_reported() -> None:
    pool = fiber.Pool(2, initializer=tasks.die)
    with pytest.raises(StartError, match="SIGKILL"):
        pool.apply(abs, (-1,))
    pool.terminate()
    pool.join()


# Retries, timeouts


def test_an_exception_that_should_be_retried(tmp_path: Path) -> None:
    with fiber.Pool(2, retry_exceptions=(ConnectionError,), retries=2) as pool:
        assert pool.apply(tasks.count_calls, (str(tmp_path), 1, 3)) == 3
        with pytest.raises(ConnectionError, match="call 3"):
            pool.apply(tasks.count_calls, (str(tmp_path), 2, 9))


def test_error_handling_is_bounded(tmp_path: Path) -> None:
    with fiber.Pool(2, error_handling=True) as pool:
        assert pool.apply(tasks.count_calls, (str(tmp_path), 1, 3)) == 3
        with pytest.raises(LookupError):
            pool.apply(tasks.fail, (1,))


@pytest.mark.parametrize("function", [tasks.report_pid_and_block, tasks.spin_until_killed])
def test_a_task_over_its_timeout_is_killed(pool: Pool, function: Any, tmp_path: Path) -> None:
    with pytest.raises(fiber.TimeoutError, match=r"longer than its timeout of 0\.3 s"):
        pool.apply(function, (str(tmp_path),), timeout=0.3)
    works(pool)


# The end


def test_terminate_is_prompt_with_much_queued_and_workers_blocked(tmp_path: Path) -> None:
    pool = fiber.Pool(2)
    blocked = [pool.apply_async(tasks.spin_until_killed, (str(tmp_path),)) for _ in range(2)]
    queued = pool.map_async(tasks.pid, range(10_000), chunksize=1)
    lazy = pool.imap(tasks.pid, range(10_000_000))
    wait_for(lambda: len(list(tmp_path.iterdir())) == 2)
    pool.terminate()
    pool.join()
    results: list[ApplyResult[Any]] = [*blocked, queued]
    for result in results:
        assert not result.ready() or not result.successful()
    del lazy


def test_close_and_join_finish_the_submitted_tasks(tmp_path: Path) -> None:
    pool = fiber.Pool(2)
    work = functools.partial(tasks.note_and_return, str(tmp_path))
    result = pool.map_async(work, range(50), chunksize=1)
    pool.close()
    with pytest.raises(ValueError, match="not running"):
        pool.apply(abs, (-1,))
    pool.join()
    assert result.get(0) == list(range(50))
    assert len(list(tmp_path.iterdir())) == 50, "each ran once"


def test_a_second_get_gives_the_same_again(pool: Pool) -> None:
    result = pool.map_async(abs, [-1, -2])
    assert result.get(PATIENCE) == result.get(PATIENCE) == [1, 2]
    error = pool.apply_async(tasks.fail, (1,))
    for _ in range(2):
        with pytest.raises(LookupError):
            error.get(PATIENCE)


def test_workers_are_replaced_after_maxtasksperchild() -> None:
    with fiber.Pool(2, maxtasksperchild=3) as pool:
        pids = pool.map(tasks.pid, range(24), chunksize=1)
    assert len(set(pids)) >= 8
    assert max(pids.count(pid) for pid in pids) <= 3


def test_pools_in_pools_in_pools(pool: Pool) -> None:
    assert pool.apply(tasks.nested, (2,)) == 2
