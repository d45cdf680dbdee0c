"""examples/09-go-explore"""

from __future__ import annotations

import re
from pathlib import Path

from examples.run_example import BACKENDS, run

SMALL = ("--policies", 2, "--episodes", 3000)


def test_both_phases_succeed_and_are_the_same_on_each_backend(tmp_path: Path) -> None:
    picture, outputs = tmp_path / "picture.png", []
    for backend in BACKENDS:
        done = run("09-go-explore/go_explore.py", *SMALL, "--out", picture, backend=backend)
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert not done.stderr
        outputs.append(done.stdout)
    here, there = outputs
    assert here == there
    (successes,) = re.findall(r"^with sticky moves, (\d+)% of 200 episodes succeed: ", here, re.M)
    assert int(successes) > 20


def test_no_treasure() -> None:
    done = run("09-go-explore/go_explore.py", "--rounds", 1, status=1)
    assert "The treasure was not found" in done.stderr
