"""The page about pods: what is measured, what budgets say, and what is said without a cluster."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks import (  # noqa: E402
    budgets,
    kubernetes_cluster,
    kubernetes_report,
    kubernetes_run,
    report,
)
from benchmarks.contender import Bench  # noqa: E402
from benchmarks.contenders import ALL, BY_NAME, ON_PODS  # noqa: E402
from benchmarks.model import Run  # noqa: E402

from unit.benchmark_runs import about  # noqa: E402

ABOUT = about(command="python -m benchmarks.kubernetes_run")
PODS, BASELINE = ON_PODS.name, "multiprocessing"


def runs_of(pods: float, baseline: float) -> dict[str, Run]:
    """Every metric of every case has these values."""
    runs = {name: Run(dict(ABOUT)) for name in kubernetes_report.MEASURES}
    for case in kubernetes_report.cases(1.0):
        for contender, value in ((PODS, pods), (BASELINE, baseline)):
            sample = {metric.name: value for metric in case.metrics}
            runs[case.measure].add(case.name, contender, 0, sample)
    return runs


def test_every_budget_is_on_something_that_is_measured() -> None:
    verdicts = budgets.verdicts(runs_of(0.1, 1.0), budgets.ON_PODS)
    assert None not in {verdict.kept for verdict in verdicts}
    assert {each.budget.contender for each in verdicts} == {PODS}


@pytest.mark.parametrize(("pods", "kept"), [(1.0, True), (1.03, False)])
def test_budgets_bound_the_overhead_of_tasks_of_a_millisecond_and_more(
    pods: float, kept: bool
) -> None:
    verdicts = budgets.verdicts(runs_of(pods, 1.0), budgets.ON_PODS)
    found = [each for each in verdicts if each.budget.measure == "overhead"]
    assert len(found) == 8
    assert {each.kept for each in found} == {kept}


def test_the_page_has_all_measures_and_their_budgets() -> None:
    page = kubernetes_report.page(runs_of(0.1, 1.0))
    for case in kubernetes_report.cases(1.0):
        assert f"| {case.name} |" in page
    assert page.count("| Fiber, pods |") == sum(
        len(case.metrics) for case in kubernetes_report.cases(1.0)
    )
    assert (
        "overhead: 1 ms tasks, chunksize 1 | multiprocessing, fork | ≤ 1.02x | 0.10x | met" in page
    )


def test_the_page_leads_to_the_notes_where_there_are_some() -> None:
    runs = runs_of(0.1, 1.0)
    assert f"[notes]({kubernetes_report.NOTES})" in kubernetes_report.page(runs, notes=True)
    assert kubernetes_report.NOTES not in kubernetes_report.page(runs)


def test_pods_are_measured_only_with_a_cluster() -> None:
    assert ON_PODS not in ALL
    assert BY_NAME[PODS] is ON_PODS
    assert not {each.contender for each in budgets.BUDGETS} & {PODS}
    assert "pods" not in report.index({})


def test_each_case_has_a_contender_on_pods_and_its_baseline() -> None:
    for case in kubernetes_report.cases(1.0):
        able = {each.name for each in kubernetes_run.CONTENDERS if case.needs in each.offers}
        assert len(able & {PODS, "fiber-executor-kubernetes"}) == 1, case.name
        assert case.baseline in able, case.name
    vectors = [case for case in kubernetes_report.cases(1.0) if case.measure == "vector"]
    assert [case.name for case in vectors] == [
        "8 CartPoles",
        "64 CartPoles",
        "64 uneven ones",
        "64 uneven ones, first ready",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("measure", ["kubernetes_start", "kubernetes_es"])
def test_a_measure_runs(measure: str) -> None:
    module = kubernetes_report.MEASURES[measure]
    bench = Bench(BASELINE, light=True)
    for case in module.cases(0.02)[:2]:
        sample = module.run(bench, **case.params)
        assert set(sample) == {metric.name for metric in case.metrics}
        assert all(value > 0 for value in sample.values())


def test_no_cluster_is_started_if_another_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("KUBECONFIG", "/somewhere/else")
    assert kubernetes_cluster.main([]) == 1
    assert "KUBECONFIG names another (/somewhere/else)" in capsys.readouterr().err
