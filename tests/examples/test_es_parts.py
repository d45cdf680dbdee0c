"""The parts of examples/02-es whose errors would not be noticed."""

from __future__ import annotations

import importlib
import os
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from examples.run_example import EXAMPLES
from patience import PATIENCE


@pytest.fixture
def es(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports a module of the example."""
    monkeypatch.syspath_prepend(str(EXAMPLES / "02-es"))
    return importlib.import_module


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_equal_returns_have_equal_ranks(es: Any) -> None:
    ranks = es("evolution").centred_ranks(np.array([[-500.0, -100.0], [-500.0, 7e9]]))
    np.testing.assert_allclose(ranks, [[-1 / 3, 1 / 6], [-1 / 3, 1 / 2]], rtol=1e-6)


def test_evolution_finds_the_top_of_a_function(es: Any) -> None:
    """Find the known top of a function, with any order of the answers."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(10_000, dtype=np.float32)
    top = np.array([1.0, -2.0, 0.5], dtype=np.float32)
    search = es("evolution").Evolution(np.zeros(3, dtype=np.float32), noise, rng)

    def height(theta: Any) -> float:
        return -float(np.square(theta - top).sum())

    for _ in range(100):
        returns = {}
        for candidate in reversed(search.candidates(16)):
            start = candidate.noise_index
            step = search.sigma * noise[start : start + 3]
            returns[start] = (height(search.theta + step), height(search.theta - step))
        search.update(returns)
    np.testing.assert_allclose(search.theta, top, atol=0.2)


def test_threads_that_open_the_table_at_once_share_one_file(
    es: Any, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All start before the first one ends, and all end up with the same file."""
    table = es("noise").NoiseTable("test", seed=3, length=3_000_000)
    together = threading.Barrier(4, timeout=PATIENCE)
    link = os.link

    def link_together(source: str, target: str) -> None:
        together.wait()
        link(source, target)

    monkeypatch.setattr(os, "link", link_together)
    with ThreadPoolExecutor(4) as threads:
        made = [threads.submit(table.open) for _ in range(4)]
    tables = [future.result() for future in made]
    assert list(temporary.iterdir()) == [table.path]
    assert inodes_mapped(table.path) == {table.path.stat().st_ino}
    assert np.array_equal(tables[0], np.random.default_rng(3).standard_normal(3_000_000, "f4"))
    table.remove()
    assert not list(temporary.iterdir())


def inodes_mapped(path: Path) -> set[int]:
    """The files that this process has mapped into memory under this name, now or before."""
    maps = Path("/proc/self/maps").read_text().splitlines()
    return {int(line.split()[4]) for line in maps if path.name in line}


def test_table_is_read_only(es: Any, temporary: Path) -> None:
    table = es("noise").NoiseTable("test", seed=3, length=10).open()
    with pytest.raises(ValueError, match="read-only"):
        table[0] = 1


def test_remove_includes_incomplete_files(es: Any, temporary: Path) -> None:
    """Remove also the file of a process that was killed while it wrote the table."""
    noise = es("noise")
    (temporary / "fiber-es-noise-test-x1y2z3").touch()
    (temporary / "fiber-es-noise-other.f32").touch()
    noise.NoiseTable("test", seed=3, length=10).remove()
    assert [path.name for path in temporary.iterdir()] == ["fiber-es-noise-other.f32"]
