"""The poller of the live page: what it makes of a program's answers."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from typing import Any

from fiber._cli.asking import Ask
from fiber._cli.dashboard_poller import News, ProgramPoller
from fiber._cli.failures import NO_ANSWER, NOT_FOUND, CommandError
from fiber._engine.activity import Activity, WorkReport
from fiber._monitor import client
from patience import PATIENCE

Facts = dict[str, Any]

POOL = {"waiting": 2, "held": 1, "done": 0, "slowest": []}


class ScriptedProgram:
    """Program that answers a poller; ``failure`` is raised instead."""

    def __init__(self, pid: int = 1, children: int = 1) -> None:
        self.pid = pid
        self.children = children
        self.start = 100.0
        self.activity = Activity(0.0)
        self.failure: Exception | None = None
        self.work()

    @property
    def child(self) -> Facts:
        return {"name": "w", "host": "h", "pid": self.pid, "state": "busy"}

    def work(self) -> None:
        worker = self.activity.add_child("w", 0.0)
        self.activity.worked(worker, WorkReport("f", 0.0, 1.0, 1.0, 1))

    def begin_anew(self) -> None:
        self.start += 10
        self.activity = Activity(0.0)
        for _ in range(5):  # its revision is beyond that of the record before
            self.activity.snapshot(0.0)

    def ask(self, request: Facts) -> Iterator[Facts]:
        if self.failure is not None:
            raise self.failure
        yield {"program": {"pid": self.pid, "children": self.children}}
        if request["ask"] == "activity":
            snapshot = self.activity.snapshot(1.0, request["since"])
            yield {"activity": {"start": self.start, **snapshot}}
        else:
            yield {"pool": POOL}
            yield {"child": self.child}
            yield {"death": {"name": "dead"}}


def poller_of(ask: Ask) -> ProgramPoller:
    return ProgramPoller(lambda: ask, lambda news: None, always=False)


def children_in(news: News) -> int:
    assert news.activity is not None
    return len(news.activity["children"])


def test_the_second_look_asks_for_changes_only() -> None:
    program = ScriptedProgram()
    poller = poller_of(program.ask)
    first = poller.look()
    assert first.state == {
        "pools": [POOL],
        "children": [program.child],
        "deaths": [{"name": "dead"}],
    }
    assert (children_in(first), first.problem) == (1, "")
    assert children_in(poller.look()) == 0
    program.work()
    assert children_in(poller.look()) == 1


def test_what_changed_is_asked_for_again_after_a_failure() -> None:
    program = ScriptedProgram()
    failures: list[Exception] = [client.NoAnswer("no state")]

    def ask(request: Facts) -> Iterator[Facts]:
        if request["ask"] == "state" and failures:
            raise failures.pop()
        return program.ask(request)

    poller = poller_of(ask)
    assert poller.look().problem == "no state"
    assert children_in(poller.look()) == 1


def test_a_new_record_of_the_program_is_read_whole() -> None:
    program = ScriptedProgram()
    poller = poller_of(program.ask)
    poller.look()
    program.begin_anew()
    found = poller.look().activity
    assert found is not None
    assert (found["complete"], found["start"]) == (True, 110.0)


def test_of_several_processes_the_one_with_most_children_is_shown() -> None:
    programs = [ScriptedProgram(1, 1), ScriptedProgram(2, 5)]

    def ask(request: Facts) -> Iterator[Facts]:
        for each in programs:
            yield from each.ask(request)

    poller = poller_of(ask)
    for children in (1, 9):  # it stays the one
        programs[0].children = children
        news = poller.look()
        assert news.program is not None
        assert news.program["pid"] == 2
        assert news.state is not None
        assert news.state["children"] == [programs[1].child]
    programs.pop()
    news = poller.look()
    assert (news.program or {})["pid"] == 1
    assert children_in(news) == 1


def test_reasons_for_no_answer() -> None:
    program = ScriptedProgram()
    poller = poller_of(program.ask)
    for failure, expected in (
        (client.NoAnswer("it does not answer"), News(problem="it does not answer")),
        (client.ProgramGone("it is gone"), News(problem="it is gone", has_ended=True)),
        (CommandError("no pod", "why", "", NOT_FOUND), News(problem="no pod: why", has_ended=True)),
        (CommandError("no login", "", "", NO_ANSWER), News(problem="no login")),
    ):
        program.failure = failure
        assert poller.look() == expected
    program.failure = None
    assert poller.look().activity is not None


def test_an_error_in_the_answer_is_shown() -> None:
    def ask(request: Facts) -> Iterator[Facts]:
        yield {"program": {"pid": 1, "children": 1}}
        yield {"error": "FiberError: this version of Fiber has no answer to 'activity'"}

    news = poller_of(ask).look()
    assert "has no answer to 'activity'" in news.problem
    assert not news.has_ended


def test_the_last_look_begins_after_the_end_was_asked_for() -> None:
    """A look that is under way may not know what the program did last."""
    program = ScriptedProgram()
    asked, goes_on = threading.Event(), threading.Event()
    seen: list[News] = []

    def ask(request: Facts) -> Iterator[Facts]:
        asked.set()
        assert goes_on.wait(PATIENCE)
        yield from program.ask(request)

    poller = ProgramPoller(lambda: ask, seen.append, always=True)
    poller.start()
    assert asked.wait(PATIENCE)
    poller.end(0.0)
    goes_on.set()
    poller.end(PATIENCE)
    assert len(seen) == 2


def test_a_program_is_asked_only_while_a_page_is_open() -> None:
    program = ScriptedProgram()
    came: queue.SimpleQueue[News] = queue.SimpleQueue()
    poller = ProgramPoller(lambda: program.ask, came.put, always=False)
    poller.start()
    poller.opened()
    assert came.get(timeout=PATIENCE).program is not None
    came.get(timeout=PATIENCE)
    poller.closed()
    poller.end(PATIENCE)
