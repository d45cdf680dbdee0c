"""The main function of an agent's process: the parts that need no process."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from fiber._agent.main import Main


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return a list whose last value is the time."""
    times = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: times[-1])
    return times


@pytest.fixture
def agent(now: list[float]) -> Main:
    agent = Main.__new__(Main)
    agent._terminating, agent._drained_at = False, None
    agent._grace, agent._cleaning_up = 30.0, 5.0
    return agent


def test_a_link_may_send_results_for_as_long_as_the_grace_lasts(
    agent: Main, now: list[float]
) -> None:
    agent._terminating, agent._drained_at = True, 100.0
    now.append(102.0)
    assert agent._linger() == 28.0


def test_the_time_to_clean_up_remains_at_the_end_of_the_grace(
    agent: Main, now: list[float]
) -> None:
    agent._terminating, agent._drained_at = True, 100.0
    now.append(129.0)
    assert agent._linger() == 5.0


def test_an_agent_that_is_not_drained_ends_soon(agent: Main) -> None:
    assert agent._linger() == 1.0


@pytest.mark.parametrize("planted", ["pipe", "link"])
def test_a_pipe_or_link_in_place_of_the_ready_file_does_not_block_the_agent(
    agent: Main, tmp_path: Path, planted: str, capfd: pytest.CaptureFixture[str]
) -> None:
    mark = tmp_path / "linked"
    if planted == "pipe":
        os.mkfifo(mark)
    else:
        mark.symlink_to(tmp_path / "elsewhere")
    agent._linked, agent._name = str(mark), "es-1"
    agent._tell_of_link()
    assert "its pod does not get Ready" in capfd.readouterr().err
    assert not (tmp_path / "elsewhere").exists()


def test_the_mark_is_there_once_the_agent_is_linked(agent: Main, tmp_path: Path) -> None:
    agent._linked = str(tmp_path / "linked")
    agent._tell_of_link()
    agent._tell_of_link()
    assert (tmp_path / "linked").exists()
