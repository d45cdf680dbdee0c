"""Commands that the end-to-end tests type."""

from __future__ import annotations

import signal

import pytest

from e2e.person import Command


def test_a_command_of_a_failed_test_is_killed_and_not_waited_for() -> None:
    with (
        pytest.raises(ValueError, match="the error of the test"),
        Command(["sleep", "300.0625"]) as command,
    ):
        raise ValueError("the error of the test")
    assert command.returncode == -signal.SIGKILL
