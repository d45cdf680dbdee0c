"""Gymnasium's own AsyncVectorEnv, adopted."""

from __future__ import annotations

from pathlib import Path

import pytest

from examples.run_example import BACKENDS, run

PROGRAM = Path(__file__).with_name("gymnasium_spaces.py")


@pytest.mark.parametrize("backend", BACKENDS)
def test_observations_are_the_same_with_and_without_shared_memory(backend: str) -> None:
    done = run(str(PROGRAM), backend=backend)
    assert done.stdout == "shared_memory=True: the same\nshared_memory=False: the same\n"
    assert not done.stderr
