"""examples/10-impala"""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import numpy as np
import pytest

from examples.run_example import BACKENDS, EXAMPLES, run

SMALL = ("--updates", 200, "--actors", 3)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_return_rises(backend: str, tmp_path: Path) -> None:
    picture = tmp_path / "impala.png"
    done = run("10-impala/impala.py", *SMALL, "--out", picture, backend=backend)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert not done.stderr
    returns = re.findall(r"^update \d+: .* mean return ([\d.]+),", done.stdout, re.M)
    assert float(returns[-1]) > float(returns[0])


def test_v_trace_on_policy_is_the_discounted_sum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Targets of the actor's own policy are the returns that follow, up to the last value."""
    monkeypatch.syspath_prepend(str(EXAMPLES / "10-impala"))
    network = importlib.import_module("vtrace")
    rewards, over = np.array([[1.0], [2.0], [4.0]]), np.array([[False], [True], [False]])
    values = np.array([[5.0], [6.0], [7.0], [8.0]])
    targets, advantages = network.v_trace(values, np.ones((3, 1)), rewards, over)
    after = 4 + network.DISCOUNT * 8
    expected = [1 + network.DISCOUNT * 2, 2, after, 8]
    np.testing.assert_allclose(targets[:, 0], expected)
    np.testing.assert_allclose(advantages[:, 0], np.subtract(expected[:3], [5, 6, 7]))
