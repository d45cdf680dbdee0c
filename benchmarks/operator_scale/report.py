"""Page, picture and file with every sample, from the results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from benchmarks.operator_scale import picture, results
from benchmarks.operator_scale.cases import (
    BY_DEFAULT,
    CASES,
    DEFAULT_RATE,
    FIBER,
    REPLICA_SET,
    SUBJECTS,
    Case,
    Subject,
)
from benchmarks.operator_scale.counters import STATUS_WRITES
from benchmarks.operator_scale.results import MEGA, STEPS, OperatorUse, Result, Trial
from benchmarks.report import ratio_in_words, table
from benchmarks.samples import Summary, in_words, summary, times

RESULTS = "operator.json"
PAGE = "operator.md"
PICTURE = "operator.png"
NOTES = "operator-notes.md"

MEMORY_CASE = "1000"
MOST_TIMES = {REPLICA_SET.name: 1.2, BY_DEFAULT.name: 1.0}
"""Ratio of the times until settled."""
MOST_MEMORY = 150 * MEGA

Words = Callable[[float], str]

_TITLE = "The operator at thousands of pods"
_FEW = 0.005
"""Requests per pod; smaller numbers are not shown."""


@dataclass(frozen=True)
class Line:
    """Budget and its measured value."""

    what: str
    measured: str
    bound: str
    verdict: str


def write(folder: Path, known: Mapping[str, Result]) -> None:
    """Write all three, with the cases in their order."""
    folder.mkdir(parents=True, exist_ok=True)
    ordered = {name: known[name] for name in CASES if name in known}
    results.save(folder / RESULTS, ordered)
    picture.draw(ordered, folder / PICTURE)
    text = page(ordered, notes=(folder / NOTES).exists())
    (folder / PAGE).write_text(text, encoding="utf-8")


def budgets(known: Mapping[str, Result]) -> list[Line]:
    """Return the operator's budgets of the design: of each case, and of its memory in one."""
    in_time = [
        _settled(case, other, known.get(name, Result({})))
        for other in (REPLICA_SET, BY_DEFAULT)
        for name, case in CASES.items()
        if other is REPLICA_SET or case.by_default
    ]
    memory = _line(
        f"the operator's memory with {CASES[MEMORY_CASE].title}, at its peak",
        known.get(MEMORY_CASE, Result({})).peak(),
        MOST_MEMORY,
        lambda size: in_words(size, "B"),
    )
    return [*in_time, memory]


def _settled(case: Case, other: Subject, result: Result) -> Line:
    ratio = result.ratio(FIBER.name, other.name, "settled")
    rate = "1,000" if other is REPLICA_SET else f"Kubernetes' default of {DEFAULT_RATE}"
    what = f"{case.title} settled, against ReplicaSets of as many at {rate} calls a second"
    return _line(what, ratio.median if ratio else None, MOST_TIMES[other.name], times)


def _line(what: str, value: float | None, bound: float, words: Words) -> Line:
    if value is None:
        return Line(what, "—", f"< {words(bound)}", "not measured")
    verdict = "met" if value < bound else f"missed by {(value / bound - 1) * 100:,.1f} %"
    return Line(what, words(value), f"< {words(bound)}", verdict)


