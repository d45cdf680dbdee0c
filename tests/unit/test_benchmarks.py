"""The benchmarks: their arithmetic, their pages, a contender that fails."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks import budgets, contenders, overhead, processes, report, samples  # noqa: E402
from benchmarks.model import Case, Metric, Run  # noqa: E402
from benchmarks.rounds import in_turn  # noqa: E402
from benchmarks.session import Failed, Session  # noqa: E402
from benchmarks.suite import MEASURES  # noqa: E402

from unit.benchmark_runs import about  # noqa: E402

ABOUT = about(rounds=3, versions={"numpy": "2.0"}, skipped={"ray": "ray"})


def test_summary_ignores_rounds_without_a_value() -> None:
    assert samples.summary([3.0, None, 1.0, 2.0]) == samples.Summary(2.0, 1.0, 3.0, 3)
    assert samples.summary([None]) is None


def test_ratio_is_taken_within_a_round() -> None:
    # The machine was ten times slower in the second round: the ratio of the medians would be 1.
    found = samples.ratio([1.0, 10.0, 1.5], [2.0, 20.0, 1.0])
    assert found == samples.Summary(0.5, 0.5, 1.5, 3)


def test_ratio_uses_only_the_rounds_that_both_took_part_in() -> None:
    assert samples.ratio([4.0], [2.0, 8.0, 8.0]) == samples.Summary(2.0, 2.0, 2.0, 1)
    assert samples.ratio([None, 4.0], [2.0]) is None


def test_percentile_is_a_value_that_occurred() -> None:
    values = [float(n) for n in range(100, 0, -1)]
    assert samples.percentile(values, 50) == 51.0
    assert samples.percentile(values, 95) == 96.0
    assert samples.percentile([7.0], 95) == 7.0


@pytest.mark.parametrize(
    ("value", "unit", "words"),
    [
        (1.0, "s", "1.00 s"),
        (0.00131, "s", "1.31 ms"),
        (0.0000842, "s", "84.2 µs"),
        (12345.6, "1/s", "12,346 /s"),
        (5.2e9, "B", "5.20 GB"),
    ],
)
def test_numbers_in_words(value: float, unit: str, words: str) -> None:
    assert samples.in_words(value, unit) == words


@pytest.mark.parametrize(("value", "words"), [(1.004, "1.004x"), (0.65, "0.65x"), (61.2, "61.2x")])
def test_ratios_in_words(value: float, words: str) -> None:
    assert samples.times(value) == words


def test_order_rotates_and_visits_everyone() -> None:
    everyone = contenders.ALL[:3]
    first = [in_turn(everyone, turn)[0] for turn in range(3)]
    assert first == list(everyone)
    assert sorted(each.name for each in in_turn(everyone, 2)) == sorted(e.name for e in everyone)


def test_a_run_survives_json() -> None:
    run = Run(dict(ABOUT))
    run.add("case", "fiber", 1, {"time": 2.0})
    run.fail("case", "spark", "not finished after 20 s", after=20.0)
    again = Run.from_json(json.loads(json.dumps(run.as_json())))
    assert again == run
    assert again.series("case", "fiber", "time") == [None, 2.0]


def overhead_run(fiber: float, baseline: float) -> Run:
    run = Run(dict(ABOUT))
    for turn in range(3):
        for duration in overhead.DURATIONS:
            for chunks in overhead.CHUNKS:
                case = overhead.case_name(duration, chunks)
                run.add(case, "fiber", turn, {"time": fiber})
                run.add(case, "multiprocessing", turn, {"time": baseline})
    return run


def budget_for(case: str) -> budgets.Budget:
    return next(each for each in budgets.BUDGETS if each.case == case)


@pytest.mark.parametrize(
    ("fiber", "kept", "verdict"),
    [(0.9, True, "met"), (0.95, True, "met"), (1.045, False, "missed by 10.0 %")],
)
def test_budget_on_a_ratio(fiber: float, kept: bool, verdict: str) -> None:
    budget = budget_for(overhead.case_name(0.001, "chunksize 1"))
    found = budgets.judge(budget, {"overhead": overhead_run(fiber, 1.0)})
    assert (found.kept, found.verdict) == (kept, verdict)


def test_budget_that_asks_for_at_least() -> None:
    budget = next(
        each for each in budgets.BUDGETS if each.at_least and each.measure == "throughput"
    )
    run = Run(dict(ABOUT))
    run.add(budget.case, budget.contender, 0, {budget.metric: 75.0})
    run.add(budget.case, "multiprocessing", 0, {budget.metric: 2.0})
    found = budgets.judge(budget, {"throughput": run})
    assert (found.kept, found.measured, found.verdict) == (False, "37.5x", "missed by 25.0 %")


def test_budget_of_an_unmeasured_case() -> None:
    budget = budget_for(overhead.case_name(0.001, "chunksize 1"))
    assert budgets.judge(budget, {}).kept is None
    run = Run(dict(ABOUT))
    run.fail(budget.case, "fiber", "ended with exit status 1: no message")
    found = budgets.judge(budget, {"overhead": run})
    assert found.verdict == "not measured: ended with exit status 1: no message"


def test_a_rival_that_was_too_slow_to_finish_keeps_a_budget_on_its_slowness() -> None:
    budget = next(each for each in budgets.BUDGETS if each.contender == "spark")
    run = overhead_run(2.0, 1.0)
    run.fail(budget.case, "spark", "not finished after 90 s", after=90.0)
    found = budgets.judge(budget, {"overhead": run})
    assert (found.kept, found.measured) == (True, "> 45.0x")
    run.fail(budget.case, "spark", "not finished after 20 s", after=20.0)
    assert budgets.judge(budget, {"overhead": run}).kept is None


def test_every_budget_is_on_a_case_that_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    # With one processor, no work can be limited to two.
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    measured = {
        (case.measure, case.name, metric.name, contender.name)
        for measure in MEASURES.values()
        for case in measure.cases(1.0)
        for metric in case.metrics
        for contender in contenders.ALL
        if case.needs in contender.offers
    }
    for each in budgets.BUDGETS:
        assert (each.measure, each.case, each.metric, each.contender) in measured, each.what
        if not each.unit:
            case, contender = each.divisor
            assert (each.measure, case, each.metric, contender) in measured, each.what


def test_case_names_are_unique_in_a_measure() -> None:
    for name, measure in MEASURES.items():
        names = [case.name for case in measure.cases(1.0)]
        assert len(names) == len(set(names)), name


def test_page_shows_ratio_budget_failures_and_skipped_contenders() -> None:
    run = overhead_run(0.5, 1.0)
    run.fail(overhead.case_name(0.0001, "chunksize 1"), "spark", "not finished after 20 s")
    page = report.page("overhead", run)
    assert "| Fiber | 500 ms | 500 ms to 500 ms | 0.50x (0.50x to 0.50x) | ≤ 0.95x | met |" in page
    assert "| 100 µs tasks, chunksize 1 | PySpark | not finished after 20 s |" in page
    assert "| all | Ray's Pool | skipped, not installed: ray |" in page
    assert "2 cores (a processor), 8.00 GB of memory" in page


def test_measuring_one_thing_again_keeps_the_other_pages(tmp_path: Path) -> None:
    # These tests draw no picture, because matplotlib never closes the fonts that it opens.
    report.write(tmp_path, {"overhead": overhead_run(0.5, 1.0)}, new=[])
    first = report.load(tmp_path)
    assert first == {"overhead": overhead_run(0.5, 1.0)}
    latency = Run(dict(ABOUT))
    latency.add("apply", "multiprocessing", 0, {"p50": 1e-4, "p95": 2e-4})
    report.write(tmp_path, {**first, "latency": latency}, new=[])
    index = (tmp_path / "README.md").read_text(encoding="utf-8")
    assert "(overhead.md)" in index
    assert "(latency.md)" in index
    assert "≤ 0.95x | 0.50x | met" in index


def test_the_index_names_pages_of_other_commands_that_are_there(tmp_path: Path) -> None:
    (tmp_path / "operator.md").touch()
    report.write(tmp_path, {"overhead": overhead_run(0.5, 1.0)}, new=[])
    index = (tmp_path / "README.md").read_text(encoding="utf-8")
    assert "(operator.md)" in index
    assert "(kubernetes.md)" not in index


def test_an_absent_peer_names_the_missing_package() -> None:
    peer = contenders.Contender("x", "X", ("no_such_module_at_all",), frozenset(), "#000000", "o")
    assert peer.missing() == "no_such_module_at_all"


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    session = Session(contenders.BY_NAME["multiprocessing"], tmp_path)
    yield session
    session.interrupt()


def latency_case(*, limit: float, **params: object) -> Case:
    return Case("latency", "apply", "", "apply", params, (Metric("p50", "p50", "s"),), limit=limit)


def test_an_exception_of_a_contender_is_reported(session: Session) -> None:
    with pytest.raises(Failed, match=r"TypeError: .*missing 1 required positional argument"):
        session.run(latency_case(limit=20.0, calls=1))


@pytest.mark.slow
def test_a_contender_that_takes_too_long_is_stopped_with_its_workers(session: Session) -> None:
    with pytest.raises(Failed, match="not finished after 1 s"):
        session.run(latency_case(limit=1.0, calls=10**9, seconds=600.0))
    below = processes.descendants(session.pid)
    assert len(below) == 5
    session.interrupt()
    assert not any(os.path.exists(f"/proc/{pid}") for pid in (session.pid, *below))


def test_the_death_of_a_contender_is_reported(session: Session) -> None:
    case = Case("no_such_measure", "x", "", "map", {}, (), limit=20.0)
    with pytest.raises(Failed, match="exit status 1: ModuleNotFoundError"):
        session.run(case)
