"""Budgets of the design, and whether a run keeps them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks import (
    agents,
    coldstart,
    endings,
    executors,
    kubernetes_start,
    large_messages,
    latency,
    overhead,
    parallel_loops,
    pipes,
    sharing,
    startup,
    throughput,
    vector,
    workers,
)
from benchmarks.model import BASELINE, Metric, Run
from benchmarks.samples import in_words, ratio, summary, times


@dataclass(frozen=True)
class Budget:
    """Bound on a metric of `contender`: on its ratio to `against`, or on its value in `unit`.

    With a unit the value counts. With `to_case` the ratio is to the contender's own value in that
    case. The bound is the greatest allowed value; with `at_least`, the least.
    """

    what: str
    measure: str
    case: str
    metric: str
    bound: float
    at_least: bool = False
    contender: str = "fiber"
    against: str = BASELINE
    to_case: str = ""
    unit: str = ""

    @property
    def divisor(self) -> tuple[str, str]:
        """Case and contender whose value a ratio is to."""
        return (self.to_case, self.contender) if self.to_case else (self.case, self.against)

    def in_words(self) -> str:
        """Bound with its unit."""
        bound = in_words(self.bound, self.unit) if self.unit else f"{self.bound:g}x"
        return f"{'≥' if self.at_least else '≤'} {bound}"


@dataclass(frozen=True)
class Verdict:
    """Budget and its measured value; `kept` is None if it was not measured."""

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


def verdicts(runs: Mapping[str, Run], among: Sequence[Budget] | None = None) -> list[Verdict]:
    """Compare all budgets of `make bench`, or these, in the design's order."""
    return [judge(budget, runs) for budget in (BUDGETS if among is None else among)]


def of(measure: str, case: str, metric: str, contender: str) -> list[Budget]:
    """Return the budgets on one value of a contender."""
    keys = (measure, case, metric, contender)
    return [b for b in (*BUDGETS, *ON_PODS) if (b.measure, b.case, b.metric, b.contender) == keys]


def _value(budget: Budget, run: Run) -> float | None:
    values = run.series(budget.case, budget.contender, budget.metric)
    if budget.unit:
        found = summary(values)
    else:
        found = ratio(values, run.series(*budget.divisor, budget.metric))
    return found.median if found else None


def _floor(budget: Budget, run: Run) -> float | None:
    """Return the least ratio to Fiber of a rival that was stopped because it was too slow."""
    after = run.unfinished.get(budget.case, {}).get(budget.contender)
    against = summary(run.series(budget.case, budget.against, budget.metric))
    return after / against.median if budget.against == "fiber" and after and against else None


def _missed(value: float, budget: Budget) -> str:
    """Return by how much of the bound the value misses it: at least 0.1 %, since 0 % would read
    like a hit."""
    percent = max(0.1, abs(value / budget.bound - 1) * 100)
    return f"{percent:,.1f} %" if percent < 100 else f"{percent:,.0f} %"


def _pool() -> Iterator[Budget]:
    rate = throughput.RATE.name
    for case, bound in (("map, chunksize 1", 50), ("map, default chunks", 1.1)):
        what = f"no-op tasks, {case.removeprefix('map, ')}"
        yield Budget(what, "throughput", case, rate, bound, at_least=True)
    for case in (latency.NAME, latency.OF_MAIN):
        for metric in (latency.P50, latency.P95):
            what = f"latency of one {case}, {metric.label}"
            yield Budget(what, "latency", case, metric.name, 0.5)
    yield from _overhead()
    for case in throughput.ARRAY_KINDS:
        yield Budget(case, "throughput", case, throughput.TIME.name, 0.25)
    case, what = throughput.LONG_NAME, "one 1 s task among 10,000 no-ops"
    yield Budget(what, "throughput", case, throughput.TIME.name, 1.03, unit="s")


def _watched() -> Iterator[Budget]:
    """Return the budgets of a program whose progress, page, timeline and logs are all on."""
    ours: Any = {"contender": "fiber-watched", "against": "fiber"}
    case = "map, chunksize 1"
    what = "everything shown, to nothing shown: no-op tasks, chunksize 1"
    yield Budget(what, "throughput", case, throughput.RATE.name, 0.98, at_least=True, **ours)
    what = "everything shown, to nothing shown: latency of one apply, p50"
    yield Budget(what, "latency", latency.NAME, latency.P50.name, 1.02, **ours)
    case = overhead.case_name(0.001, "chunksize 1")
    what = f"everything shown, to nothing shown: overhead: {case}"
    yield Budget(what, "overhead", case, overhead.TIME.name, 1.02, **ours)


