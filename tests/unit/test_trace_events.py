"""Trace of a program: each event has the fields of its kind, and the sums are the record's."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from itertools import pairwise
from typing import Any

from fiber._engine.activity import SPANS, Activity, ChildRecord, WorkReport
from fiber._runtime import activity_reading, trace_events

START = 1000.0
PROGRAM = {"name": "train-7", "pid": 7, "python": "3.11.0", "fiber": "0.1"}

REQUIRED = {
    "M": {"name", "pid", "tid", "args"},
    "X": {"name", "cat", "ts", "dur", "pid", "tid"},
    "i": {"name", "cat", "ts", "s", "pid", "tid"},
    "C": {"name", "ts", "pid", "args"},
}
"""Fields of the trace event format, by the kinds of events that Fiber writes."""

METADATA = {
    "process_name": "name",
    "process_labels": "labels",
    "process_sort_index": "sort_index",
    "thread_name": "name",
    "thread_sort_index": "sort_index",
}
"""Events about the trace, and the argument that each has."""


def child_of(record: Activity, host: str, *, at: float = START) -> ChildRecord:
    child = record.add_child(f"worker-on-{host}", at)
    record.started(child, at + 1, host, f"node-of-{host}", 70)
    record.ready(child, at + 1.5, 1)
    return child


def snapshot_of(record: Activity, now: float, busy: list[Any] | None = None) -> dict[str, Any]:
    return {"start": 1.7e9, "busy": busy or [], **record.snapshot(now)}


def events_of(snapshot: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the events of a trace that is valid."""
    trace = trace_events.trace(snapshot, PROGRAM)
    assert json.loads(json.dumps(trace)) == trace
    events: list[dict[str, Any]] = trace["traceEvents"]
    for event in events:
        check(event)
    check_nesting(events)
    return events


def check(event: dict[str, Any]) -> None:
    assert event.keys() >= REQUIRED[event["ph"]], event
    for key in ("pid", "tid", "ts", "dur"):
        value = event.get(key, 0)
        assert isinstance(value, int), event
        assert value >= 0, event
    if event["ph"] == "M":
        assert list(event["args"]) == [METADATA[event["name"]]]
    if event["ph"] == "i":
        assert event["s"] in ("g", "p", "t")
    if event["ph"] == "C":
        assert all(isinstance(value, int | float) for value in event["args"].values())


def check_nesting(events: list[dict[str, Any]]) -> None:
    """Complete events of a thread must not overlap: viewers would drop some."""
    rows = defaultdict(list)
    for event in events:
        if event["ph"] == "X":
            rows[event["pid"], event["tid"]].append((event["ts"], event["ts"] + event["dur"]))
    for row in rows.values():
        row.sort()
        assert all(end <= begin for (_, end), (begin, _) in pairwise(row))


