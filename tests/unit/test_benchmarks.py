"""The benchmarks' arithmetic, budgets and pages."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks import (  # noqa: E402
    budgets,
    coldstart,
    executors,
    kubernetes_cluster,
    kubernetes_report,
    latency,
    machine,
    overhead,
    report,
    samples,
    vector,
    workers,
)
from benchmarks.contenders import (  # noqa: E402
    ALL,
    BY_NAME,
    EXECUTOR_ON_PODS,
    ON_PODS,
    RELAYED,
)
from benchmarks.model import Run  # noqa: E402
from benchmarks.suite import MEASURES  # noqa: E402

ABOUT = {
    "date": "2026-01-01 00:00 UTC",
    "command": "python benchmarks/run.py",
    "rounds": 3,
    "size": 1.0,
    "cores": 2,
    "processor": "a processor",
    "memory": "8.00 GB",
    "load": 0.0,
    "system": "Linux 6",
    "python": "3.11.0",
    "versions": {"numpy": "2.0"},
    "skipped": {"ray": "ray"},
}
BASELINE = BY_NAME["multiprocessing"]
SHORT = overhead.case_name(0.001, "chunksize 1")


def a_run(*values: tuple[str, str, dict[str, float]], **fields: Any) -> Run:
    """Return a run of one round with these values: case, contender, metrics."""
    run = Run(dict(ABOUT), **fields)
    for case, contender, sample in values:
        run.add(case, contender, 0, sample)
    return run


# -- Arithmetic


@pytest.mark.parametrize(
    ("ours", "theirs", "found"),
    [
        # The machine was ten times slower in the second round: medians would have the ratio 1.
        ([1.0, 10.0, 1.5], [2.0, 20.0, 1.0], (0.5, 0.5, 1.5, 3)),
        ([4.0], [2.0, 8.0, 8.0], (2.0, 2.0, 2.0, 1)),
        ([None, 4.0], [2.0], None),
    ],
)
def test_a_ratio_is_taken_within_a_round_of_both(
    ours: list[float | None], theirs: list[float | None], found: tuple[Any, ...] | None
) -> None:
    assert samples.ratio(ours, theirs) == (found and samples.Summary(*found))


def test_a_summary_and_a_percentile_are_values_that_occurred() -> None:
    assert samples.summary([3.0, None, 1.0, 2.0]) == samples.Summary(2.0, 1.0, 3.0, 3)
    assert samples.summary([None]) is None
    values = [float(n) for n in range(100, 0, -1)]
    assert [samples.percentile(values, percent) for percent in (50, 95)] == [51.0, 96.0]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (samples.in_words(1.0, "s"), "1.00 s"),
        (samples.in_words(0.00131, "s"), "1.31 ms"),
        (samples.in_words(0.0000842, "s"), "84.2 µs"),
        (samples.in_words(12345.6, "1/s"), "12,346 /s"),
        (samples.in_words(5.2e9, "B"), "5.20 GB"),
        (samples.in_words(312.5e6, "B/s"), "312 MB/s"),
        (samples.times(1.004), "1.004x"),
        (samples.times(0.65), "0.65x"),
        (samples.times(61.2), "61.2x"),
    ],
)
def test_a_number_has_three_digits_and_a_unit(words: str, said: str) -> None:
    assert words == said


@pytest.mark.parametrize(
    ("after", "share"),
    [
        ("cpu  10 5 5 180 0 0 0 0 0 0", 0.1),
        ("cpu  0 0 0 100 100 0 0 0 0 0", 0.0),  # a disk at work is not a processor at work
        ("cpu  0 0 0 150 0 0 0 50 0 0", 0.25),  # the machine's other guests
        ("cpu  50 0 0 150 0 0 0 0 50 0", 0.25),  # a guest's time is in the first number too
        ("cpu  0 0 0 0 0 0 0 0 0 0", 0.0),
    ],
)
def test_the_share_in_use_excludes_idle_time(after: str, share: float) -> None:
    before = "cpu  0 0 0 0 0 0 0 0 0 0\ncpu0 1 2 3"
    assert machine.share_in_use(before, after) == pytest.approx(share)
    assert 0 <= machine.in_use() <= 1


@pytest.mark.parametrize(
    ("tick", "seconds", "counted"), [(0.1, 2.0, 20), (1.0, 1.0, 1)], ids=["many", "one"]
)
def test_the_rate_of_a_vector_excludes_its_first_steps(
    monkeypatch: pytest.MonkeyPatch, tick: float, seconds: float, counted: int
) -> None:
    clock = iter(range(100))
    monkeypatch.setattr(vector, "time", SimpleNamespace(perf_counter=lambda: next(clock) * tick))
    made: list[None] = []
    rate = vector._rate(lambda: made.append(None), 8, seconds)
    assert rate == pytest.approx(8 / tick)
    assert len(made) == counted + (3 if counted > 1 else 1)


def test_a_cold_start_ends_with_its_last_worker_and_its_map() -> None:
    second = 10**9
    stamps = [("worker", 5 * second), ("map", 4 * second), ("worker", 3 * second)]
    assert coldstart.times_from(2 * second, stamps) == {"ready": 3.0, "map": 2.0}


# -- Budgets


def budget_of(measure: str, **fields: object) -> budgets.Budget:
    return next(
        each
        for each in budgets.BUDGETS
        if each.measure == measure and all(getattr(each, k) == v for k, v in fields.items())
    )


OVERHEAD = budget_of("overhead", case=SHORT)
THROUGHPUT = budget_of("throughput", at_least=True)
WORKERS = budget_of("workers")
SPARK = budget_of("overhead", contender="spark")


def overhead_run(fiber: float, baseline: float = 1.0) -> Run:
    run = Run(dict(ABOUT))
    for turn in range(3):
        for duration in overhead.DURATIONS:
            for chunks in overhead.CHUNKS:
                case = overhead.case_name(duration, chunks)
                run.add(case, "fiber", turn, {"time": fiber})
                run.add(case, "multiprocessing", turn, {"time": baseline})
    return run


def too_slow(after: float) -> Run:
    run = overhead_run(2.0)
    run.fail(SPARK.case, "spark", "not finished", after=after)
    return run


def failed() -> Run:
    run = Run(dict(ABOUT))
    run.fail(SHORT, "fiber", "ended with exit status 1")
    return run


@pytest.mark.parametrize(
    ("budget", "run", "kept", "said"),
    [
        (OVERHEAD, overhead_run(0.95), True, "met"),
        (OVERHEAD, overhead_run(1.045), False, "missed by 10.0 %"),
        (OVERHEAD, None, None, "not measured"),
        (OVERHEAD, failed(), None, "not measured: ended with exit status 1"),
        (
            THROUGHPUT,
            a_run(
                (THROUGHPUT.case, THROUGHPUT.contender, {THROUGHPUT.metric: 75.0}),
                (THROUGHPUT.case, "multiprocessing", {THROUGHPUT.metric: 2.0}),
            ),
            False,
            "missed by 25.0 %",
        ),
        (
            WORKERS,
            a_run(
                (workers.workers(10), "fiber", {workers.COST.name: 2e-4}),
                (workers.workers(5000), "fiber", {workers.COST.name: 4.4e-4}),
            ),
            False,
            "missed by 100 %",
        ),
        (SPARK, too_slow(90.0), True, "met"),
        (SPARK, too_slow(20.0), None, "not measured"),
    ],
    ids=[
        "met",
        "missed",
        "not-run",
        "failed",
        "at-least",
        "another-case",
        "rival-too-slow",
        "rival-stopped-early",
    ],
)
def test_a_budget_is_judged(
    budget: budgets.Budget, run: Run | None, kept: bool | None, said: str
) -> None:
    found = budgets.judge(budget, {budget.measure: run} if run else {})
    assert found.kept is kept
    assert found.verdict.startswith(said)


def test_each_budget_is_on_a_case_that_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    # With one processor, no work can be limited to two.
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    measured = {
        (case.measure, case.name, metric.name, contender.name)
        for measure in MEASURES.values()
        for case in measure.cases(1.0)
        for metric in case.metrics
        for contender in ALL
        if case.needs in contender.offers
    }
    for each in budgets.BUDGETS:
        assert (each.measure, each.case, each.metric, each.contender) in measured, each.what
        if not each.unit:
            case, contender = each.divisor
            assert (each.measure, case, each.metric, contender) in measured, each.what
    on_pipes = [each.case for each in budgets.BUDGETS if each.measure == "pipes"]
    assert len(on_pipes) == len(set(on_pipes)) == 5 * 3 + 2


def test_the_budgets_of_the_vector_are_those_of_the_design() -> None:
    assert {
        (each.what, each.contender, each.against, each.to_case, each.bound)
        for each in budgets.BUDGETS
        if each.measure == "vector"
    } == {
        ("vector: 64 CartPoles", "fiber", "async-vector-env", "", 3),
        ("vector: 64 CartPoles", "fiber", "pufferlib", "", 1),
        (
            "vector: uneven steps, first ready to waiting for all",
            "fiber",
            "multiprocessing",
            "64 uneven ones",
            1.5,
        ),
        ("vector: loopback to local, 64 with 84x84x4 bytes", "fiber-loopback", "fiber", "", 0.4),
    }


# -- Pages


LATENCIES = [("fiber-loopback", 3e-4), ("multiprocessing", 1e-4), ("ray", 2e-3)]
SUBMITTED = [("fiber-executor", 60e3), ("concurrent.futures", 10e3), ("loky", 5e3)]


@pytest.mark.parametrize(
    ("measure", "run", "lines"),
    [
        (
            "overhead",
            overhead_run(0.5),
            [
                "| Fiber | 500 ms | 500 ms to 500 ms | 0.50x (0.50x to 0.50x) | ≤ 0.95x | met |",
                "| all | Ray's Pool | skipped, not installed: ray |",
                "2 cores (a processor), 8.00 GB of memory",
            ],
        ),
        ("overhead", failed(), [f"| {SHORT} | Fiber | ended with exit status 1 |"]),
        (
            "latency",
            a_run(*((latency.NAME, name, {"p50": p, "p95": p}) for name, p in LATENCIES)),
            ["| ≤ 2x; ≤ 0.25x Ray's Pool | missed by 50.0 %; met |"],
        ),
        (
            "executors",
            a_run(*((executors.SUBMIT, name, {executors.RATE.name: n}) for name, n in SUBMITTED)),
            [
                "The ratio is to concurrent.futures in the same round",
                "| 60,000 /s | one round | 6.00x | ≥ 5x; ≥ 5x loky | met; met |",
            ],
        ),
        (
            "vector",
            a_run((vector.cart_poles(4096), "fiber", {vector.RATE.name: 1e5})),
            ["|  | AsyncVectorEnv | not run: 4,096 processes |  |  |  |  |"],
        ),
        (
            "latency",
            a_run(in_use=[0.004, 0.02]),
            ["others used 0 %, 2 % of the processors' time: the machine was idle"],
        ),
        (
            "latency",
            a_run(in_use=[0.0, 0.31]),
            ["others used 0 %, 31 % of the processors' time: **the machine was not"],
        ),
    ],
    ids=["ratio", "failure", "two-budgets", "baseline", "not-run", "idle", "busy"],
)
def test_a_page_shows_the_measured_values(measure: str, run: Run, lines: list[str]) -> None:
    page = report.page(measure, run)
    for line in lines:
        assert line in page


def test_a_second_measurement_keeps_the_pages_of_the_first(tmp_path: Path) -> None:
    # These tests draw no picture, because matplotlib never closes the fonts that it opens.
    (tmp_path / "operator.md").touch()
    report.write(tmp_path, {"overhead": overhead_run(0.5)}, new=[])
    first = report.load(tmp_path)
    assert first == {"overhead": overhead_run(0.5)}
    later = a_run(("apply", "multiprocessing", {"p50": 1e-4, "p95": 2e-4}))
    report.write(tmp_path, {**first, "latency": later}, new=[])
    index = (tmp_path / "README.md").read_text(encoding="utf-8")
    for words in ("(overhead.md)", "(latency.md)", "(operator.md)", "≤ 0.95x | 0.50x | met"):
        assert words in index
    assert "(kubernetes.md)" not in index


def test_a_run_survives_json() -> None:
    run = a_run(("case", "fiber", {"time": 2.0}))
    run.fail("case", "spark", "not finished after 20 s", after=20.0)
    assert Run.from_json(json.loads(json.dumps(run.as_json()))) == run


def runs_on_pods(pods: float) -> dict[str, Run]:
    """Return runs in which every metric has this value on pods, and 1 without them."""
    runs = {name: Run(dict(ABOUT)) for name in kubernetes_report.MEASURES}
    for case in kubernetes_report.cases(1.0):
        for contender, value in (
            (ON_PODS.name, pods),
            (RELAYED.name, pods),
            (EXECUTOR_ON_PODS.name, pods),
            (BASELINE.name, 1.0),
        ):
            sample = {metric.name: value for metric in case.metrics}
            runs[case.measure].add(case.name, contender, 0, sample)
    return runs


@pytest.mark.parametrize(("pods", "kept"), [(0.1, True), (1.0, True), (1.03, False)])
def test_the_page_of_pods_has_all_measures_and_their_budgets(pods: float, kept: bool) -> None:
    runs, cases = runs_on_pods(pods), kubernetes_report.cases(1.0)
    verdicts = budgets.verdicts(runs, budgets.ON_PODS)
    assert None not in {verdict.kept for verdict in verdicts}
    bounded = [
        each.kept
        for each in verdicts
        if (each.budget.measure, each.budget.contender) == ("overhead", ON_PODS.name)
    ]
    assert bounded == [kept] * 8
    page = kubernetes_report.page(runs)
    assert all(f"| {case.name} |" in page for case in cases)
    assert page.count("| Fiber, pods |") == sum(len(case.metrics) for case in cases)
    assert f"overhead: 1 ms tasks, chunksize 1 | multiprocessing, fork | ≤ 1.02x | {pods}" in page
    assert kubernetes_report.NOTES not in page
    assert kubernetes_report.NOTES in kubernetes_report.page(runs, notes=True)
    assert page.count("| command |") == 1


def test_a_measure_of_pods_that_was_run_alone_says_so() -> None:
    runs = runs_on_pods(1.0)
    about = {**ABOUT, "date": "2026-02-03", "command": "python -m benchmarks.kubernetes_run later"}
    runs["latency"].about.update(about)
    _, section = kubernetes_report.page(runs).split("## Latency")
    section, *others = section.split("\n## ")
    assert "| command | `python -m benchmarks.kubernetes_run later` |" in section
    assert sum("| command |" in other for other in others) == 1


def test_no_cluster_is_started_if_another_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("KUBECONFIG", "/somewhere/else")
    assert kubernetes_cluster.main([]) == 1
    assert "KUBECONFIG names another (/somewhere/else)" in capsys.readouterr().err
