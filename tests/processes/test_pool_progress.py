"""Progress of a pool's maps, on each backend: the lines of a program without a terminal."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from typing import Any

import pytest

import fiber
from census import wait_until
from fiber.pool import Pool
from patience import PATIENCE
from processes import pool_tasks as tasks

pytestmark = pytest.mark.usefixtures("backend")


@pytest.fixture
def pool() -> Iterator[Pool]:
    with fiber.Pool(2) as pool:
        yield pool
    pool.join()


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
    assert wait_until(lambda: not is_shown(), PATIENCE)
    assert reported(capsys) == ["square: 5 of 5 tasks"]


def test_a_map_that_is_given_up_ends_its_progress(pool: Pool) -> None:
    iterator = pool.imap(tasks.square, range(1_000_000), progress=True)
    next(iterator)
    del iterator
    assert wait_until(lambda: not is_shown(), PATIENCE)


def test_a_map_without_progress_prints_nothing(
    pool: Pool, capsys: pytest.CaptureFixture[str]
) -> None:
    pool.map(tasks.square, range(5))
    assert reported(capsys) == []
