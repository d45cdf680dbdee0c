"""Run programs of other projects: with Fiber they print the same as with multiprocessing."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import pytest

from examples.run_example import BACKENDS, run

PROGRAMS = Path(__file__).parent / "programs"
STAND_INS = Path(__file__).parents[1] / "stand_ins"
"""Folder of torch's stand-in, for where torch is not installed."""


def printed(program: str, module: str, backend: str = "local") -> str:
    done = run(str(PROGRAMS / program), module, backend=backend)
    assert not done.stderr
    return done.stdout


@pytest.mark.parametrize("program", ["poet.py", "subproc_vec_env.py", "stable_baselines3_envs.py"])
def test_programs_print_the_same_as_with_multiprocessing(
    program: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if program.startswith("stable") and importlib.util.find_spec("stable_baselines3") is None:
        pytest.skip("make installs stable-baselines3")
    if importlib.util.find_spec("torch") is None:
        path = os.environ.get("PYTHONPATH")
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (path, str(STAND_INS)))))
    expected = printed(program, "multiprocessing")
    assert len(expected.splitlines()) >= 3
    for backend in BACKENDS:
        assert printed(program, "fiber", backend) == expected


@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="torch is not installed")
def test_stable_baselines3_learns_the_same() -> None:
    expected = printed("stable_baselines3_ppo.py", "multiprocessing")
    assert len(expected.splitlines()) >= 3
    for backend in BACKENDS:
        assert printed("stable_baselines3_ppo.py", "fiber", backend) == expected
