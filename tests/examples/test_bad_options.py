"""Examples 08 to 10 refuse options that do not fit, with one line."""

from __future__ import annotations

import pytest

from examples.run_example import run


@pytest.mark.parametrize(
    ("script", "arguments", "named"),
    [
        ("08-poet/train_poet.py", ("--pairs", 0), "--iterations and --pairs must be at least 1"),
        ("08-poet/train_poet.py", ("--seed", -1), "--seed at least 0"),
        ("08-poet/train_poet.py", ("--out", "nowhere/a.png"), "there is no folder nowhere"),
        ("09-go-explore/go_explore.py", ("--episodes", 0), "--episodes must be at least 1"),
        ("09-go-explore/go_explore.py", ("--out", "nowhere/a.png"), "there is no folder nowhere"),
        ("10-impala/impala.py", ("--out", "a.xyz"), "the name must end in .png, .pdf or .svg"),
        ("10-impala/impala.py", ("--env", "nowhere:A-v0"), "--env nowhere:A-v0: "),
        ("10-impala/impala.py", ("--actors", 0), "--actors and --updates must be at least 1"),
        ("10-impala/impala.py", ("--env", "Chess-v9"), "--env Chess-v9: "),
        (
            "10-impala/impala.py",
            ("--env", "Pendulum-v1"),
            "--env Pendulum-v1: observations must be",
        ),
        (
            "10-impala/impala.py",
            ("--env", "Blackjack-v1"),
            "--env Blackjack-v1: observations must be",
        ),
    ],
)
def test_a_bad_option_is_one_line(script: str, arguments: tuple[object, ...], named: str) -> None:
    error = run(script, *arguments, status=2).stderr
    assert named in error
    assert "Traceback" not in error
