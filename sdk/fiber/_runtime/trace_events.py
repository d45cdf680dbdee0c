"""Trace of a program in Chrome's trace event format, for Perfetto and chrome://tracing.

Pure: a snapshot of the activity in, plain values out.  Each host is a process of the trace, and
each child a thread.  Process 0 is the program, with the counters.  Times are whole microseconds
after the beginning.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from typing import Any, NamedTuple

Event = dict[str, Any]
Facts = dict[str, Any]

PROGRAM = 0
"""Process of the trace that is the program."""

NO_HOST = "no host yet"
"""Name of the process with the children that have not started."""

WAITING = "waiting to start"
STARTING = "starting up"
RUNNING = "running"
UNFINISHED = "tasks without an answer"


class ChildPhase(NamedTuple):
    """Time of a child in which it did no work of a known function."""

    name: str
    begin: float
    end: float


def phases(child: Facts, now: float, busy_since: float | None = None) -> Iterator[ChildPhase]:
    """Yield what a child did besides its spans; ``busy_since``: as ``busy`` of the snapshot."""
    spans = child["spans"]
    end = now if child["ended"] is None else child["ended"]
    first = spans[0][0] if spans else end
    started, ready = child["started"], child["ready"]
    if started is None:
        yield ChildPhase(WAITING, child["began"], end)
        return
    yield ChildPhase(WAITING, child["began"], min(started, first))
    if ready is not None:
        yield ChildPhase(STARTING, started, min(ready, first))
    else:  # a process, or a worker whose initializer has not returned
        yield ChildPhase(RUNNING, started, end)
    if busy_since is not None and child["ended"] is None:
        yield ChildPhase(UNFINISHED, max(busy_since, spans[-1][1] if spans else 0.0), end)


def trace(snapshot: Facts, program: Facts) -> Facts:
    """Return the trace of a snapshot; ``program``: facts of the program for its ``otherData``."""
    events = list(_metadata(snapshot["children"], program))
    now, busy = snapshot["now"], dict(snapshot["busy"])
    hosts = host_numbers(snapshot["children"])
    for child in snapshot["children"]:
        place = {"pid": hosts[child["host"]], "tid": child["id"]}
        events += (
            _phase(phase, place)
            for phase in phases(child, now, busy.get(child["id"]))
            if microseconds(phase.begin) < microseconds(phase.end)
        )
        events += (_work(span, place) for span in child["spans"])
        if child["reason"]:
            events.append(_death(child, place))
    events += _arrivals(snapshot["children"], hosts)
    events += _rates(snapshot)
    events += _counts(snapshot["children"])
    start = datetime.fromtimestamp(snapshot["start"], UTC)
    about = {
        "start": start.isoformat(timespec="milliseconds"),
        "seconds": round(now, 6),
        "tasks": snapshot["tasks"],
        "failed": snapshot["failed"],
        "resolution": snapshot["resolution"],
        "children without a row": snapshot["forgotten"],
    }
    return {
        "traceEvents": events,
        "displayTimeUnit": "ms",
        "otherData": {**program, **about},
    }


def host_numbers(children: Iterable[Facts]) -> dict[str, int]:
    """Return the process of the trace for each host, in the order in which the hosts came."""
    numbers: dict[str, int] = {}
    for child in sorted(children, key=_came):
        numbers.setdefault(child["host"], len(numbers) + 1)
    return numbers


def _came(child: Facts) -> float:
    return float("inf") if child["started"] is None else child["started"]


def microseconds(seconds: float) -> int:
    """Return whole microseconds."""
    return round(seconds * 1e6)


def _metadata(children: list[Facts], program: Facts) -> Iterator[Event]:
    nodes = {child["host"]: child["node"] for child in children if child["node"]}
    numbers = host_numbers(children)
    named = f"program {program.get('name', '')}".strip()
    yield _fact("process_name", {"name": named}, PROGRAM)
    yield _fact("process_sort_index", {"sort_index": PROGRAM}, PROGRAM)
    for host, number in numbers.items():
        yield _fact("process_name", {"name": f"host {host}" if host else NO_HOST}, number)
        yield _fact("process_sort_index", {"sort_index": number}, number)
        if host in nodes:
            yield _fact("process_labels", {"labels": f"node {nodes[host]}"}, number)
    for child in children:
        number, row = numbers[child["host"]], child["id"]
        name = child["name"] if child["pid"] is None else f"{child['name']} (pid {child['pid']})"
        yield _fact("thread_name", {"name": name}, number, row)
        yield _fact("thread_sort_index", {"sort_index": row}, number, row)


def _fact(name: str, args: Facts, pid: int, tid: int = 0) -> Event:
    return {"ph": "M", "name": name, "pid": pid, "tid": tid, "ts": 0, "args": args}


def _complete(name: str, kind: str, begin: float, end: float, place: Event) -> Event:
    ts = microseconds(begin)
    # Both ends are rounded, so that events that follow each other do not overlap.
    dur = max(0, microseconds(end) - ts)
    return {"ph": "X", "name": name, "cat": kind, "ts": ts, "dur": dur, **place}


def _phase(phase: ChildPhase, place: Event) -> Event:
    return _complete(phase.name, "phase", phase.begin, phase.end, place)


def _work(span: list[Any], place: Event) -> Event:
    begin, end, function, work, tasks, failed = span
    event = _complete(function, "work" if tasks else "lost work", begin, end, place)
    event["args"] = {"tasks": tasks, "failed": failed, "work": round(work, 9)}
    return event


def _instant(name: str, at: float, scope: str, place: Event, **args: object) -> Event:
    ts = microseconds(at)
    return {"ph": "i", "name": name, "ts": ts, "s": scope, "cat": "life", **place, "args": args}


def _death(child: Facts, place: Event) -> Event:
    reason = child["reason"]
    return _instant(f"died: {reason}", child["ended"], "t", place, reason=reason)


def _arrivals(children: Iterable[Facts], hosts: dict[str, int]) -> Iterator[Event]:
    """Yield an event for the first start on each host, and one for the last end there."""
    for host, stay in stays(children).items():
        place = {"pid": hosts[host], "tid": 0}
        yield _instant(f"first process on {host}", stay.first, "p", place)
        if stay.last is not None:
            yield _instant(f"last process on {host} has ended", stay.last, "p", place)


class Stay(NamedTuple):
    """Time of a host in the program."""

    first: float
    """Time of the first start of a child."""
    last: float | None
    """Time of the last end of a child; None while one lives."""


def stays(children: Iterable[Facts]) -> dict[str, Stay]:
    """Return the stay of each host on which a child has started."""
    found: dict[str, Stay] = {}
    for child in children:
        if child["started"] is None:
            continue
        host, first, last = child["host"], child["started"], child["ended"]
        if host in found:
            before = found[host]
            first = min(first, before.first)
            last = None if last is None or before.last is None else max(last, before.last)
        found[host] = Stay(first, last)
    return found


def _rates(snapshot: Facts) -> Iterator[Event]:
    rates = snapshot["rates"]
    width = rates["width"]
    for at, (done, failed) in enumerate(zip(rates["done"], rates["failed"], strict=True)):
        counts = {"done": (done - failed) / width, "failed": failed / width}
        yield _counter("tasks a second", at * width, counts)
    if rates["done"]:
        yield _counter("tasks a second", len(rates["done"]) * width, {"done": 0, "failed": 0})


def _counts(children: list[Facts]) -> Iterator[Event]:
    """Yield the numbers of processes and of hosts at each change."""
    lives = [(child["started"], child["ended"]) for child in children]
    for at, number in _changes(lives):
        yield _counter("processes", at, {"processes": number})
    for at, number in _changes(stays(children).values()):
        yield _counter("hosts", at, {"hosts": number})


def _changes(lives: Iterable[tuple[float | None, float | None]]) -> Iterator[tuple[float, int]]:
    changes: dict[float, int] = {}
    for begin, end in lives:
        if begin is not None:
            changes[begin] = changes.get(begin, 0) + 1
            if end is not None:
                changes[end] = changes.get(end, 0) - 1
    number = 0
    for at in sorted(changes):
        number += changes[at]
        yield at, number


def _counter(name: str, at: float, values: dict[str, float]) -> Event:
    ts = microseconds(at)
    return {"ph": "C", "name": name, "ts": ts, "pid": PROGRAM, "tid": 0, "args": values}
