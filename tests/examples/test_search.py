"""examples/05-search"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from examples.run_example import BACKENDS, run

SMALL = ("--workers", 2, "--samples", 200, "--points", 2, "--trials", 4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_example_prints_both_searches_and_draws_a_picture(backend: str, tmp_path: Path) -> None:
    picture = tmp_path / "search.png"
    done = run("05-search/search.py", *SMALL, "--picture", picture, backend=backend)
    found = re.findall(r"^(grid of 2 x 2|study of 4 trials): ([\d.]+)% with C=", done.stdout, re.M)
    assert [what for what, _ in found] == ["grid of 2 x 2", "study of 4 trials"]
    assert float(found[0][1]) > 90
    assert 10 <= float(found[1][1]) <= 100
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert not done.stderr


def test_bad_argument() -> None:
    done = run("05-search/search.py", "--trials", 0, status=2)
    assert "argument --trials: 0 is less than 1" in done.stderr
