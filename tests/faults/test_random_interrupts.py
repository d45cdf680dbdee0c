"""Signals and garbage collections at random points of all kinds of calls lose and leak no object.

``RANDOM_INTERRUPTS_SEED`` repeats a run, as far as threads can be repeated;
``RANDOM_INTERRUPTS_SECONDS`` is how long each takes.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable

import pytest

from faults.program import LOOPBACK, Program
from faults.random_calls import MODES
from patience import PATIENCE

SECONDS = float(os.environ.get("RANDOM_INTERRUPTS_SECONDS", "8"))
SEED = os.environ.get("RANDOM_INTERRUPTS_SEED")

SCRIPT = """
    from faults.random_calls import main
    if __name__ == "__main__":
        main()
"""


@pytest.mark.timeout(SECONDS + 8 * PATIENCE)
@pytest.mark.parametrize(
    ("mode", "backend"), [*((mode, "local") for mode in MODES), ("all", "loopback")]
)
def test_calls_survive_random_interrupts(
    launch: Callable[..., Program], mode: str, backend: str
) -> None:
    seed = SEED or str(random.randrange(10**6))
    again = f"RANDOM_INTERRUPTS_SEED={seed} RANDOM_INTERRUPTS_SECONDS={SECONDS:g}"
    print(f"to repeat it: {again}")
    env = LOOPBACK if backend == "loopback" else {}
    program = launch(SCRIPT, mode, seed, str(SECONDS), env=env)
    said = program.rest(SECONDS + 6 * PATIENCE)
    assert program.wait() == 0, f"{again}\n{said}{program.stderr}"
    assert program.left() == []
    assert " calls, " in said
