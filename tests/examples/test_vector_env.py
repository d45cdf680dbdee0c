"""examples/03-vector-env"""

from __future__ import annotations

import re

import pytest

from examples.run_example import BACKENDS, run

SMALL = ("--envs", 3, "--steps", 40, "--ms", 0.2)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_adopted_environments_give_the_same_observations(backend: str) -> None:
    done = run("03-vector-env/adopted.py", *SMALL, backend=backend)
    assert done.stdout.endswith("observations: the same\n")
    rates = re.findall(r"^ *(?:what it takes|0\.2 ms) +([\d,]+) +([\d,]+) ", done.stdout, re.M)
    assert len(rates) == 2
    assert not done.stderr


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_piped_environments_print_rate_and_returns(backend: str) -> None:
    done = run("03-vector-env/piped.py", *SMALL, backend=backend)
    assert re.search(r"^3 x CartPole-v1: [\d,]+ environment steps a second$", done.stdout, re.M)
    ended, mean = re.findall(r"^(\d+) episodes ended, mean return ([\d.]+)$", done.stdout, re.M)[0]
    assert int(ended) >= 3
    assert 5 < float(mean) < 50
    assert not done.stderr


@pytest.mark.parametrize("script", ["adopted.py", "piped.py"])
def test_bad_argument(script: str) -> None:
    done = run(f"03-vector-env/{script}", "--env", "Chess-v9", status=2)
    assert "--env Chess-v9: Environment `Chess` doesn't exist" in done.stderr
