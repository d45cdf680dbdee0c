"""The main function of an agent's process: the parts that need no process."""

from __future__ import annotations

import pytest

from fiber._agent import main
from fiber._agent.main import Main


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return a list whose last value is the time."""
    times = [100.0]
    monkeypatch.setattr(main.time, "monotonic", lambda: times[-1])
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
