"""View of ``fiber top``: the text that shows a sample of a program's state.

Pure: the rates come from two samples.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

from fiber._cli import display
from fiber._runtime.summary import bytes_in_words

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
    """Processes with their ``share`` of a processor, as ``ProcessorShares`` sets it."""
    deaths: list[dict[str, Any]]
    totals: list[dict[str, Any]]
    """Totals of each of the programs."""

    @property
    def done(self) -> int:
        """Tasks that are done."""
        return sum(pool["done"] for pool in self.pools)

    def total(self, name: str) -> float:
        """Return the sum of a total over the programs."""
        return sum(float(totals[name]) for totals in self.totals)


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
    counted = [(name, int(sample.total(name))) for name in ("failed", "retried", "lost")]
    more = [(name, str(count)) for name, count in counted if count]
    for word in ("sent", "received"):
        more.append((word, bytes_in_words(int(sample.total(f"bytes_{word}")))))
    return "\n".join("   ".join(map(": ".join, line)) for line in (facts, more))


def _rate(sample: Sample, before: Sample | None) -> str:
    """Return the tasks done a second; a pool that ended meanwhile takes its tasks with it."""
    if before is None or sample.time <= before.time or sample.done < before.done:
        return "?"
    return f"{(sample.done - before.done) / (sample.time - before.time):.1f}"


class HostFacts:
    """Processes of a host by state, and what they use."""

    def __init__(self) -> None:
        self.states: Counter[str] = Counter()
        self.memory = 0
        self.cpu: float | None = None
        """Processors at work; None if not known."""

    def add(self, child: dict[str, Any]) -> None:
        """Count a process."""
        self.states[child["state"]] += 1
        self.memory += child.get("memory") or 0
        share = child.get("share")
        if share is not None:
            self.cpu = (self.cpu or 0.0) + share


def _workers(sample: Sample) -> str:
    """Return a table: for each host, its processes by state, their memory and processors."""
    hosts: dict[str, HostFacts] = {}
    total = HostFacts()
    for child in sample.children:
        host = child["host"] or "(no host yet)"
        for facts in (hosts.setdefault(host, HostFacts()), total):
            facts.add(child)
    if not hosts:
        return "no process or worker runs"
    columns = [state for state in _STATES if total.states[state]]
    rows = sorted(hosts.items(), key=lambda item: (-item[1].states.total(), item[0]))
    shown = [("all", total), *rows[:_HOSTS]] if len(rows) > 1 else rows
    lines = [
        [
            host,
            *(str(facts.states[state] or "") for state in columns),
            bytes_in_words(facts.memory) if facts.memory else "",
            "" if facts.cpu is None else f"{facts.cpu:.1f}",
        ]
        for host, facts in shown
    ]
    more = f"\n... and {len(rows) - _HOSTS} more hosts" if len(rows) > _HOSTS else ""
    return display.table(lines, ["host", *columns, "memory", "cpus"]) + more


def _slowest(sample: Sample) -> str:
    tasks = [task for pool in sample.pools for task in pool["slowest"]]
    tasks.sort(key=lambda task: -task["seconds"])
    rows = [
        [f"{task['seconds']:.1f}s", task["worker"], task["host"], task["task"], task["argument"]]
        for task in tasks[:_TASKS]
    ]
    return display.table(rows, ["for", "worker", "host", "task", "argument"]) if rows else ""


def _deaths(sample: Sample) -> str:
    rows = [
        [display.age(death["time"]), death["name"], death["host"], death["reason"]]
        for death in sample.deaths[-_DEATHS:]
    ]
    return display.table(rows, ["ago", "died", "host", "reason"]) if rows else ""