def page(known: Mapping[str, Result], *, notes: bool) -> str:
    """Return the page of these results."""
    parts = [
        "<!-- Written by benchmarks/operator_scale from operator.json; changes made by hand are "
        "lost. -->",
        f"# {_TITLE}",
        _ABOUT,
        f"Reasons, and what was tried: [notes]({NOTES})." if notes else "",
        f"![{_TITLE}]({PICTURE})",
        "## Budgets",
        table(
            ("what", "measured", "budget", "verdict"),
            [(b.what, b.measured, b.bound, b.verdict) for b in budgets(known)],
        ),
        "## Time",
        _TIME,
        table(
            ("pods", "until", "FiberPool", "ReplicaSet", "ratio", BY_DEFAULT.label, "ratio"),
            _steps(known),
        ),
        "## What the operator needs",
        _NEEDS,
        table(
            ("pods", "memory: before", "peak", "after", "CPU until settled", "a pod", "in all"),
            _uses(known),
        ),
        "## Its requests until settled",
        "All requests of the operator to the API server, by verb and resource: pods made, pools "
        "read, statuses written. In the median trial, and for each pod.",
        table(("pods", "request", "number", "for each pod"), _requests(known)),
        "## Writes at the API server until settled",
        "By all writers: the maker of the pods, the scheduler, the pretended nodes; without "
        "heartbeats. For each pod, in the median trial.",
        table(("pods", "maker", "all", "the most frequent"), _writes(known)),
        "## Made on",
        *_origins(known),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


_ABOUT = (
    "One FiberPool of 1,000 pods and one of 5,000, and 100 of 10 pods each, beside ReplicaSets of "
    "the same sizes with the same pod template, on nodes that only pretend to run pods (KWOK). "
    "The API server, etcd, the scheduler and the operator are real, and all of them share the "
    "machine's processors, so the ratio counts. `make bench-operator` writes this page. "
    "How the operator serves one namespace while another floods it: [floods](operator-floods.md)."
)
_TIME = (
    "A round measures both, one after the other, in an order that alternates. Each has a separate "
    "namespace, and the next one begins when it is gone. The tables show medians of the rounds; "
    "the ratio is taken within each round. ReplicaSets are measured with a controller that may "
    "make 1,000 calls a second, so that its work counts, and once with Kubernetes' default of "
    f"{DEFAULT_RATE}. An object is settled when its own status says so: the status is about this "
    "spec, and as many pods are ready as are wanted. Pods are counted ten times a second. "
    "Kubernetes' garbage collector removes a deleted object's pods, at the same rate of calls."
)
_NEEDS = (
    "From the operator's own metrics: resident memory, read twice a second, and processor time. "
    "Medians, but the peak is the greatest of all rounds. Before: when the trial begins; after: "
    "when all of its pods are gone. A Python process seldom returns memory, so earlier cases show "
    "in the memory before."
)


def _rows(known: Mapping[str, Result]) -> Iterator[tuple[Case, Result]]:
    return ((CASES[name], result) for name, result in known.items())


def _steps(known: Mapping[str, Result]) -> Iterator[tuple[str, ...]]:
    for case, result in _rows(known):
        title = case.title
        for step, meaning in STEPS.items():
            compared = [
                words
                for other in (REPLICA_SET, BY_DEFAULT)
                for words in (
                    _seconds(result.step(other.name, step)),
                    ratio_in_words(result.ratio(FIBER.name, other.name, step)),
                )
            ]
            yield title, meaning, _seconds(result.step(FIBER.name, step)), *compared
            title = ""


def _seconds(found: Summary | None) -> str:
    return f"{found.median:.1f} s" if found else "—"


def _uses(known: Mapping[str, Result]) -> Iterator[tuple[str, ...]]:
    for case, result in _rows(known):
        uses = [trial.operator for trial in result.of(FIBER.name) if trial.operator]
        peak = result.peak()
        if peak is None:
            continue
        busy = _median(use.seconds_until_settled for use in uses)
        yield (
            case.title,
            in_words(_median(use.memory_before for use in uses), "B"),
            in_words(peak, "B"),
            in_words(_median(use.memory_after for use in uses), "B"),
            f"{busy:.1f} s",
            in_words(busy / case.pods, "s"),
            f"{_median(use.seconds for use in uses):.1f} s",
        )


def _requests(known: Mapping[str, Result]) -> Iterator[tuple[str, ...]]:
    for case, result in _rows(known):
        use = _middle(result)
        if use is None:
            continue
        requests = use.requests_until_settled
        shown = {
            name: number
            for name, number in requests.items()
            if number / case.pods >= _FEW or name == STATUS_WRITES
        }
        rest = sum(requests.values()) - sum(shown.values())
        rows = {"all": sum(requests.values()), **shown}
        title = case.title
        for name, number in {**rows, **({"others": rest} if rest else {})}.items():
            yield title, name, f"{number:,.0f}", f"{number / case.pods:.3f}"
            title = ""


def _writes(known: Mapping[str, Result]) -> Iterator[tuple[str, ...]]:
    for case, result in _rows(known):
        title = case.title
        for subject in SUBJECTS:
            trial = _middle_trial(result.of(subject.name))
            if trial is None:
                continue
            most = list(trial.writes.items())[:6]
            said = ", ".join(f"{name} {number / case.pods:.2f}" for name, number in most)
            yield title, subject.label, f"{sum(trial.writes.values()) / case.pods:.2f}", said
            title = ""


def _median(values: Iterable[float]) -> float:
    found = summary(list(values))
    assert found is not None, "there is a value for each trial"
    return found.median


def _middle_trial(trials: list[Trial]) -> Trial | None:
    ordered = sorted(trials, key=lambda trial: trial.steps["settled"])
    return ordered[len(ordered) // 2] if ordered else None


def _middle(result: Result) -> OperatorUse | None:
    trial = _middle_trial(result.of(FIBER.name))
    return trial.operator if trial else None


def _origins(known: Mapping[str, Result]) -> Iterator[str]:
    """Return where and when; cases that were measured by the same command share a table."""
    made: dict[str, list[str]] = {}
    for case, result in _rows(known):
        about = {name: value for name, value in result.about.items() if name != "rounds"}
        rounds = result.about["rounds"]
        said = f"{case.title} ({rounds} round{'s' if rounds > 1 else ''})"
        made.setdefault(table(("", ""), _origin(about)), []).append(said)
    for text, cases in made.items():
        yield f"{'; '.join(cases)}:"
        yield text


def _origin(about: Mapping[str, object]) -> list[tuple[str, str]]:
    return [
        ("machine", f"{about['cores']} cores ({about['processor']}), {about['memory']} of memory"),
        ("system", f"{about['system']}"),
        ("Kubernetes", f"{about['kubernetes']}, {about['nodes']} pretended nodes"),
        ("operator", f"{about['operator']}"),
        ("Python that measures", f"{about['python']}"),
        ("date", f"{about['date']}"),
        ("load before", f"{about['load']} (1 minute average of running processes)"),
        ("command", f"`{about['command']}`"),
    ]
