"""The benchmarks' command: one tiny run of everything, against multiprocessing alone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from patience import PATIENCE

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks import contenders, processes, report  # noqa: E402
from benchmarks.suite import MEASURES  # noqa: E402


@pytest.fixture
def scratch() -> Iterator[Path]:
    # Near the root: multiprocessing's managers have sockets in it, whose paths are bounded.
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def command(output: Path, scratch: Path, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [
            sys.executable,
            str(ROOT / "benchmarks" / "run.py"),
            *arguments,
            "--output",
            str(output),
        ],
        env={**os.environ, "TMPDIR": str(scratch)},
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.timeout(5 * PATIENCE)  # half a minute of work on a quiet machine
def test_a_tiny_run_of_everything(tmp_path: Path, scratch: Path) -> None:
    only = ["--contenders", "multiprocessing", "--size", "0.002", "--rounds", "1"]
    with command(tmp_path, scratch, *only) as process:
        _, said = process.communicate(timeout=4 * PATIENCE)
    assert process.returncode == 0, said
    assert "failed" not in said
    assert "left a process behind" not in said
    assert not list(scratch.iterdir())
    runs = report.load(tmp_path)
    assert set(runs) == set(MEASURES)
    offers = contenders.BY_NAME["multiprocessing"].offers
    for name, measure in MEASURES.items():
        cases = {
            case.name
            for case in measure.cases(0.002)
            if case.needs in offers and "multiprocessing" not in case.not_run
        }
        assert set(runs[name].values) == cases
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
        page = (tmp_path / f"{name}.md").read_text(encoding="utf-8")
        assert bool(cases) == ("multiprocessing, fork" in page)


def test_an_interrupt_leaves_no_processes_or_files(tmp_path: Path, scratch: Path) -> None:
    only = ["--contenders", "multiprocessing", "--measure", "overhead"]
    with command(tmp_path, scratch, *only) as process:
        assert process.stderr is not None
        process.stderr.readline()
        below = processes.descendants(process.pid)
        process.send_signal(signal.SIGINT)
        said = process.stderr.read()
        assert process.wait(PATIENCE) == 130
    assert len(below) == 6
    assert "no page is written" in said
    assert not any(os.path.exists(f"/proc/{pid}") for pid in below)
    assert not list(tmp_path.iterdir())
    assert not list(scratch.iterdir())


def test_the_way_of_a_large_blob_is_measured() -> None:
    few = ["--agents", "6", "--size", "1100000", "--simulated", "50"]
    measure = [sys.executable, "-m", "benchmarks.fanout", *few]
    done = subprocess.run(measure, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
    assert "real links, 6 agents" in done.stdout, done.stderr
    assert "most copies of the master: 4.0" in done.stdout


def test_the_memory_of_a_relay_is_measured() -> None:
    measure = [sys.executable, "-m", "benchmarks.relay_memory", "--agents", "3"]
    done = subprocess.run(measure, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
    assert "3 agents" in done.stdout, done.stderr
    assert "relay: " in done.stdout