def _executors() -> Iterator[Budget]:
    """Return the budgets of executors and parallel loops, against other executors."""

    def budget(what: str, measure: str, case: str, bound: float, **rivals: str) -> Budget:
        return Budget(what, measure, case, executors.RATE.name, bound, at_least=True, **rivals)

    ours = "fiber-executor"
    for case in (executors.SUBMIT, executors.MAP, executors.IN_CHUNKS):
        for against in ("concurrent.futures", "loky"):
            what = f"fiber.Executor: {case}"
            yield budget(what, "executors", case, 5, contender=ours, against=against)
    ours = "fiber-joblib"
    for kind in parallel_loops.TASKS:
        # If tasks sleep for longer than all else takes, no time can be saved.
        bound = 0.98 if kind == parallel_loops.LONGER else 1.0
        for size in parallel_loops.BATCH_SIZES:
            case = parallel_loops.case_name(kind, size)
            what = f"joblib: {case}"
            yield budget(what, "parallel_loops", case, bound, contender=ours, against="joblib")


def _overhead() -> Iterator[Budget]:
    metric = overhead.TIME.name
    for chunks in overhead.CHUNKS:
        for duration in overhead.DURATIONS:
            case = overhead.case_name(duration, chunks)
            tight = {0.001: 0.95, 0.0001: 0.8} if chunks == "chunksize 1" else {}
            yield Budget(f"overhead: {case}", "overhead", case, metric, tight.get(duration, 1.01))
    case = overhead.case_name(0.001, "chunksize 1")
    for peer, label, bound in (("ipyparallel", "ipyparallel", 8), ("spark", "Spark", 14)):
        what = f"overhead: {case}, {label}'s time against Fiber's"
        yield Budget(
            what,
            "overhead",
            case,
            metric,
            bound,
            at_least=True,
            contender=peer,
            against="fiber",
        )


def _pipes() -> Iterator[Budget]:
    for (name, _, _), bound in zip(pipes.MESSAGES, (0.95, 0.9, 1.0, 0.3, 0.2), strict=True):
        for case in (name, *(pipes.placed(name, place) for place in pipes.PLACES)):
            yield Budget(f"Pipe round trip, {case}", "pipes", case, pipes.ROUND_TRIP.name, bound)
    for count in (8, 32):
        case = pipes.environments(count)
        yield Budget(f"vector step, {case}", "pipes", case, pipes.STEP.name, 0.8)


def _vector() -> Iterator[Budget]:
    """Return the budgets of vector environments."""

    def budget(what: str, case: str, bound: float, **more: Any) -> Budget:
        rate = vector.RATE.name
        return Budget(f"vector: {what}", "vector", case, rate, bound, at_least=True, **more)

    case = vector.cart_poles(64)
    yield budget(case, case, 3, against=vector.BASELINE)
    yield budget(case, case, 1, against="pufferlib")
    what, waiting = "uneven steps, first ready to waiting for all", vector.uneven(64)
    yield budget(what, vector.uneven(64, first_ready=True), 1.5, to_case=waiting)
    case = vector.pixels(64)
    ours = {"contender": "fiber-loopback", "against": "fiber"}
    yield budget(f"loopback to local, {case}", case, 0.4, **ours)


def _sharing() -> Iterator[Budget]:
    bounds = {
        sharing.ROUND_TRIP: 1.0,
        sharing.MANAGER: 1.0,
        sharing.LOCK: 3.0,
        sharing.VALUE: 3.0,
        **{sharing.array(megabytes): 1.05 for megabytes in sharing.MEGABYTES},
    }
    for case, bound in bounds.items():
        yield Budget(case, "sharing", case, sharing.CALL.name, bound)
    case, rate, of_bytes = sharing.STREAM, sharing.RATE, sharing.BYTES
    yield Budget(case, "sharing", case, rate.name, 1.0, at_least=True)
    two = sharing.TWO_PRODUCERS
    yield Budget(two, "sharing", two, of_bytes.name, 1.0, at_least=True)
    yield from _sharing_on_loopback()


