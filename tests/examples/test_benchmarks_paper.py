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


def test_the_picture_of_populations_has_a_panel_for_each_run(tmp_path: Path) -> None:
    # In a separate process, because matplotlib never closes the fonts that it opens.
    statement = (
        "import dataclasses, pathlib, sys\n"
        "from benchmarks.paper import page, populations_picture\n"
        "from benchmarks.paper import populations_results as results\n"
        "found, folder = results.load(page.FOLDER), pathlib.Path(sys.argv[1])\n"
        "for names in (list(found.traces), ['poet']):\n"
        "    traces = {name: found.traces[name] for name in names}\n"
        "    populations_picture.draw(dataclasses.replace(found, traces=traces), folder)\n"
        "    print((folder / results.PICTURE).stat().st_size)\n"
    )
    command = [sys.executable, "-c", statement, str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    both, one = map(int, done.stdout.split())
    assert both > one > 10_000


@pytest.mark.parametrize("allocation", ["dynamic", "static"])
def test_a_program_plays_its_plan_and_tells_the_open_tasks(allocation: str) -> None:
    phases = [
        {"gpu": False, "peak": 2, "waves": [[0.0], [0.01, 0.0]]},
        {"gpu": True, "peak": 1, "waves": [[0.0]]},
    ]
    request = json.dumps({"allocation": allocation, "idle": 4.0, "phases": phases})
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / "paper" / "populations_program.py")],
        input=request,
        env={**os.environ, "FIBER_BACKEND": "local"},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    events = [json.loads(line) for line in done.stdout.splitlines()]
    times = [at for _, at, _ in events]
    assert times == sorted(times)
    told = [(name, number) for name, _, number in events]
    opened = [number for name, number in told if name == "open"]
    assert (told[0], told[-1]) == (("begin", 0), ("end", 0))
    assert opened == [1, 0, 2, 1, 0, 1, 0]
