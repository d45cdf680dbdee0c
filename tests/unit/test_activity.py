"""The record of what the children of a program did: totals, spans, and their bounds."""

from __future__ import annotations

import itertools
import json
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber._engine import activity
from fiber._engine.activity import Activity, ChildRecord, WorkReport
from fiber._runtime.pool_activity import PoolActivity
from fiber._transport.loop import Loop

START = 1000.0


def working(record: Activity, *, name: str = "w", at: float = START) -> ChildRecord:
    child = record.add_child(name, at)
    record.started(child, at, "host", "node", 7)
    record.ready(child, at, 1)
    return child


def spans_of(found: dict[str, Any]) -> list[list[Any]]:
    (child,) = found["children"]
    spans: list[list[Any]] = child["spans"]
    return spans


def test_answers_that_follow_each_other_are_one_span() -> None:
    record = Activity(START)
    child = working(record)
    record.worked(child, WorkReport("f", START + 1, START + 2, 1.0, 10))
    record.worked(child, WorkReport("f", START + 2.0005, START + 3, 0.9995, 5, 1))
    record.worked(child, WorkReport("f", START + 4, START + 5, 1.0, 1))
    record.worked(child, WorkReport("g", START + 5, START + 6, 1.0, 1))
    assert spans_of(record.snapshot(START + 6)) == [
        [1, 3, "f", pytest.approx(1.9995), 15, 1],
        [4, 5, "f", 1.0, 1, 0],
        [5, 6, "g", 1.0, 1, 0],
    ]


def test_totals_of_the_program_of_children_and_of_functions() -> None:
    record = Activity(START)
    first, second = working(record), working(record, name="v")
    record.worked(first, WorkReport("f", START, START + 1, 1.0, 4, 1))
    record.worked(second, WorkReport("f", START, START + 3, 3.0, 1))
    record.ended(second, START + 4, "exit status 3")
    found = record.snapshot(START + 5)
    assert (found["tasks"], found["failed"], found["now"]) == (5, 1, 5)
    assert found["functions"] == [
        {
            "name": "f",
            "tasks": 5,
            "failed": 1,
            "answers": 2,
            "chunk": 1,
            "work": 4.0,
            "longest": 3.0,
        }
    ]
    assert [(c["tasks"], c["failed"], c["ended"], c["reason"]) for c in found["children"]] == [
        (4, 1, None, ""),
        (1, 0, 4.0, "exit status 3"),
    ]
    assert [child.name for child in record.deaths] == ["v"]
    assert json.loads(json.dumps(found)) == found


def test_a_later_snapshot_has_what_changed() -> None:
    record = Activity(START)
    idle, busy = working(record, name="idle"), working(record, name="busy")
    record.worked(busy, WorkReport("f", START, START + 1, 1.0, 1))
    record.worked(busy, WorkReport("f", START + 2, START + 3, 1.0, 1))
    first = record.snapshot(START + 3)
    assert first["complete"]
    record.worked(busy, WorkReport("f", START + 3, START + 4, 1.0, 1))
    later = record.snapshot(START + 4, first["revision"])
    assert not later["complete"]
    assert [child["name"] for child in later["children"]] == ["busy"]
    assert spans_of(later) == [[2, 4, "f", 2.0, 2, 0]]
    assert record.snapshot(START + 5, later["revision"])["children"] == []
    record.ended(idle, START + 6)
    assert [c["name"] for c in record.snapshot(START + 6, later["revision"])["children"]] == [
        "idle"
    ]


def test_spans_become_coarse_and_keep_their_sums() -> None:
    record = Activity(START, spans=100)
    child = working(record)
    for second in range(1000):
        record.worked(
            child, WorkReport("fg"[second % 2], START + second, START + second + 0.5, 0.5, 2)
        )
    found = record.snapshot(START + 1000)
    spans = spans_of(found)
    assert len(spans) <= 100
    assert found["resolution"] > 0.5
    assert sum(span[3] for span in spans) == 500
    assert sum(span[4] for span in spans) == 2000
    assert {span[2] for span in spans} <= {activity.SEVERAL, "f", "g"}
    assert all(one[1] <= other[0] for one, other in itertools.pairwise(spans))


