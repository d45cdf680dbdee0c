"""View of ``fiber top``: the text that shows a sample of a program's state.

Pure: the rates come from two samples.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

from fiber._cli import display

_DEATHS = 5
"""Deaths that are shown, the last ones."""

_HOSTS = 12
"""Hosts that are shown, those with most processes."""

_TASKS = 10
"""Running tasks that are shown, those that run for longest."""

_STATES = ("busy", "idle", "starting", "waiting", "leaving", "running")


class Sample(NamedTuple):
    """State of a program at one moment."""

    time: float
    """Monotonic seconds."""
    programs: list[dict[str, Any]]
    """Processes that use Fiber: one, unless a pod runs several."""
    pools: list[dict[str, Any]]
    children: list[dict[str, Any]]
    deaths: list[dict[str, Any]]

    @property
    def done(self) -> int:
        """Tasks that are done."""
        return sum(pool["done"] for pool in self.pools)


def frame(sample: Sample, before: Sample | None) -> str:
    """Return the text for a sample; ``before`` is the sample before it."""
    parts = [_head(sample), _counts(sample, before), _workers(sample), _slowest(sample)]
    parts.append(_deaths(sample))
    return "\n\n".join(part for part in parts if part)


def _head(sample: Sample) -> str:
    return "\n".join(
        f"{program['name']}   {program['command']}   "
        f"{display.age(program['started'])}   {program['backend']}"
        for program in sample.programs
    )


def _counts(sample: Sample, before: Sample | None) -> str:
    facts = [
        ("tasks done", str(sample.done)),
        ("tasks a second", _rate(sample, before)),
        ("with workers", str(sum(pool["held"] for pool in sample.pools))),
        ("waiting", str(sum(pool["waiting"] for pool in sample.pools))),
    ]
    return "   ".join(f"{name}: {value}" for name, value in facts)


def _rate(sample: Sample, before: Sample | None) -> str:
    """Return the tasks done a second; a pool that ended meanwhile takes its tasks with it."""
    if before is None or sample.time <= before.time or sample.done < before.done:
        return "?"
    return f"{(sample.done - before.done) / (sample.time - before.time):.1f}"


def _workers(sample: Sample) -> str:
    """Return a table: for each host, its processes by state."""
    hosts: dict[str, Counter[str]] = {}
    for child in sample.children:
        host = child["host"] or "(no host yet)"
        hosts.setdefault(host, Counter())[child["state"]] += 1
    if not hosts:
        return "no process or worker runs"
    columns = [state for state in _STATES if any(counts[state] for counts in hosts.values())]
    total: Counter[str] = sum(hosts.values(), Counter())
    rows = sorted(hosts.items(), key=lambda item: (-item[1].total(), item[0]))
    shown = [("all", total), *rows[:_HOSTS]] if len(rows) > 1 else rows
    lines = [[host, *(str(counts[state] or "") for state in columns)] for host, counts in shown]
    more = f"\n... and {len(rows) - _HOSTS} more hosts" if len(rows) > _HOSTS else ""
    return display.table(lines, ["host", *columns]) + more


def _slowest(sample: Sample) -> str:
    tasks = [task for pool in sample.pools for task in pool["slowest"]]
    tasks.sort(key=lambda task: -task["seconds"])
    rows = [
        [f"{task['seconds']:.1f}s", task["worker"], task["host"], task["task"]]
        for task in tasks[:_TASKS]
    ]
    return display.table(rows, ["for", "worker", "host", "task"]) if rows else ""


def _deaths(sample: Sample) -> str:
    rows = [
        [display.age(death["time"]), death["name"], death["host"], death["reason"]]
        for death in sample.deaths[-_DEATHS:]
    ]
    return display.table(rows, ["ago", "died", "host", "reason"]) if rows else ""