def named(events: list[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    return [event for event in events if event["name"] == name]


def test_a_program_without_a_process_has_an_empty_trace() -> None:
    events = events_of(activity_reading.no_activity())
    assert {event["ph"] for event in events} == {"M"}


def test_hosts_are_processes_and_children_are_threads() -> None:
    record = Activity(START)
    for host in ("a", "b", "a"):
        child_of(record, host)
    record.add_child("still-waiting", START)
    events = events_of(snapshot_of(record, START + 5))
    processes = {event["pid"]: event["args"]["name"] for event in named(events, "process_name")}
    assert processes == {0: "program train-7", 1: "host a", 2: "host b", 3: "no host yet"}
    threads = [(event["pid"], event["tid"]) for event in named(events, "thread_name")]
    assert threads == [(1, 1), (2, 2), (1, 3), (3, 4)]
    labels = {event["args"]["labels"] for event in named(events, "process_labels")}
    assert labels == {"node node-of-a", "node node-of-b"}


def test_the_sums_are_those_of_the_record() -> None:
    record = Activity(START)
    children = [child_of(record, host) for host in ("a", "b")]
    for number in range(100):
        begin = START + 2 + number
        report = WorkReport(f"f{number % 3}", begin, begin + 0.5, 0.25, 7, number % 2)
        record.worked(children[number % 2], report)
    snapshot = snapshot_of(record, START + 200)
    work = [event for event in events_of(snapshot) if event.get("cat") == "work"]
    for key, total in (("tasks", 700), ("failed", 50)):
        assert sum(event["args"][key] for event in work) == snapshot[key] == total
    assert sum(event["args"]["work"] for event in work) == 25.0
    by_function = Counter(event["name"] for event in work)
    assert by_function == {"f0": 34, "f1": 33, "f2": 33}
    rates = named(events_of(snapshot), "tasks a second")
    counted = sum(sum(event["args"].values()) for event in rates) * snapshot["rates"]["width"]
    assert round(counted) == 700


def test_a_death_is_an_instant_with_its_reason_and_the_lost_work_is_marked() -> None:
    record = Activity(START)
    child = child_of(record, "a")
    record.worked(child, WorkReport("f", START + 2, START + 4, 0.0, 0))
    record.ended(child, START + 4, "OOMKilled: out of memory")
    events = events_of(snapshot_of(record, START + 5))
    (death,) = [event for event in events if event["name"].startswith("died")]
    assert (death["ts"], death["s"], death["tid"]) == (4_000_000, "t", child.id)
    assert death["args"] == {"reason": "OOMKilled: out of memory"}
    (lost,) = named(events, "f")
    assert (lost["cat"], lost["dur"]) == ("lost work", 2_000_000)


def test_hosts_come_and_go() -> None:
    record = Activity(START)
    first, second, other = (child_of(record, host, at=START) for host in ("a", "a", "b"))
    record.ended(first, START + 3)
    record.ended(other, START + 4)
    events = events_of(snapshot_of(record, START + 6))
    arrivals = [(event["name"], event["ts"]) for event in events if event.get("s") == "p"]
    assert arrivals == [
        ("first process on a", 1_000_000),
        ("first process on b", 1_000_000),
        ("last process on b has ended", 4_000_000),
    ]
    hosts = [(event["ts"], event["args"]["hosts"]) for event in named(events, "hosts")]
    assert hosts == [(1_000_000, 2), (4_000_000, 1)]
    processes = [event["args"]["processes"] for event in named(events, "processes")]
    assert processes == [3, 2, 1]
    assert second.ended is None


def test_the_start_and_tasks_without_an_answer_are_phases() -> None:
    record = Activity(START)
    child = child_of(record, "a")
    record.worked(child, WorkReport("f", START + 2, START + 3, 1.0, 1))
    events = events_of(snapshot_of(record, START + 9, busy=[[child.id, 3.5]]))
    phases = [(e["name"], e["ts"], e["dur"]) for e in events if e.get("cat") == "phase"]
    assert phases == [
        ("waiting to start", 0, 1_000_000),
        ("starting up", 1_000_000, 500_000),
        ("tasks without an answer", 3_500_000, 5_500_000),
    ]


def test_a_child_that_is_no_worker_runs_from_its_start_to_its_end() -> None:
    record = Activity(START)
    child = record.add_child("Process-1", START)
    record.started(child, START + 1, "a", "", 70)
    record.ended(child, START + 4)
    events = events_of(snapshot_of(record, START + 9))
    assert [(e["ts"], e["dur"]) for e in named(events, "running")] == [(1_000_000, 3_000_000)]


def test_a_million_tasks_make_a_bounded_trace() -> None:
    record = Activity(START)
    children = [child_of(record, f"host-{number % 10}") for number in range(100)]
    for number in range(100_000):
        begin = START + 2 + number / 50
        report = WorkReport(f"f{number % 3}", begin, begin + 0.01, 0.01, 10)
        record.worked(children[number % 100], report)
    snapshot = snapshot_of(record, START + 3000)
    events = events_of(snapshot)
    assert snapshot["tasks"] == 1_000_000
    assert len(events) <= SPANS + 6 * len(children) + 1000
    work = [event for event in events if event.get("cat") == "work"]
    assert sum(event["args"]["tasks"] for event in work) == 1_000_000
