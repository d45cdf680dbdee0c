"""examples/04-vector, small: fewer steps."""

from __future__ import annotations

from pathlib import Path

import pytest

from examples.run_example import run

SCRIPT = "04-vector/train_ppo.py"
SMALL = ("--envs", 8, "--steps", 4096, "--seed", 1)


def train(backend: str, workers: int, picture: Path) -> list[str]:
    """The lines with returns; it also draws the picture."""
    done = run(SCRIPT, *SMALL, "--workers", workers, "--out", picture, backend=backend)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert not done.stderr
    return [line for line in done.stdout.splitlines() if " episodes " in line]


def test_the_return_rises_on_each_vector_environment(tmp_path: Path) -> None:
    lines = train("local", 2, tmp_path / "curve.png")
    returns = [float(line.split()[-1]) for line in lines]
    assert returns[-1] > 1.5 * returns[0]
    assert train("loopback", 3, tmp_path / "curve.png") == lines


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (("--env", "Chess-v9"), "--env Chess-v9: Environment `Chess` doesn't exist"),
        (("--env", "Pendulum-v1"), "--env Pendulum-v1: its actions are Box"),
        (("--env", "FrozenLake-v1"), "its observations are Discrete(16)"),
        (("--envs", 0), "must be at least 1"),
        (("--seed", -1), "must not be negative"),
        (("--out", "nowhere/curve.png"), "there is no folder nowhere"),
    ],
)
def test_bad_options(option: tuple[object, ...], message: str) -> None:
    assert message in run(SCRIPT, *option, status=2).stderr
