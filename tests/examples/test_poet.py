"""examples/08-poet"""

from __future__ import annotations

import re
from pathlib import Path

from examples.run_example import BACKENDS, run

SMALL = ("--iterations", 12, "--pairs", 3)


def test_the_population_grows_and_is_the_same_on_each_backend(tmp_path: Path) -> None:
    picture = tmp_path / "poet.png"
    outputs = []
    for backend in BACKENDS:
        done = run("08-poet/train_poet.py", *SMALL, "--out", picture, backend=backend)
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert not done.stderr
        outputs.append(done.stdout)
    here, there = outputs
    assert here == there
    sizes = [int(size) for size in re.findall(r"^iteration \d+: (\d) pairs", here, re.M)]
    assert sizes[0] == 1
    assert sizes[-1] == 3
