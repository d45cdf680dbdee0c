"""The backend of joblib: whose workers it uses, what becomes of errors, what it refuses."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pytest

import fiber.joblib
from unit import pool_tasks as tasks
from unit.pool_programs import wait_until

call = joblib.delayed


@pytest.fixture(autouse=True)
def _nothing_kept() -> Iterator[None]:
    """The executor that the next loop would have is not for the next test."""
    yield
    while fiber.joblib._kept:
        fiber.joblib._kept.pop().executor.shutdown()


def squares(parallel: joblib.Parallel, count: int = 20) -> bool:
    found: list[int] = parallel(call(tasks.square)(n) for n in range(count))
    return found == [n * n for n in range(count)]


def test_loops_run_in_workers_of_one_executor() -> None:
    with joblib.parallel_config(backend="fiber", n_jobs=2):
        first = set(joblib.Parallel()(call(tasks.pid)() for _ in range(20)))
        second = set(joblib.Parallel()(call(tasks.pid)() for _ in range(20)))
    assert os.getpid() not in first | second
    assert len(first | second) <= 2


def test_an_executor_of_the_users_is_used_and_left_as_it_was() -> None:
    with fiber.Executor(2) as executor:
        pids = {executor.submit(tasks.pid).result() for _ in range(20)}
        with joblib.parallel_config(backend="fiber", executor=executor, n_jobs=-1):
            assert joblib.effective_n_jobs() == 2
            assert len(pids | set(joblib.Parallel()(call(tasks.pid)() for _ in range(20)))) <= 2
        assert executor.submit(tasks.square, 2).result() == 4


def test_a_generator_of_results_and_arrays() -> None:
    array = np.arange(1000.0)
    parallel = joblib.Parallel(2, backend="fiber", return_as="generator")
    for found in parallel(call(np.multiply)(array, n) for n in range(5)):
        assert found[1] in range(5)


def test_options_are_the_executors(tmp_path: Path) -> None:
    log = tmp_path / "log"
    backend: Any = {"backend": "fiber", "n_jobs": 2, "retries": 0}
    with joblib.parallel_config(**backend), pytest.raises(fiber.WorkerDied):
        joblib.Parallel()(call(tasks.die_when_counted)(log) for _ in range(2))
    assert tasks.runs(log) <= 2


def test_initializer_and_threads(tmp_path: Path) -> None:
    parallel = joblib.Parallel(2, backend="fiber", initializer=os.chdir, initargs=(tmp_path,))
    assert parallel([call(os.getcwd)()] * 3) == [str(tmp_path)] * 3
    assert set(parallel([call(os.getenv)("OMP_NUM_THREADS")] * 3)) != {None}
    with joblib.parallel_config(backend="fiber", n_jobs=2, inner_max_num_threads=3):
        assert joblib.Parallel()([call(os.getenv)("OMP_NUM_THREADS")] * 2) == ["3", "3"]


def test_an_error_ends_the_loop_and_its_workers(tmp_path: Path) -> None:
    with joblib.Parallel(2, backend="fiber") as parallel:
        with pytest.raises(ValueError, match="3"):
            parallel([call(tasks.wait_for)(tmp_path / "gate"), call(tasks.raise_if_odd)(3)])
        assert squares(parallel)


def test_an_error_leaves_the_workers_of_the_users_executor() -> None:
    with fiber.Executor(2) as executor:
        executor.submit(tasks.pid).result()
        with joblib.parallel_config(backend="fiber", executor=executor, n_jobs=2):
            with pytest.raises(ValueError, match="3"):
                joblib.Parallel()(call(tasks.raise_if_odd)(n) for n in [3] + [0] * 1000)
            assert squares(joblib.Parallel())
        assert executor.submit(tasks.square, 3).result() == 9


def test_a_time_limit(tmp_path: Path) -> None:
    parallel = joblib.Parallel(2, backend="fiber", timeout=0.2)
    with pytest.raises(fiber.TimeoutError):
        parallel(call(tasks.wait_for)(tmp_path / "gate") for _ in range(2))


def test_loops_one_after_the_other_have_the_same_workers() -> None:
    def workers(**options: Any) -> set[int]:
        parallel = joblib.Parallel(2, backend="fiber", **options)
        return set(parallel(call(tasks.pid)() for _ in range(20)))

    first = workers()
    assert len(first | workers()) <= 2
    assert not first & workers(initializer=os.getpid)
    assert not first & workers()  # only the last ones are kept
    arrays = [(np.zeros(2),), (np.zeros(2),)]
    assert not set.intersection(*(workers(initializer=id, initargs=each) for each in arrays))


def test_workers_that_no_loop_uses_leave() -> None:
    assert squares(joblib.Parallel(2, backend="fiber", idle_timeout=0.05))
    (kept,) = fiber.joblib._kept
    wait_until(lambda: not kept.executor._processes, "they are idle for too long")


def test_a_loop_over_the_results_of_another() -> None:
    with joblib.parallel_config(backend="fiber", n_jobs=2):
        outer = joblib.Parallel(return_as="generator", pre_dispatch=2, batch_size=1)
        found = outer(call(tasks.square)(n) for n in range(50))
        assert [next(found), squares(joblib.Parallel()), next(found)] == [0, True, 1]
        assert list(found) == [n * n for n in range(2, 50)]


def test_an_executor_that_is_shut_down_during_the_loop() -> None:
    executor = fiber.Executor(2)
    backend = fiber.joblib.FiberBackend(executor=executor)
    parallel = joblib.Parallel(
        2, backend=backend, return_as="generator", pre_dispatch=2, batch_size=1
    )
    found = parallel(call(tasks.square)(n) for n in range(1_000_000))
    assert next(found) == 0
    executor.shutdown(wait=False)
    with pytest.raises(RuntimeError, match="cannot schedule new futures after shutdown"):
        list(found)
    executor.shutdown()


def in_a_task(count: int) -> list[int]:
    found: list[int] = joblib.Parallel(2)(call(tasks.square)(n) for n in range(count))
    return found


def test_loops_in_tasks() -> None:
    with joblib.parallel_config(backend="fiber", n_jobs=2):
        assert joblib.Parallel()(call(in_a_task)(n) for n in (2, 3)) == [[0, 1], [0, 1, 4]]


def test_one_job_runs_here() -> None:
    with joblib.parallel_config(backend="fiber", n_jobs=1):
        assert joblib.Parallel()([call(os.getpid)()]) == [os.getpid()]


@pytest.mark.parametrize(
    ("options", "error", "says"),
    [
        ({"executor": 3}, TypeError, "executor must be a fiber.Executor, not 3"),
        ({"temperature": 3}, TypeError, "the backend fiber has no temperature: expected executor"),
        ({"n_jobs": 0}, ValueError, "n_jobs == 0 in Parallel has no meaning"),
        ({"retries": -1}, ValueError, "retries must be a whole number of at least 0"),
    ],
)
def test_bad_options(options: Any, error: type[Exception], says: str) -> None:
    with (
        pytest.raises(error, match=says),
        joblib.parallel_config(**{"backend": "fiber", "n_jobs": 2, **options}),
    ):
        joblib.Parallel()([call(tasks.square)(1)] * 2)


def test_options_of_workers_that_are_there() -> None:
    with (
        fiber.Executor(1) as executor,
        pytest.raises(ValueError, match="give retries, inner_max_num_threads to that one"),
    ):
        fiber.joblib.FiberBackend(executor=executor, retries=1, inner_max_num_threads=2)
