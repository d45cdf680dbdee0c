"""The budgets of the design and whether a run keeps them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from benchmarks import latency, overhead, pipes, startup, throughput
from benchmarks.model import BASELINE, Run
from benchmarks.samples import in_words, ratio, summary, times


@dataclass(frozen=True)
class Budget:
    """A bound on a metric of `contender`: on its ratio to `against`, or on its value in `unit`.

    With a unit it is the value that counts. The bound is the greatest value allowed; with
    `at_least`, the least.
    """

    what: str
    measure: str
    case: str
    metric: str
    bound: float
    at_least: bool = False
    contender: str = "fiber"
    against: str = BASELINE
    unit: str = ""

    def in_words(self) -> str:
        """The bound with its unit."""
        bound = in_words(self.bound, self.unit) if self.unit else f"{self.bound:g}x"
        return f"{'≥' if self.at_least else '≤'} {bound}"


@dataclass(frozen=True)
class Verdict:
    """A budget and what was measured; `kept` is None if nothing was."""

    budget: Budget
    kept: bool | None
    measured: str
    verdict: str


def judge(budget: Budget, runs: Mapping[str, Run]) -> Verdict:
    """Compare one budget with the run of its measure."""
    run = runs.get(budget.measure)
    if not run:
        return Verdict(budget, None, "—", "not measured")
    value = _value(budget, run)
    floor = _floor(budget, run)
    if value is None and floor and floor >= budget.bound:
        return Verdict(budget, True, f"> {times(floor)}", "met")
    if value is None:
        why = run.failures.get(budget.case, {}).get(budget.contender)
        return Verdict(budget, None, "—", f"not measured: {why}" if why else "not measured")
    kept = value >= budget.bound if budget.at_least else value <= budget.bound
    measured = in_words(value, budget.unit) if budget.unit else times(value)
    return Verdict(budget, kept, measured, "met" if kept else f"missed by {_missed(value, budget)}")


def verdicts(runs: Mapping[str, Run]) -> list[Verdict]:
    """All budgets, in the design's order."""
    return [judge(budget, runs) for budget in BUDGETS]


def _value(budget: Budget, run: Run) -> float | None:
    values = run.series(budget.case, budget.contender, budget.metric)
    if budget.unit:
        found = summary(values)
    else:
        found = ratio(values, run.series(budget.case, budget.against, budget.metric))
    return found.median if found else None


def _floor(budget: Budget, run: Run) -> float | None:
    """The least ratio to Fiber of a rival that was stopped because it was too slow."""
    after = run.unfinished.get(budget.case, {}).get(budget.contender)
    against = summary(run.series(budget.case, budget.against, budget.metric))
    return after / against.median if budget.against == "fiber" and after and against else None


def _missed(value: float, budget: Budget) -> str:
    """By how much of the bound: at least 0.1 %, since a miss of 0 % would read like none."""
    percent = max(0.1, abs(value / budget.bound - 1) * 100)
    return f"{percent:,.1f} %" if percent < 100 else f"{percent:,.0f} %"


def _pool() -> Iterator[Budget]:
    case, rate = "map, chunksize 1", throughput.RATE.name
    yield Budget("no-op tasks, chunksize 1", "throughput", case, rate, 20, at_least=True)
    case = "map, default chunks"
    yield Budget("no-op tasks, default chunks", "throughput", case, rate, 1, at_least=True)
    for metric in (latency.P50, latency.P95):
        yield Budget(
            f"latency of one apply, {metric.label}", "latency", latency.NAME, metric.name, 0.7
        )
    for chunks in overhead.CHUNKS:
        for duration in overhead.DURATIONS:
            case = overhead.case_name(duration, chunks)
            bound = (
                {0.001: 0.98, 0.0001: 0.8}.get(duration, 1.01) if chunks == "chunksize 1" else 1.01
            )
            yield Budget(f"overhead: {case}", "overhead", case, overhead.TIME.name, bound)
    case = overhead.case_name(0.001, "chunksize 1")
    for peer, label, bound in (("ipyparallel", "ipyparallel", 8), ("spark", "Spark", 14)):
        what = f"overhead: {case}, {label}'s time against Fiber's"
        yield Budget(
            what,
            "overhead",
            case,
            overhead.TIME.name,
            bound,
            at_least=True,
            contender=peer,
            against="fiber",
        )
    case = throughput.LONG_NAME
    yield Budget(
        "one 1 s task among 10,000 no-ops", "throughput", case, throughput.TIME.name, 1.03, unit="s"
    )


def _data() -> Iterator[Budget]:
    for case in throughput.ARRAY_KINDS:
        yield Budget(case, "throughput", case, throughput.TIME.name, 0.3)
    for (name, _, _), bound in zip(pipes.MESSAGES, (0.95, 0.9, 1.0, 0.4, 0.25), strict=True):
        yield Budget(f"Pipe round trip, {name}", "pipes", name, pipes.ROUND_TRIP.name, bound)
    for count in (8, 32):
        case = pipes.environments(count)
        yield Budget(f"vector step, {case}", "pipes", case, pipes.STEP.name, 1.0)


def _loopback() -> Iterator[Budget]:
    for chunks in overhead.CHUNKS:
        case = overhead.case_name(0.001, chunks)
        what = f"loopback: {case}"
        yield Budget(what, "overhead", case, overhead.TIME.name, 1.02, contender="fiber-loopback")
    case, what = "map, chunksize 1", "loopback: no-op tasks, chunksize 1"
    yield Budget(
        what, "throughput", case, throughput.RATE.name, 5, at_least=True, contender="fiber-loopback"
    )


def _start() -> Iterator[Budget]:
    case = startup.workers(1024)
    yield Budget("1,024 local workers, started", "startup", case, startup.START.name, 10, unit="s")
    yield Budget("1,024 local workers, memory", "startup", case, startup.MEMORY.name, 6e9, unit="B")
    yield Budget("import fiber", "startup", startup.IMPORT_NAME, startup.IMPORT.name, 1.3)


BUDGETS = (*_pool(), *_data(), *_loopback(), *_start())