def _sharing_on_loopback() -> Iterator[Budget]:
    def budget(
        case: str, metric: Metric, bound: float, *, at_least: bool = False, unit: str = ""
    ) -> Budget:
        return Budget(
            f"loopback: {case}",
            "sharing",
            case,
            metric.name,
            bound,
            at_least=at_least,
            contender="fiber-loopback",
            unit=unit,
        )

    rate, of_bytes, call = sharing.RATE, sharing.BYTES, sharing.CALL
    yield budget(sharing.STREAM, rate, 50_000, at_least=True, unit=rate.unit)
    yield budget(sharing.STREAM_OF_ARRAYS, of_bytes, 400e6, at_least=True, unit=of_bytes.unit)
    yield budget(sharing.TWO_PRODUCERS, of_bytes, 0.5, at_least=True)
    yield budget(sharing.MANAGER, call, 0.001, unit=call.unit)
    yield budget(sharing.BARRIERS_OF[5], call, 0.005, unit=call.unit)


def _start() -> Iterator[Budget]:
    for count, metric, what in (
        (1, coldstart.READY, "first worker ready"),
        (5, coldstart.READY, "five workers ready"),
        (5, coldstart.MAP, "first map of five workers"),
    ):
        yield Budget(
            f"from a fresh interpreter: {what}",
            "coldstart",
            coldstart.case_name(count),
            metric.name,
            1.0,
            against="forkserver",
        )
    yield Budget("import fiber", "startup", startup.IMPORT_NAME, startup.IMPORT.name, 0.5)
    case = startup.workers(1024)
    for metric, bound in ((startup.START, 4), (startup.MEMORY, 3.5e9)):
        label = f"1,024 local workers, {metric.label}"
        yield Budget(label, "startup", case, metric.name, bound, unit=metric.unit)


def _remote() -> Iterator[Budget]:
    def budget(
        what: str,
        measure: str,
        case: str,
        metric: Metric,
        bound: float,
        *,
        at_least: bool = False,
        against: str = BASELINE,
    ) -> Budget:
        return Budget(
            f"loopback: {what}",
            measure,
            case,
            metric.name,
            bound,
            at_least=at_least,
            contender="fiber-loopback",
            against=against,
        )

    for case in (latency.NAME, latency.OF_MAIN):
        yield budget(f"latency of one {case}, p50", "latency", case, latency.P50, 2)
    what = "latency of one apply, p50, to Ray's"
    yield budget(what, "latency", latency.NAME, latency.P50, 0.25, against="ray")
    rate = throughput.RATE
    for case in ("apply_async", f"apply_async, {throughput.OF_MAIN}"):
        yield budget(f"no-ops: {case}", "throughput", case, rate, 1, at_least=True)
    yield from _kinds_of_functions("loopback: ", "fiber-loopback", "fiber-executor-loopback")
    what = "no-op tasks, chunksize 1"
    yield budget(what, "throughput", "map, chunksize 1", rate, 20, at_least=True)
    for case in throughput.ARRAY_KINDS:
        yield budget(case, "throughput", case, throughput.TIME, 0.6)
    for chunks in overhead.CHUNKS:
        case = overhead.case_name(0.001, chunks)
        yield budget(case, "overhead", case, overhead.TIME, 1.02)


def _kinds_of_functions(prefix: str, pool: str, executor: str) -> Iterator[Budget]:
    """Return the bounds of calls of other functions, to calls of an importable one."""
    for kind in throughput.OTHER_KINDS:
        what = f"{prefix}latency of one apply, {kind}, p50, to an importable one"
        metric, case = latency.P50.name, f"apply, {kind}"
        ours: Any = {"contender": pool}
        yield Budget(what, "latency", case, metric, 1.2, to_case=latency.NAME, **ours)
        what = f"{prefix}no-ops: apply_async, {kind}, to an importable one"
        metric, case = throughput.RATE.name, f"apply_async, {kind}"
        ours |= {"to_case": "apply_async", "at_least": True}
        yield Budget(what, "throughput", case, metric, 0.83, **ours)
        what = f"{prefix}no-ops: submit, {kind}, to an importable one"
        metric, case = executors.RATE.name, executors.SUBMIT_OF[kind]
        ours |= {"to_case": executors.SUBMIT, "contender": executor}
        yield Budget(what, "executors", case, metric, 0.83, **ours)


