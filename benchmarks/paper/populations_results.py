"""Results of the runs whose population grows and shrinks: curves, their integrals, the table."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import report
from benchmarks.paper.populations_plan import GO_EXPLORE, POET
from benchmarks.samples import in_words, times

from fiber.resources import GPU

RESULTS = "populations.json"
PICTURE = "populations.png"
DYNAMIC, STATIC = "dynamic", "static"
TITLES = {POET: "POET-like", GO_EXPLORE: "Go-Explore-like"}
Steps = Sequence[tuple[float, float]]
Body = dict[str, Any]

_UNITS = {"m": 1e-3, "u": 1e-6, "n": 1e-9, "k": 1e3}


class Held(NamedTuple):
    """Room on a node that a pod holds."""

    processors: float
    gpus: int


class Sample(NamedTuple):
    """Pods from this time on: those that hold room on a node, and how much of it together."""

    at: float
    pods: int
    gpu_pods: int
    processors: float
    gpus: int


class Open(NamedTuple):
    """Number of open tasks from this time on."""

    at: float
    tasks: int


@dataclass(frozen=True)
class Trace:
    """Run with one allocation. Times are seconds since the program's begin.

    `bound` is the least possible `wall`, `work` has the seconds of all tasks, and `until` is when
    the last pod was gone. What pods held counts until the program's end: how long a pod takes to
    end afterwards does not depend on the allocation.
    """

    wall: float
    bound: float
    until: float
    work: float
    demand: list[Open]
    samples: list[Sample]
    load_before: float
    in_use: float
    """Share of the processors' time that other programs used in a moment before the run."""

    @property
    def processor_seconds(self) -> float:
        """Return what the pods' requests held, in seconds of one processor."""
        return area([(each.at, each.processors) for each in self.samples], self.wall)

    @property
    def growth(self) -> list[tuple[float, float]]:
        """Return times, with the processor-seconds that pods held until then."""
        held_by_pods = [(each.at, each.processors) for each in self.samples]
        times_of_changes = [each.at for each in self.samples if each.at < self.wall]
        return [(at, area(held_by_pods, at)) for at in (*times_of_changes, self.wall)]

    @property
    def gpu_seconds(self) -> float:
        """Return what the pods' limits held, in seconds of one GPU."""
        return area([(each.at, each.gpus) for each in self.samples], self.wall)

    @property
    def pod_seconds(self) -> float:
        """Return the seconds for which pods held room on nodes, together."""
        return area([(each.at, each.pods) for each in self.samples], self.wall)

    @property
    def most_pods(self) -> int:
        """Return the most pods at the same time."""
        return max((each.pods for each in self.samples), default=0)

    @property
    def at_work(self) -> float:
        """Return the share of the pods' time in which a task ran."""
        return self.work / self.pod_seconds


@dataclass(frozen=True)
class Results:
    """All runs, by name and allocation, and how they were made."""

    about: dict[str, Any]
    traces: dict[str, dict[str, Trace]]


def load(folder: Path) -> Results:
    """Return the results of an earlier run."""
    data = json.loads((folder / RESULTS).read_text(encoding="utf-8"))
    traces = {
        name: {allocation: _trace(trace) for allocation, trace in both.items()}
        for name, both in data["traces"].items()
    }
    return Results(data["about"], traces)


def write(folder: Path, results: Results) -> None:
    """Write the results."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(asdict(results), separators=(",", ":")) + "\n"
    (folder / RESULTS).write_text(text, encoding="utf-8")


def _trace(data: dict[str, Any]) -> Trace:
    lists = {
        "demand": [Open(*each) for each in data["demand"]],
        "samples": [Sample(*each) for each in data["samples"]],
    }
    return Trace(**{**data, **lists})


# Curves


def area(steps: Steps, until: float) -> float:
    """Return the integral of a function that keeps each value from its time to the next one's."""
    ends = [*(at for at, _ in steps), until][1:]
    return sum(
        value * max(min(end, until) - at, 0.0) for (at, value), end in zip(steps, ends, strict=True)
    )


