"""Progress of a pool's maps, on each backend: the lines of a program without a terminal."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Iterator
from typing import Any

import pytest

import fiber
from census import wait_until
from fiber import config
from fiber._runtime import progress
from fiber.pool import Pool
from patience import PATIENCE
from processes import pool_tasks as tasks

pytestmark = pytest.mark.usefixtures("backend")


@pytest.fixture
def pool() -> Iterator[Pool]:
    with fiber.Pool(2) as pool:
        yield pool
    pool.join()


@contextlib.contextmanager
def running_with(**settings: Any) -> Iterator[None]:
    """Change keys of the configuration for a ``with`` block."""
    before = config.current()
    for key, value in settings.items():
        config.assign(key, value)
    yield
    config._current["config"] = before


def reported(capsys: pytest.CaptureFixture[str]) -> list[str]:
    found: list[str] = re.findall(r"\[fiber\] (.*? tasks)", capsys.readouterr().err)
    return found


def is_shown() -> bool:
    return "fiber-progress" in [thread.name for thread in threading.enumerate()]


@pytest.mark.parametrize("name", ["map", "starmap"])
def test_a_map_reports_its_end_before_it_returns(
    pool: Pool, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    items: Any = [(n,) for n in range(5)] if name == "starmap" else range(5)
    assert getattr(pool, name)(tasks.square, items, progress=True) == [0, 1, 4, 9, 16]
    assert reported(capsys) == ["square: 5 of 5 tasks"]


def test_a_label_takes_the_place_of_the_functions_name(
    pool: Pool, capsys: pytest.CaptureFixture[str]
) -> None:
    pool.map(tasks.square, iter(range(5)), progress="generation 1")
    assert reported(capsys) == ["generation 1: 5 of 5 tasks"]


def test_failed_tasks_are_counted(pool: Pool, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="3"):
        pool.map(tasks.raise_if_odd, [2, 3, 4], progress=True)
    err = capsys.readouterr().err
    assert "3 of 3 tasks" in err
    assert "1 failed" in err


@pytest.mark.parametrize("name", ["map_async", "starmap_async", "imap", "imap_unordered"])
def test_other_maps_report_their_end(
    pool: Pool, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    items: Any = [(n,) for n in range(5)] if name == "starmap_async" else range(5)
    result = getattr(pool, name)(tasks.square, items, progress=True)
    assert sorted(result if name.startswith("imap") else result.get()) == [0, 1, 4, 9, 16]
    assert reported(capsys) == ["square: 5 of 5 tasks"]


def test_a_map_that_is_given_up_ends_its_progress(pool: Pool) -> None:
    iterator = pool.imap(tasks.square, range(1_000_000), progress=True)
    next(iterator)
    del iterator
    assert wait_until(lambda: not is_shown(), PATIENCE)


def fails() -> Iterator[int]:
    yield 1
    raise LookupError("the input fails")


@pytest.mark.parametrize("name", ["map", "map_async"])
def test_input_that_raises_ends_the_progress(pool: Pool, name: str) -> None:
    with pytest.raises(LookupError, match="the input fails"):
        getattr(pool, name)(tasks.square, fails(), progress=True)
    assert wait_until(lambda: not is_shown(), PATIENCE)


def test_a_pool_that_is_terminated_ends_the_progress(
    pool: Pool, capsys: pytest.CaptureFixture[str]
) -> None:
    result = pool.map_async(tasks.square, range(1_000_000), chunksize=1, progress="many")
    pool.terminate()
    assert len(reported(capsys)) == 1
    with pytest.raises(fiber.FiberError, match="terminated"):
        result.get()


def test_the_configuration_shows_maps_unless_their_call_refuses(
    pool: Pool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "QUIET", 0.0)
    with running_with(progress="always"):
        pool.map(tasks.square, range(5))
        pool.map(tasks.square, range(5), progress=False)
    assert reported(capsys) == ["square: 5 of 5 tasks"]


def test_the_map_of_an_executor(capsys: pytest.CaptureFixture[str]) -> None:
    with fiber.Executor(2) as executor:
        assert list(executor.map(pow, [2, 3], iter([3, 2]), progress=True)) == [8, 9]
        assert reported(capsys) == ["pow: 2 of 2 tasks"]
        with pytest.raises(ValueError, match="3"):
            list(executor.map(tasks.raise_if_odd, [2, 3, 4], progress="fails"))
        assert len(reported(capsys)) == 1
        assert list(executor.map(tasks.square, [2])) == [4]
        assert reported(capsys) == []
        with pytest.raises(TypeError, match="progress must be"):
            executor.map(tasks.square, [2], progress=1)  # type: ignore[arg-type]


def test_a_loop_of_joblib_follows_the_configuration(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    joblib = pytest.importorskip("joblib", reason="joblib is optional, as for users")
    import fiber.joblib

    monkeypatch.setattr(progress, "QUIET", 0.0)
    calls = [joblib.delayed(tasks.square)(n) for n in range(5)]
    with (
        fiber.Executor(2) as executor,
        running_with(progress="always"),
        joblib.parallel_config(backend="fiber", executor=executor, n_jobs=2),
    ):
        assert joblib.Parallel()(calls) == [0, 1, 4, 9, 16]
        assert reported(capsys) == ["joblib: 5 of 5 tasks"]
        assert joblib.Parallel()(iter(calls)) == [0, 1, 4, 9, 16]
        assert reported(capsys) == ["joblib: 5 of 5 tasks"]
        joblib.Parallel(verbose=1)(calls)
        assert reported(capsys) == []
        with pytest.raises(ValueError, match="3"):
            joblib.Parallel()([joblib.delayed(tasks.raise_if_odd)(3)])
        assert len(reported(capsys)) == 1


def test_a_map_without_progress_prints_nothing(
    pool: Pool, capsys: pytest.CaptureFixture[str]
) -> None:
    pool.map(tasks.square, range(5))
    assert reported(capsys) == []