def _endings() -> Iterator[Budget]:
    """Return the bounds that users are promised; a test would fail on a busy machine."""
    bounds = {
        endings.TERMINATE: 1.0,
        endings.KILLED_PROCESS: 0.5,
        endings.OVER_LIMIT: 1.0,
        endings.INTERRUPT: 2.0,
        endings.KILLED_PROGRAM: 2.0,
    }
    for contender, where in (("fiber", ""), ("fiber-loopback", "loopback: ")):
        for case, bound in bounds.items():
            what, time = f"{where}{case}, time to end", endings.TIME.name
            yield Budget(what, "endings", case, time, bound, contender=contender, unit="s")


def _large(contender: str, where: str) -> Iterator[Budget]:
    """Return the bounds of large messages: they keep up with a fast network, and small tasks hardly
    wait."""
    for case in large_messages.CASES:
        for metric, bound, at_least in (
            (large_messages.RATE, 300e6, True),
            (large_messages.BESIDE, 0.02, False),
        ):
            yield Budget(
                f"{where}{case}, {metric.label}",
                "large_messages",
                case,
                metric.name,
                bound,
                at_least=at_least,
                contender=contender,
                unit=metric.unit,
            )


def _many() -> Iterator[Budget]:
    case = agents.agents(1024)
    what = "1,024 remote agents"
    for metric, bound in ((agents.JOINED, 3), (agents.MEMORY, 100e3)):
        label = f"{what}, {metric.label}"
        yield Budget(label, "agents", case, metric.name, bound, unit=metric.unit)
    label = f"{what}, a map of 100,000 no-ops"
    yield Budget(label, "agents", case, agents.DEFAULT.name, 5, at_least=True)
    label = "the master's processor time to start a worker, in a pool of 5,000"
    few, case = workers.workers(10), workers.workers(5000)
    yield Budget(label, "workers", case, workers.COST.name, 1.1, to_case=few)


def _on_pods() -> Iterator[Budget]:
    def budget(
        what: str, measure: str, case: str, metric: Metric, bound: float, **more: Any
    ) -> Budget:
        pods = {"contender": "fiber-kubernetes", **more}
        return Budget(what, measure, case, metric.name, bound, **pods)

    for chunks in overhead.CHUNKS:
        for duration in (each for each in overhead.DURATIONS if each >= 0.001):
            case = overhead.case_name(duration, chunks)
            yield budget(f"overhead: {case}", "overhead", case, overhead.TIME, 1.02)
    case = "map, chunksize 1"
    yield budget("no-op tasks, chunksize 1", "throughput", case, throughput.RATE, 10, at_least=True)
    what = "latency of one apply, p50"
    yield budget(what, "latency", latency.NAME, latency.P50, 3)
    yield from _kinds_of_functions("", "fiber-kubernetes", "fiber-executor-kubernetes")
    for case in throughput.ARRAY_KINDS:
        yield budget(case, "throughput", case, throughput.TIME, 1)
    # As for processes of one machine: slow pods delay no other pod.
    case, waiting = vector.uneven(64, first_ready=True), vector.uneven(64)
    what = "uneven steps of 64 environments, first ready to waiting for all"
    yield budget(what, "vector", case, vector.RATE, 1.5, at_least=True, to_case=waiting)
    case = kubernetes_start.WARM
    yield budget(
        "a pool on warm pods", "kubernetes_start", case, kubernetes_start.TIME, 0.3, unit="s"
    )


def _relayed() -> Iterator[Budget]:
    ours: Any = {"contender": "fiber-relay"}
    case = overhead.case_name(0.001, "chunksize 1")
    what = f"relay: overhead: {case}"
    yield Budget(what, "overhead", case, overhead.TIME.name, 1.03, **ours)
    case = "map, chunksize 1"
    what = "relay: no-op tasks, chunksize 1"
    yield Budget(what, "throughput", case, throughput.RATE.name, 10, at_least=True, **ours)
    what = "relay: latency of one apply, p50"
    yield Budget(what, "latency", latency.NAME, latency.P50.name, 0.002, unit="s", **ours)
    for case in ("1 MB arguments", "1 MB results"):  # 100 MB at 50 MB/s
        what = f"relay: {case}, 100 of them"
        yield Budget(what, "throughput", case, throughput.TIME.name, 2.0, unit="s", **ours)


BUDGETS = (
    *_pool(),
    *_watched(),
    *_executors(),
    *_pipes(),
    *_sharing(),
    *_vector(),
    *_start(),
    *_remote(),
    *_many(),
    *_endings(),
    *_large("fiber-loopback", "loopback: "),
)
ON_PODS = (*_on_pods(), *_relayed(), *_large("fiber-kubernetes", ""))
