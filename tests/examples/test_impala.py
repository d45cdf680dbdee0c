"""examples/10-impala"""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from examples.run_example import BACKENDS, EXAMPLES, run

SMALL = ("--updates", 20, "--actors", 3)


@pytest.mark.parametrize("backend", BACKENDS)
def test_actors_feed_the_learner(backend: str, tmp_path: Path) -> None:
    picture = tmp_path / "impala.png"
    done = run("10-impala/impala.py", *SMALL, "--out", picture, backend=backend)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert not done.stderr
    assert len(re.findall(r"^update \d+: .* mean return [\d.]+,", done.stdout, re.M)) == 10


def test_a_run_without_an_episode_says_so() -> None:
    done = run("10-impala/impala.py", "--env", "Acrobot-v1", "--updates", 1, status=1)
    assert "Take more --updates" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.fixture
def vtrace(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(EXAMPLES / "10-impala"))
    return importlib.import_module("vtrace")


def test_a_rewarded_action_becomes_likely(vtrace: Any) -> None:
    learner = vtrace.Learner(vtrace.new_weights(1, 2, seed=0))
    seen, actions = np.zeros((5, 1)), np.array([0, 1, 0, 1])
    unroll = vtrace.Unroll(
        0, 0, [], seen, actions, np.full(4, 0.5), 1.0 - actions, np.ones(4, bool)
    )
    for _ in range(100):
        learner.learn([unroll])
    assert vtrace.forward(learner.weights, seen[0])[1][0] > 0.9


def test_v_trace_on_policy_is_the_discounted_sum(vtrace: Any) -> None:
    """Targets of the actor's own policy are the returns that follow, up to the last value."""
    rewards, over = np.array([[1.0], [2.0], [4.0]]), np.array([[False], [True], [False]])
    values = np.array([[5.0], [6.0], [7.0], [8.0]])
    targets, advantages = vtrace.v_trace(values, np.ones((3, 1)), rewards, over)
    after = 4 + vtrace.DISCOUNT * 8
    expected = [1 + vtrace.DISCOUNT * 2, 2, after, 8]
    np.testing.assert_allclose(targets[:, 0], expected)
    np.testing.assert_allclose(advantages[:, 0], np.subtract(expected[:3], [5, 6, 7]))
