"""examples/07-ring"""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

from examples.run_example import BACKENDS, run

SMALL = ("--samples", 3000, "--steps", 4)


def last_error(text: str) -> float:
    (found,) = re.findall(r"after 4 steps: ([\d.]+)$", text, re.M)
    return float(found)


@pytest.mark.parametrize("backend", BACKENDS)
def test_members_sum_up_their_gradients(backend: str, tmp_path: Path) -> None:
    picture = tmp_path / "ring.png"
    done = run(
        "07-ring/regression.py", *SMALL, "--members", 3, "--picture", picture, backend=backend
    )
    assert "3 members went the same way" in done.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert not done.stderr
    alone = run("07-ring/regression.py", *SMALL, "--members", 1)
    assert last_error(done.stdout) == pytest.approx(last_error(alone.stdout), rel=1e-3)


@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="torch is not installed")
def test_gloo_computes_the_sum() -> None:
    done = run("07-ring/regression.py", *SMALL, "--members", 2, "--gloo")
    ours = run("07-ring/regression.py", *SMALL, "--members", 2)
    assert last_error(done.stdout) == pytest.approx(last_error(ours.stdout), rel=1e-3)


@pytest.mark.skipif(importlib.util.find_spec("torch") is not None, reason="torch is installed")
def test_gloo_without_torch() -> None:
    done = run("07-ring/regression.py", "--gloo", status=2)
    assert "--gloo needs torch: pip install torch" in done.stderr


def test_bad_argument() -> None:
    done = run("07-ring/regression.py", "--members", 0, status=2)
    assert "argument --members: 0 is less than 1" in done.stderr
