"""The paper's experiments: a tiny run of each, with few contenders."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from patience import PATIENCE

ROOT = Path(__file__).resolve().parents[2]
NEEDS = {
    "overhead": (),
    "evolution": ("Box2D",),
    "breakout": ("ale_py", "stable_baselines3"),
}
PARTS = {
    "overhead": ["overhead"],
    "evolution": ["evolution", "walker"],
    "breakout": ["breakout"],
}
CONTENDERS = {
    "overhead": {"fiber", "multiprocessing"},
    "evolution": {"fiber", "fiber-hosts", "multiprocessing"},
    "breakout": {"fiber", "fiber-adopted", "stable-baselines3"},
}


@pytest.fixture
def scratch() -> Iterator[Path]:
    # Near the root: multiprocessing's managers have sockets in it, whose paths are bounded.
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


@pytest.mark.parametrize("part", list(NEEDS))
@pytest.mark.timeout(5 * PATIENCE)  # ten seconds of work on a quiet machine
def test_a_tiny_run(part: str, tmp_path: Path, scratch: Path) -> None:
    for module in NEEDS[part]:
        # Not imported: stable-baselines3 would import torch, which a contender replaces.
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"{module} is not installed")
    arguments = ["--only", *PARTS[part], "--contenders", ",".join(CONTENDERS[part]), "--quick"]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.paper", *arguments, "--output", str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "TMPDIR": str(scratch)},
        capture_output=True,
        text=True,
        timeout=4 * PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    assert "left a process behind" not in done.stderr
    assert not list(scratch.iterdir())
    run = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))[part]
    assert {name for case in run["values"].values() for name in case} == CONTENDERS[part]
    assert (tmp_path / f"{part}.png").stat().st_size > 10_000
    assert "| " in (tmp_path / "tables.md").read_text(encoding="utf-8")
    if part == "evolution":
        assert (tmp_path / "walker.png").stat().st_size > 10_000


def test_a_recording_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("Box2D")
    pytest.importorskip("ale_py")
    monkeypatch.syspath_prepend(str(ROOT))
    recording = importlib.import_module("benchmarks.paper.recording")
    record = importlib.import_module("benchmarks.paper.record")
    arguments = ["--episodes", "2", "--steps", "20", "--output", str(tmp_path)]
    assert record.main(arguments) == 0
    walker = recording.read(recording.WALKER, tmp_path)
    assert len(walker.steps) == len(walker.seconds) == 2
    assert len(recording.read(recording.BREAKOUT, tmp_path).seconds) == 20
