"""The backend of joblib: whose workers it uses, what becomes of errors, what it refuses."""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pytest

import fiber.joblib
from faults.runtime import running
from processes import pool_tasks as tasks
from processes.pool_programs import wait_until

call = joblib.delayed


@pytest.fixture(autouse=True)
def _nothing_kept() -> Iterator[None]:
    """The executor that the next loop would have is not for the next test."""
    yield
    end_kept_workers()


def end_kept_workers() -> None:
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


@pytest.mark.slow
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


def test_a_single_job_runs_in_this_process() -> None:
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
        pytest.raises(ValueError, match="give retries, inner_max_num_threads to that executor"),
    ):
        fiber.joblib.FiberBackend(executor=executor, retries=1, inner_max_num_threads=2)


# Large arrays


def look(array: Any) -> tuple[int, bool, float]:
    """Return how a task sees an array: its inode, whether it is read-only, and its sum."""
    address = array.__array_interface__["data"][0]
    for line in Path("/proc/self/maps").read_text().splitlines():
        limits, _, _, _, inode, *_ = line.split()
        first, end = (int(limit, 16) for limit in limits.split("-"))
        if first <= address < end:
            return int(inode), not array.flags.writeable, float(array.sum())
    raise AssertionError("memory that is not mapped")


def seen(array: Any, **options: Any) -> list[tuple[int, bool]]:
    """Return how each task of a loop sees this array: inodes, and whether it is read-only."""
    options = {"max_nbytes": LARGE, "batch_size": 1, **options}
    found = joblib.Parallel(2, backend="fiber", **options)(call(look)(array) for _ in range(5))
    assert {total for *_, total in found} == {float(array.sum())}
    return [each[:2] for each in found]


LARGE = 100_000
"""Bytes; of memory that is not shared, and not that of the interpreter's small objects."""


@pytest.mark.parametrize("order", ["C", "F"])
def test_an_array_that_is_sent_again_is_shared(order: Any) -> None:
    array = np.arange(2.0 * LARGE).reshape((2, LARGE), order=order)
    first, *others = seen(array)
    assert first == (0, True), "pickling it once takes less time"
    ((inode, read_only),) = set(others)
    assert inode
    assert read_only


def test_arrays_that_are_small_or_not_to_be_shared_are_copied() -> None:
    array = np.arange(float(LARGE))
    for options in ({"max_nbytes": array.nbytes}, {"max_nbytes": None}, {"mmap_mode": None}):
        assert set(seen(array, **options)) == {(0, False)}


def test_too_many_arrays_are_copied() -> None:
    arrays = [np.full(LARGE, n) for n in range(66)]
    parallel = joblib.Parallel(2, backend="fiber", batch_size=1, max_nbytes=LARGE)
    found = parallel(call(look)(array) for _ in range(2) for array in arrays)
    assert len({inode for inode, *_ in found[66:]}) == 65
    assert [total for *_, total in found] == [n * LARGE for n in range(66)] * 2


@pytest.mark.slow
def test_writing_to_arrays_is_as_the_mode_says() -> None:
    array = np.zeros(LARGE)
    options: Any = {"backend": "fiber", "batch_size": 1, "max_nbytes": LARGE}
    for count in (1, 2):
        with pytest.raises(ValueError, match="read-only"):
            joblib.Parallel(2, **options)([call(np.ndarray.fill)(array, 1)] * count)
    joblib.Parallel(2, **options, mmap_mode="c")([call(np.ndarray.fill)(array, 1)] * 3)
    assert set(seen(array, mmap_mode="c")) == {(0, False)}


@pytest.mark.parametrize("max_nbytes", ["1M", None])
def test_a_mapped_array_is_mapped_in_the_worker(max_nbytes: Any, tmp_path: Path) -> None:
    mapped = np.memmap(tmp_path / "array", mode="w+", shape=100)
    parallel = joblib.Parallel(2, backend="fiber", max_nbytes=max_nbytes)
    parallel(call(np.ndarray.fill)(half, 1) for half in np.split(mapped, 2))
    assert mapped.all()


def test_memory_without_a_name_is_copied() -> None:
    array = np.ndarray(100, np.uint8, mmap.mmap(-1, 100))
    assert set(seen(array)) == {(0, False)}


@pytest.mark.slow
def test_on_other_hosts_arrays_are_copied() -> None:
    with running(backend="loopback"):
        assert set(seen(np.arange(float(LARGE)))) == {(0, True)}
        end_kept_workers()
