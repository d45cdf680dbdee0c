"""Harness tests: it finds hangs, crashes, leftovers and stale exclusions."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from conformance.run import select
from conformance.runner import TESTS, Outcome, Report, Target, list_cases, run_group
from conformance.verdict import Verdict

FAULTY = "TestSimpleQueue.test_close"
SOUND = "WithProcessesTestProcess.test_cpu_count"


def broken(how: str, limit: float = 60) -> Target:
    environment = (("BROKEN", how),)
    module = "conformance.broken_multiprocessing"
    return Target(module, "spawn", frozenset({"core"}), limit, environment)


def results(report: Report) -> dict[str, str]:
    return {outcome.id: outcome.result for outcome in report.outcomes}


def test_a_hang_is_named_with_its_stack_and_the_rest_runs() -> None:
    report = run_group(broken("hang", limit=4), [FAULTY, SOUND])
    assert results(report) == {FAULTY: "hang", SOUND: "pass"}
    detail = report.outcomes[0].detail
    assert "broken_multiprocessing.py" in detail
    assert "in close" in detail
    assert "Alone in an interpreter: hang." in detail
    names = re.findall(r"^semaphore /(.+)$", detail, re.MULTILINE)
    assert len(names) == 2
    assert not [name for name in names if Path(f"/dev/shm/sem.{name}").exists()]


def test_a_crash_is_named_with_its_status_and_the_rest_runs() -> None:
    report = run_group(broken("crash"), [FAULTY, SOUND])
    assert results(report) == {FAULTY: "crash", SOUND: "pass"}
    assert "ended with 3" in report.outcomes[0].detail


def test_a_process_left_behind_fails_the_group_and_is_killed() -> None:
    report = run_group(broken("leave"), [FAULTY])
    assert results(report) == {FAULTY: "pass", "TestSimpleQueue.<left behind>": "fail"}


def test_a_module_that_cannot_be_loaded_is_reported_at_once() -> None:
    target = Target("no_such_module", "spawn", frozenset({"core"}), 60)
    with pytest.raises(RuntimeError, match="No module named 'no_such_module'"):
        list_cases(target)


def test_a_python_without_its_tests_is_reported(tmp_path: Path) -> None:
    # Some distributions put the tests into a separate package.
    (tmp_path / "test").mkdir()
    (tmp_path / "test" / "__init__.py").touch()
    path = ("PYTHONPATH", os.pathsep.join([str(tmp_path), str(TESTS)]))
    target = Target("multiprocessing", "spawn", frozenset({"core"}), 60, (path,))
    with pytest.raises(RuntimeError, match=r"has no test\._test_multiprocessing: install"):
        list_cases(target)


@pytest.mark.parametrize("result", ["fail", "hang", "crash"])
def test_an_unlisted_failure_fails_the_run_and_a_listed_one_does_not(result: str) -> None:
    report = Report([Outcome("C.a", result), Outcome("C.b", "pass")])
    assert not Verdict("t", report, {}, 0).ok
    assert Verdict("t", report, {"C.a": "a reason"}, 0).ok


def test_a_listed_test_that_passes_fails_the_run() -> None:
    verdict = Verdict("t", Report([Outcome("C.a", "pass")]), {"C.a": "a reason"}, 0)
    assert not verdict.ok
    assert "1 listed but passing" in verdict.closing_line()


def test_an_empty_run_fails() -> None:
    assert not Verdict("t", Report(), {}, 0).ok


def test_the_report_gives_each_exclusion_its_reason() -> None:
    report = Report([Outcome("C.a", "fail"), Outcome("C.b", "fail", detail="its traceback")])
    text = Verdict("t", report, {"C.a": "a reason"}, 0, {"C.c": "another reason"}).text()
    assert "C.a: a reason" in text
    assert "Left out:\n  C.c: another reason" in text
    assert "=== fail: C.b\nits traceback" in text


@pytest.mark.parametrize("tiers", [{"core"}, {"core", "prompt", "local"}])
def test_each_excluded_test_of_a_class_that_runs_has_a_reason(tiers: set[str]) -> None:
    groups, left_out = select(Target("multiprocessing", "spawn", frozenset(tiers), 60))
    assert not {id_ for group in groups for id_ in group} & left_out.keys()
    assert all(not line.endswith(": ") for line in left_out.values())
    assert left_out["WithProcessesTestEvent.test_repr"].startswith("promised to nobody")
    for id_ in (
        "WithProcessesTestProcess.test_set_executable",
        "TestInitializers.test_pool_initializer",
    ):
        assert (id_ in left_out) == (tiers == {"core"})
