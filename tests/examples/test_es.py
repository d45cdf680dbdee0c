"""examples/02-es, small: fewer generations, and a task with shorter episodes."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
from pathlib import Path

import pytest

from examples.run_example import command, environment, run
from patience import PATIENCE

SCRIPT = "02-es/main.py"
SMALL = ("--env", "CartPole-v1", "--generations", 6, "--population", 16, "--seed", 1)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return the output of a single worker."""
    return train("local", 1, tmp_path_factory.mktemp("alone") / "curve.png")


def train(backend: str, workers: int, picture: Path) -> list[str]:
    """The lines with returns that a small run prints; it also draws the picture."""
    done = run(SCRIPT, *SMALL, "--workers", workers, "--out", picture, backend=backend)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert not done.stderr
    pattern = r"generation|  random|  trained"
    return [line for line in done.stdout.splitlines() if re.match(pattern, line)]


def test_the_return_rises(alone: list[str]) -> None:
    random, trained = (float(line.split()[1]) for line in alone[-2:])
    assert trained > 3 * random


@pytest.mark.parametrize(("backend", "workers"), [("local", 3), ("loopback", 4)])
def test_the_result_does_not_depend_on_the_workers(
    alone: list[str], backend: str, workers: int, tmp_path: Path
) -> None:
    assert train(backend, workers, tmp_path / "curve.png") == alone


def test_ctrl_c_ends_the_training_and_draws_the_curve(tmp_path: Path) -> None:
    """Ctrl-C ends the training, not the program: the curve so far is drawn."""
    picture = tmp_path / "curve.png"
    arguments = ("--env", "CartPole-v1", "--generations", 10_000, "--out", picture)
    with subprocess.Popen(
        command(SCRIPT, *arguments),
        env=environment("local") | {"TMPDIR": str(tmp_path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout
        for line in process.stdout:
            if line.startswith("generation"):
                break
        os.killpg(process.pid, signal.SIGINT)  # to all of them, as a terminal does
        output, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 128 + signal.SIGINT
    assert "interrupted after" in output
    assert not errors
    # Workers that are killed may leave the file by which `tempfile` tries whether it can write.
    assert [*tmp_path.glob("fiber*"), *tmp_path.glob("*.png")] == [picture]


def test_bar_on_a_terminal(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    try:
        with subprocess.Popen(
            command(SCRIPT, *SMALL, "--out", tmp_path / "curve.png"),
            env=environment("local"),
            stdout=theirs,
        ) as process:
            os.close(theirs)
            shown = read_all(ours)
    finally:
        os.close(ours)
    assert process.returncode == 0
    assert re.search(r"━+·* +\d+%  [\d,]+ of 192 episodes, \d+ s left", shown)
    assert "\r\x1b[Kgeneration   6 " in shown


def read_all(terminal: int) -> str:
    """Return the output of a program to its terminal until it ends."""
    parts: list[bytes] = []
    while True:
        try:
            part = os.read(terminal, 4096)
        except OSError:  # how Linux spells end of file here
            return b"".join(parts).decode()
        parts.append(part)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--population", 7), "--population must be even"),
        (("--workers", 0), "--workers and --generations must be at least 1"),
        (("--env", "Chess-v9"), "--env Chess-v9: Environment `Chess` doesn't exist"),
        (("--env", "Blackjack-v1"), "needs flat vectors"),
        (("--out", "nowhere/curve.png"), "there is no folder nowhere"),
    ],
)
def test_bad_argument(arguments: tuple[object, ...], named: str) -> None:
    assert named in run(SCRIPT, *arguments, status=2).stderr