def held(pod: Body) -> Held | None:
    """Return what a pod holds on its node; None before it has one, and after its end."""
    phase = pod.get("status", {}).get("phase")
    if "nodeName" not in pod["spec"] or phase in ("Succeeded", "Failed"):
        return None
    resources = [each.get("resources", {}) for each in pod["spec"]["containers"]]
    return Held(
        sum(processors(each.get("requests", {}).get("cpu", "0")) for each in resources),
        sum(int(each.get("limits", {}).get(GPU, 0)) for each in resources),
    )


def processors(quantity: str) -> float:
    """Return processors that Kubernetes writes as "50m" or "2"."""
    scale = _UNITS.get(quantity[-1:])
    return float(quantity[:-1]) * scale if scale else float(quantity)


def samples(changes: Iterable[tuple[float, str, Held | None]], begin: float) -> list[Sample]:
    """Return the pods over time from their changes, in order: time, name, and what it holds."""
    there: dict[str, Held] = {}
    found = [Sample(0.0, 0, 0, 0.0, 0)]
    for at, name, holds in changes:
        if holds is None:
            there.pop(name, None)
        else:
            there[name] = holds
        sample = _sample(max(round(at - begin, 3), 0.0), there.values())
        if sample[1:] != found[-1][1:]:
            found.append(sample)
    return found


def _sample(at: float, pods: Iterable[Held]) -> Sample:
    there = list(pods)
    return Sample(
        at,
        len(there),
        sum(pod.gpus > 0 for pod in there),
        round(sum(pod.processors for pod in there), 6),
        sum(pod.gpus for pod in there),
    )


def demand(events: Iterable[tuple[str, float, int]]) -> tuple[float, float, list[Open]]:
    """Return when a program began, how long it took, and its open tasks, from what it printed."""
    listed = list(events)
    begin = next(at for name, at, _ in listed if name == "begin")
    end = next(at for name, at, _ in listed if name == "end")
    opened = [Open(round(at - begin, 3), number) for name, at, number in listed if name == "open"]
    return begin, round(end - begin, 3), opened


# The table


def text(found: Results) -> str:
    """Return the table of the runs, and how they were made."""
    head = (
        "run, allocation",
        "wall time",
        "bound",
        "most pods",
        "processor-seconds",
        "GPU-seconds",
        "pods at work",
    )
    rows = [row for name in TITLES if name in found.traces for row in _rows(name, found)]
    return "\n\n".join([report.table(head, rows), _reading(found), report.origin(found.about)])


def _rows(name: str, found: Results) -> list[tuple[str, ...]]:
    both = found.traces[name]
    dynamic, static = both[DYNAMIC], both[STATIC]
    ratios = (
        f"{TITLES[name]}, dynamic / static",
        times(dynamic.wall / static.wall),
        "",
        "",
        times(dynamic.processor_seconds / static.processor_seconds),
        times(dynamic.gpu_seconds / static.gpu_seconds) if static.gpu_seconds else "",
        "",
    )
    return [*(_row(f"{TITLES[name]}, {each}", both[each]) for each in (DYNAMIC, STATIC)), ratios]


def _row(title: str, trace: Trace) -> tuple[str, ...]:
    return (
        title,
        in_words(trace.wall, "s"),
        in_words(trace.bound, "s"),
        str(trace.most_pods),
        f"{trace.processor_seconds:.1f}",
        f"{trace.gpu_seconds:.0f}" if trace.gpu_seconds else "",
        f"{100 * trace.at_work:.0f} %",
    )


def _reading(found: Results) -> str:
    traces = [trace for both in found.traces.values() for trace in both.values()]
    loads = ", ".join(f"{each.load_before:g}" for each in traces)
    shares = ", ".join(f"{100 * each.in_use:.0f} %" for each in traces)
    return (
        f"One round. The bound is the time of the longest tasks, one of each wave. A worker "
        f"requests {found.about['cpu_request']:g} of a processor. "
        f'"Pods at work" is the time in which tasks ran, divided by the pods\' time on their '
        f"nodes. Kubernetes {found.about['kubernetes']}, {found.about['nodes']} nodes. Load before "
        f"the runs: {loads}. Other programs used {shares} of the processors' time in a moment "
        "before them."
    )
