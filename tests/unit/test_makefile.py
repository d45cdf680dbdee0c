"""The Makefile runs parts of the tests side by side."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from patience import PATIENCE

ROOT = Path(__file__).resolve().parents[2]

SHOWS_SIGINT = (
    f"{sys.executable} -c 'import signal; print(signal.getsignal(signal.SIGINT).__name__)'"
)


@pytest.fixture
def fifo(tmp_path: Path) -> Path:
    os.mkfifo(tmp_path / "fifo")
    return tmp_path / "fifo"


def side_by_side(folder: Path, conformance: str, on_cluster: str) -> subprocess.Popen[str]:
    """Start the target with other recipes for its two parts."""
    (folder / "Makefile").write_text(
        f"include {ROOT}/Makefile\n"
        f"test-conformance:\n\t@{conformance}\ntest-on-cluster:\n\t@{on_cluster}\n"
        "test-programs:\n\t@echo plays\n"
    )
    return subprocess.Popen(
        ["make", "test-side-by-side"],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        process_group=0,
    )


@pytest.mark.parametrize(
    ("conformance", "on_cluster", "failed"),
    [
        ("true", "true", ""),
        ("false", "true", " test-conformance"),
        ("true", "false", " test-on-cluster"),
        ("false", "false", " test-on-cluster test-conformance"),
    ],
)
def test_each_part_that_fails_is_named(
    tmp_path: Path, conformance: str, on_cluster: str, failed: str
) -> None:
    parts = (f"echo conforms; {conformance}", f"echo serves; {on_cluster}")
    with side_by_side(tmp_path, *parts) as make:
        output, errors = make.communicate(timeout=PATIENCE)
    assert (make.returncode != 0) == bool(failed)
    lines = [line for line in output.splitlines() if line in ("conforms", "plays", "serves")]
    assert lines == ["serves", "conforms", "plays"]
    assert (f"test-side-by-side: failed:{failed}\n" in errors) == bool(failed)


def test_the_part_in_the_background_gets_an_interrupt(tmp_path: Path) -> None:
    with side_by_side(tmp_path, SHOWS_SIGINT, "true") as make:
        output, _ = make.communicate(timeout=PATIENCE)
    assert "default_int_handler" in output


def test_an_interrupt_ends_both(tmp_path: Path, fifo: Path) -> None:
    # Each part keeps the pipe open while it runs.
    waits = f"exec >{fifo}; echo runs; exec sleep 600"
    with side_by_side(tmp_path, waits, waits) as make:
        with fifo.open() as pipe:
            started = [pipe.readline(), pipe.readline()]
            os.killpg(make.pid, signal.SIGINT)  # as a terminal does
            assert pipe.read() == ""
        make.communicate(timeout=PATIENCE)
    assert started == ["runs\n", "runs\n"]
    assert make.returncode != 0
