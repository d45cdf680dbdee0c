"""Agents of one shape: which children they get, and which children are refused."""

from __future__ import annotations

import signal
from typing import Any

import pytest

from fiber._agent.interface import Cause, ChildSpec, ExitReport
from fiber._backends.agent_set import AgentSet
from fiber._backends.remote import RemoteAgent, RemoteChild
from fiber._engine.placement import Placement
from fiber.errors import FiberError
from memory_link import SimulatedLoop

ERROR = FiberError("no agent will come")


class Nothing:
    """Hub, output and link that these tests do not look at."""

    def __getattr__(self, name: str) -> Any:
        return lambda *args, **kwargs: self


class Owner:
    """Observer of one child."""

    def __init__(self) -> None:
        self.report: ExitReport | None = None

    def exited(self, report: ExitReport) -> None:
        self.report = report


class Site:
    """A set of agents with two places each."""

    def __init__(self) -> None:
        nothing: Any = Nothing()
        self.loop = SimulatedLoop()
        self.placement: Placement[RemoteAgent, RemoteChild] = Placement(2, spread=False)
        self.agents = AgentSet(self.loop, nothing, nothing, self.placement)

    def join(self, name: str) -> RemoteAgent:
        link: Any = Nothing()
        return self.agents.join(name, link)

    def child(self) -> tuple[RemoteChild, Owner]:
        """Return a child that is not started yet, and its owner."""
        owner: Any = Owner()
        spec = ChildSpec(
            name="child", method="fork", preparation=b"", payload=b"", fds=(), tasks=False
        )
        return self.agents.child(spec, owner), owner

    def start(self) -> tuple[RemoteChild, Owner]:
        child, owner = self.child()
        child.start()
        return child, owner


@pytest.fixture
def site() -> Site:
    return Site()


def test_children_that_wait_are_refused_when_the_last_agent_goes_for_good(
    site: Site,
) -> None:
    agent = site.join("a")
    running = [site.start(), site.start()]
    site.agents.fail(ERROR)
    child, owner = site.start()  # there may be room for it yet
    assert child.waiting
    agent.lose("its pod is gone")
    assert owner.report is not None
    assert owner.report.cause == Cause.NO_HOST
    assert child.start_error is ERROR
    assert [owner.report and owner.report.cause for _, owner in running] == [Cause.AGENT_LOST] * 2


def test_a_new_child_fails_if_no_agent_is_left(site: Site) -> None:
    site.placement.remove(site.join("a"))
    site.agents.fail(ERROR)
    child, _ = site.start()
    assert child.start_error is ERROR


def test_an_agent_whose_pod_ends_gets_no_child_when_it_reconnects(site: Site) -> None:
    agent = site.join("a")
    site.agents.withhold(agent, True, "ending")
    agent.on_suspect()
    agent.on_trusted()
    child, _ = site.start()
    assert child.waiting
    site.agents.withhold(agent, False, "ending")
    assert child.host == "a"


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGKILL, signal.SIGTERM])
def test_a_signal_that_ends_a_process_ends_one_that_waits_for_an_agent(
    site: Site, signum: signal.Signals
) -> None:
    child, owner = site.start()
    child.signal(signum)
    site.loop.run_for(0.0)
    assert owner.report is not None
    assert owner.report.exitcode == -signum
    assert f"killed by {signum.name} before it had a host" in owner.report.reason
    assert not site.placement.waiting


def test_other_agents_get_waiting_and_later_children(site: Site) -> None:
    other = Site()
    agent = site.join("a")
    (first, _), (_, owner) = site.start(), site.start()
    waits, late = site.start()[0], site.child()[0]
    site.agents.hand_over(lambda: other.agents)
    assert list(other.placement.waiting) == [waits]
    late.start()
    other.join("b")
    assert (waits.host, late.host, first.host) == ("b", "b", "a")
    assert not site.placement.waiting
    agent.lose("its pod is gone")  # with those that ran on it
    assert owner.report is not None
    assert owner.report.cause == Cause.AGENT_LOST


def test_a_child_that_was_handed_over_is_taken_back_from_its_new_place(site: Site) -> None:
    other = Site()
    child, owner = site.start()
    site.agents.hand_over(lambda: other.agents)
    child.signal(signal.SIGTERM)
    site.loop.run_for(0.0)
    assert owner.report is not None
    assert not other.placement.waiting
