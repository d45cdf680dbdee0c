"""How many workers there should be, and when it is no use to try again."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest
from fiber._runtime.crew import IDLE_PAUSE, LONGEST_PAUSE, TRIES, Crew
from fiber._runtime.workers import Link

from fiber._agent.port import ExitReport
from fiber._runtime import crew as crew_module
from fiber.errors import StartError


class Started:
    """A process that can be started."""

    def __init__(self, link: Link, context: Any, **options: Any) -> None:
        self.name = "w"

    def start(self) -> None:
        pass


@pytest.fixture
def crew(monkeypatch: pytest.MonkeyPatch) -> Crew:
    monkeypatch.setattr(crew_module, "PoolProcess", Started)
    supervisor: Any = None
    return Crew(supervisor, threading.Lock(), None, (), 2, 4)


def hire(crew: Crew, *, ready: bool = False) -> Link:
    crew.order(1)
    link = crew.hire()
    assert link is not None
    if ready:
        worker: Any = SimpleNamespace(queue=[])
        link.worker = worker
        crew.ready()
    return link


def report(exitcode: int = 1, reason: str = "exit status 1") -> ExitReport:
    return ExitReport(exitcode, reason)


def test_the_number_of_workers_follows_the_demand_within_bounds(crew: Crew) -> None:
    assert [crew.wanted(demand) for demand in (0, 1, 2, 3, 4, 100)] == [2, 2, 2, 3, 4, 4]
    assert crew.missing(3, 0) == 3
    crew.order(1)
    assert crew.missing(3, 0) == 2
    assert crew.missing(0, 0) == 1


def test_newcomers_are_ordered_for_tasks_that_only_they_may_run(crew: Crew) -> None:
    for _ in range(2):
        hire(crew, ready=True)
    assert crew.missing(1, 0) == 0
    assert crew.missing(1, 1) == 1
    hire(crew)
    assert crew.missing(1, 1) == 0
    hire(crew)
    assert crew.missing(1, 5) == 0, "more than the maximum"


def test_counts(crew: Crew) -> None:
    crew.order(3)
    assert (crew.size, crew.starting, crew.ordered) == (3, 3, 3)
    crew.cancel()
    assert (crew.size, crew.starting, crew.ordered) == (0, 0, 0)
    assert crew.hire() is None
    one, other = hire(crew, ready=True), hire(crew)
    assert (crew.size, crew.starting) == (2, 1)
    crew.let_go(other)
    crew.let_go(other)
    assert (crew.size, crew.starting, crew.staying()) == (1, 0, [one])
    crew.gone(other, report())
    crew.gone(one, report())
    assert (crew.size, crew.starting, dict(crew.links)) == (0, 0, {})
    assert crew.failures == 0


def test_it_gives_up_when_none_starts(crew: Crew) -> None:
    for _ in range(TRIES):
        assert crew.error is None
        link = hire(crew)
        link.complaint = "Traceback: no such device"
        crew.gone(link, report())
    assert isinstance(crew.error, StartError)
    assert "no such device" in str(crew.error)


def test_a_signal_may_be_an_accident(crew: Crew) -> None:
    for _ in range(TRIES):
        crew.gone(hire(crew), report(-9, "killed by SIGKILL"))
    assert crew.error is None
    for _ in range(TRIES):
        crew.gone(hire(crew), report(-9, "killed by SIGKILL"))
    assert crew.error is not None
    assert "SIGKILL" in str(crew.error)


def test_a_lost_host_says_nothing_of_its_workers(crew: Crew) -> None:
    for _ in range(10):
        crew.gone(hire(crew), report(-9, "agent h1 lost: no sign of life for 15 s"))
    assert (crew.failures, crew.error) == (0, None)


def test_one_that_starts_clears_the_others(crew: Crew) -> None:
    for _ in range(TRIES - 1):
        crew.gone(hire(crew), report())
    link = hire(crew, ready=True)
    assert crew.failures == 0
    crew.gone(link, report())
    crew.gone(hire(crew), report())
    assert crew.error is None


def test_while_others_work_it_tries_again_less_and_less_often(crew: Crew) -> None:
    at_work = hire(crew, ready=True)
    pauses = []
    for _ in range(12):
        crew.gone(hire(crew), report())
        pauses.append(crew.pause())
    assert pauses[: TRIES - 1] == [0.0] * (TRIES - 1)
    assert pauses[TRIES - 1 :] == sorted(pauses[TRIES - 1 :])
    assert pauses[-1] == LONGEST_PAUSE
    assert crew.error is None
    assert crew.trouble is not None
    crew.gone(at_work, report())
    assert crew.pause() == 0.0, "nobody is at work: try at once"
    crew.gone(hire(crew), report())
    assert crew.error is not None


def test_workers_that_die_idle_again_and_again_are_replaced_slowly(crew: Crew) -> None:
    for _ in range(TRIES + crew.maximum):
        crew.gone(hire(crew, ready=True), report(-9, "killed by SIGKILL"))
        assert crew.pause() == 0.0
    crew.gone(hire(crew, ready=True), report(-9, "killed by SIGKILL"))
    assert crew.pause() == IDLE_PAUSE
    assert crew.error is None


def test_what_cannot_even_be_asked_for(crew: Crew, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Started) -> None:
        raise OSError("too many open files")

    monkeypatch.setattr(Started, "start", refuse)
    for _ in range(TRIES):
        crew.order(1)
        with pytest.raises(OSError, match="too many") as caught:
            crew.hire()
        crew.refused(caught.value)
    assert (crew.size, crew.starting, dict(crew.links)) == (0, 0, {})
    assert "too many open files" in str(crew.error)
