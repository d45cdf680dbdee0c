"""Running pods that send no agent: what is concluded, and when those that wait are told."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from fiber._agent.interface import ChildSpec, ExitReport
from fiber._backends.agent_set import AgentSet
from fiber._backends.kubernetes.problems import AgentRoute, PoolName
from fiber._backends.kubernetes.waiting import (
    DOUBTED_AFTER,
    GIVEN_UP_AFTER,
    Reachability,
    ReachabilityProbe,
    WaitingChildren,
)
from fiber._engine.placement import Placement
from memory_link import SimulatedLoop

ERROR_AT = DOUBTED_AFTER + GIVEN_UP_AFTER


class TestReachability:
    def test_doubts_and_gives_up_by_the_time_since_the_first_running_pod(self) -> None:
        found = ReachabilityProbe()
        assert found.judge(1, 100.0) is Reachability.OPEN
        assert found.due == 100.0 + DOUBTED_AFTER
        assert found.judge(1, found.due) is Reachability.DOUBTFUL
        assert found.due == 100.0 + ERROR_AT
        assert found.judge(1, found.due) is Reachability.UNREACHABLE

    def test_gives_the_newest_pod_time_to_dial(self) -> None:
        """Pods begin to run one by one while an image is pulled."""
        found = ReachabilityProbe()
        found.judge(1, 0.0)
        found.judge(1, DOUBTED_AFTER)
        assert found.judge(2, ERROR_AT - 1.0) is Reachability.DOUBTFUL
        assert found.due == ERROR_AT - 1.0 + DOUBTED_AFTER
        assert found.judge(2, found.due) is Reachability.UNREACHABLE

    def test_a_dialled_agent_removes_the_doubt(self) -> None:
        found = ReachabilityProbe()
        found.judge(1, 0.0)
        found.prove()
        assert found.judge(4, 1000.0) is Reachability.OPEN

    def test_begins_anew_when_no_pod_ran_for_a_while(self) -> None:
        found = ReachabilityProbe()
        found.judge(2, 0.0)
        assert found.judge(0, 5.0) is Reachability.OPEN
        assert found.judge(1, 6.0) is Reachability.OPEN
        assert found.due == 6.0 + DOUBTED_AFTER

    def test_begins_anew_when_the_program_was_stopped(self) -> None:
        """Agents wait in its backlog, and a timer may come first."""
        found = ReachabilityProbe()
        found.judge(2, 0.0)
        assert found.judge(2, 1000.0) is Reachability.OPEN
        assert found.due == 1000.0 + DOUBTED_AFTER


class Site:
    """Children that wait for the pods of one pool."""

    def __init__(self, *, displaced: str = "") -> None:
        self.loop = SimulatedLoop()
        self.lines: list[str] = []
        self.report: ExitReport | None = None
        output: Any = SimpleNamespace(
            write=lambda who, text: self.lines.append(text), show=lambda line: None
        )
        hub: Any = None
        api: Any = SimpleNamespace(server="kube", trouble=None)
        placement: Placement[Any, Any] = Placement(1, spread=False)
        self.agents = AgentSet(self.loop, hub, output, placement)
        self.waiting = WaitingChildren(self.agents, output, api, 600.0, on_begin=lambda: None)
        self.waiting.on_named(PoolName("es-1", "lab"))
        self.waiting.on_attached(AgentRoute("10.0.0.7:41337", displaced))

    def start(self) -> Any:
        """Have one more child wait."""
        spec = ChildSpec("child", "fork", b"", b"", (), tasks=True)
        observer: Any = SimpleNamespace(exited=lambda report: setattr(self, "report", report))
        child = self.agents.child(spec, observer)
        child.start()
        self.waiting.look(10)
        return child

    def pods_run(self, number: int) -> None:
        """Have so many pods of four run; none is ready, since no agent is linked."""
        counts = {"desiredReplicas": 4, "replicas": 4, "pendingReplicas": 4 - number}
        status = {"observedGeneration": 1, **counts}
        self.waiting.on_status(status)

    @property
    def told(self) -> list[str]:
        """Lines about agents that do not come."""
        return [line for line in self.lines if "has reached this program" in line]


def test_a_wait_for_agents_that_do_not_come_is_explained_and_ends() -> None:
    site = Site()
    child = site.start()
    site.pods_run(4)
    site.loop.run_for(DOUBTED_AFTER - 0.1)
    assert not site.told
    site.loop.run_for(0.2)
    (doubt,) = site.told
    assert "no agent of its 4 running pods has reached this program at 10.0.0.7:41337" in doubt
    assert doubt.endswith(f"Waiting for {GIVEN_UP_AFTER:g} s more")
    site.loop.run_for(GIVEN_UP_AFTER)
    assert child.start_error.reason == "Unreachable"
    assert len(site.told) == 1
    assert site.start().start_error.reason == "Unreachable"  # at once


def test_slow_pods_are_no_reason_for_doubt() -> None:
    """Simulate pods whose image is pulled."""
    site = Site()
    site.start()
    site.pods_run(0)
    site.loop.run_for(ERROR_AT + 1)
    assert not site.told
    assert site.report is None


def test_an_agent_that_dials_at_last_ends_the_doubt() -> None:
    site = Site()
    site.start()
    site.pods_run(2)
    site.loop.run_for(ERROR_AT - 1)
    site.waiting.reached()
    site.loop.run_for(ERROR_AT)
    assert len(site.told) == 1
    assert site.report is None


def test_pods_that_may_serve_another_program_are_waited_for() -> None:
    """A warm pool's last master may be cut off from the API server alone, and keep its agents."""
    site = Site(displaced="laptop-8:4712")
    site.start()
    site.pods_run(2)
    site.loop.run_for(ERROR_AT + 1)
    (doubt,) = site.told
    assert doubt.endswith(
        "Or the pods still serve laptop-8:4712, the master before, which "
        "does not renew its Lease: end that program"
    )
    assert site.report is None


@pytest.mark.parametrize("waits", [False, True], ids=["idle", "waiting"])
def test_waiting_children_get_the_doubts(waits: bool) -> None:
    site = Site()
    if waits:
        site.start()
    site.pods_run(2)
    site.loop.run_for(DOUBTED_AFTER + 1)
    assert len(site.told) == waits
    site.start()
    assert len(site.told) == 1