def test_functions_in_turn_do_not_make_the_record_coarse_or_large() -> None:
    record = Activity(START, spans=100)
    child = working(record)
    record.ended(working(record, name="ended"), START)
    for answer in range(10_000):
        begin = START + answer / 1000
        record.worked(child, WorkReport("fg"[answer % 2], begin, begin + 0.001, 0.001, 1))
    found = record.snapshot(START + 10)
    assert found["forgotten"] == 0
    assert found["resolution"] < 0.1
    assert sum(len(child["spans"]) for child in found["children"]) <= 101


def test_a_lost_run_is_no_part_of_a_span_of_work() -> None:
    record = Activity(START, spans=10)
    child = working(record)
    record.worked(child, WorkReport("f", START, START + 1, 1.0, 5))
    record.worked(child, WorkReport("f", START + 1, START + 100, 0.0, 0))
    expected = [[0, 1, "f", 1.0, 5, 0], [1, 100, "f", 0.0, 0, 0]]
    assert spans_of(record.snapshot(START + 100)) == expected
    other = working(record)
    for second in range(200, 220):
        record.worked(other, WorkReport("f", START + second, START + second, 0.0, 1))
    first, _ = record.snapshot(START + 300)["children"]
    assert first["spans"] == expected


def test_merged_spans_replace_all_earlier_snapshots() -> None:
    record = Activity(START, spans=10)
    child = working(record)
    record.worked(child, WorkReport("f", START, START + 1, 1.0, 1))
    first = record.snapshot(START + 1)
    for second in range(2, 40, 2):
        record.worked(child, WorkReport("f", START + second, START + second + 1, 1.0, 1))
    later = record.snapshot(START + 50, first["revision"])
    assert later["complete"]
    assert sum(span[4] for span in spans_of(later)) == 20


def test_ended_children_are_forgotten_when_there_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(activity, "ENDED", 3)
    record = Activity(START)
    for number in range(10):
        child = working(record, name=str(number))
        record.worked(child, WorkReport("f", START, START + 1, 1.0, 1))
        record.ended(child, START + number)
    found = record.snapshot(START + 10)
    assert [child["name"] for child in found["children"]] == ["7", "8", "9"]
    assert (found["forgotten"], found["tasks"]) == (7, 10)


def test_a_child_that_never_ran_is_forgotten_and_its_death_is_kept() -> None:
    record = Activity(START)
    child = record.add_child("refused", START)
    first = record.snapshot(START)
    record.ended(child, START + 1, "no room")
    later = record.snapshot(START + 1, first["revision"])
    assert later["complete"]
    assert later["children"] == []
    assert [(death.name, death.reason) for death in record.deaths] == [("refused", "no room")]


def test_children_with_a_span_each_stay_whole() -> None:
    record = Activity(START, spans=10)
    children = [working(record, name=str(number)) for number in range(50)]
    for child in children:
        record.worked(child, WorkReport("f", START, START + 1, 1.0, 1))
    found = record.snapshot(START + 1)
    assert [len(child["spans"]) for child in found["children"]] == [1] * 50


def test_functions_beyond_the_limit_share_their_totals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(activity, "FUNCTIONS", 2)
    record = Activity(START)
    child = working(record)
    for name in "abcda":
        record.worked(child, WorkReport(name, START, START + 1, 1.0, 1))
    counts = {one["name"]: one["tasks"] for one in record.snapshot(START + 1)["functions"]}
    assert counts == {"a": 2, "b": 1, activity.OTHER_FUNCTIONS: 2}


@given(st.lists(st.tuples(st.floats(0, 1e5), st.integers(0, 9), st.integers(0, 9)), max_size=50))
def test_rates_have_all_tasks_in_a_bounded_history(events: list[tuple[float, int, int]]) -> None:
    record = Activity(0.0)
    for time, tasks, failed in sorted(events):
        record.rates.add(time, tasks, failed)
    rates = record.snapshot(1e5)["rates"]
    assert len(rates["done"]) == len(rates["failed"]) <= 600
    assert sum(rates["done"]) == sum(tasks for _, tasks, _ in events)
    assert sum(rates["failed"]) == sum(failed for _, _, failed in events)


def test_pauses_of_a_caller_between_its_calls_are_not_on_the_way(loop: Loop) -> None:
    record = Activity(START)
    child = working(record)
    handle: Any = SimpleNamespace(record=child)
    work = WorkReport("f", START + 1, START + 5, 0.5, 3, 0, 3)
    PoolActivity(record, loop).leased(handle, work)
    assert (child.held, child.work) == (0.5, 0.5)
    (function,) = record.snapshot(START + 6)["functions"]
    assert (function["tasks"], function["answers"]) == (3, 3)
