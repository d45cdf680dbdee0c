"""Summary of a program: shares of the time, and advice where the record proves it."""

from __future__ import annotations

from dataclasses import astuple
from typing import Any

import pytest

from fiber._engine.activity import Activity, ChildRecord, WorkReport
from fiber._runtime import activity_reading
from fiber._runtime.summary import Summary, summarize

START = 1000.0


class Run:
    """Record of a run, with workers that are ready after a second."""

    def __init__(self, workers: int = 4) -> None:
        self.activity = Activity(START)
        self.workers = [self.add() for _ in range(workers)]

    def add(self) -> ChildRecord:
        child = self.activity.add_child("w", START)
        child.name = f"w{child.id}"
        self.activity.started(child, START + 0.5, f"h{child.id % 2}", "", 7)
        self.activity.ready(child, START + 1, 1)
        return child

    def work(
        self,
        worker: int,
        begin: float,
        seconds: float,
        tasks: int = 1,
        *,
        function: str = "f",
        way: float = 0.0,
        answers: int = 1,
        chunk: int = 1,
        failed: int = 0,
    ) -> None:
        """Add work ``begin`` seconds after the start."""
        child, at = self.workers[worker], START + begin
        child.held += seconds + way
        report = WorkReport(function, at, at + seconds, seconds, tasks, failed, answers, chunk)
        self.activity.worked(child, report)

    def summary(self, seconds: float, busy: list[Any] | None = None) -> Summary:
        found = self.activity.snapshot(START + seconds)
        return summarize({"start": 1.7e9, "busy": busy or [], **found})


def test_a_program_without_a_process_has_an_empty_summary() -> None:
    found = summarize(activity_reading.no_activity())
    assert (found.workers, found.tasks, found.functions, found.advice) == (0, 0, (), ())
    assert set(astuple(found.shares)) == {0.0}
    assert len(str(found).splitlines()) == 3


def test_the_shares_add_up_to_the_workers_time() -> None:
    run = Run(2)
    run.work(0, 2, 4.0, 10, way=1.0)
    run.work(1, 2, 2.0, 10)
    run.activity.worked(run.workers[1], WorkReport("f", START + 5, START + 7, 0.0, 0))
    run.activity.ended(run.workers[1], START + 7, "killed by SIGKILL")
    found = run.summary(11)
    assert found.worker_seconds == pytest.approx(11 + 7)
    shares = [share * 18 for share in astuple(found.shares)]
    assert shares == pytest.approx([6.0, 1.0, 2.0, 10 - 5 + 6 - 4, 1.0, 1.0])
    assert sum(astuple(found.shares)) == pytest.approx(1)
    assert (found.workers, found.hosts, found.tasks) == (2, 2, 20)


def test_a_task_that_still_runs_is_not_idle_time() -> None:
    found = Run(1).summary(11, busy=[[1, 3.0]])
    assert found.shares.unfinished * found.worker_seconds == pytest.approx(8)
    assert "with unfinished tasks" in str(found)


def test_the_text_has_about_ten_lines() -> None:
    run = Run()
    for number in range(6):
        run.work(number % 4, 2 + number, 1.0 / (1 + number), 10, function=f"f{number}", failed=1)
    run.activity.ended(run.workers[0], START + 9, "killed by SIGKILL")
    run.activity.lost, run.activity.retried, run.activity.pickling = 3, 2, 0.004
    run.activity.bytes_sent = 1_234_567
    found = run.summary(10)
    lines = str(found).splitlines()
    assert repr(found) == str(found)
    assert lines[:2] == [
        "time       10 s; 4 workers on 2 hosts",
        "tasks      60 done, 6 of them failed; runs repeated 2, lost 3",
    ]
    assert lines[3] == "program    4 ms of pickling; 1.23 MB sent, 0 B received"
    assert lines[4] == (
        "functions  f0: 41 % of the work, 10 tasks, 1 failed, 100 ms each, longest at least 100 ms"
    )
    assert lines[7:] == [
        "           3 more: 25 % of the work",
        "deaths     w1 on h1 after 9 s: killed by SIGKILL",
    ]


# Slow workers


def even_run(workers: int, tasks: int = 30) -> Run:
    run = Run(workers)
    for worker in range(workers):
        for number in range(tasks):
            run.work(worker, 2 + number, 0.5 + 0.01 * ((worker + number) % 5))
    return run


def test_a_worker_that_takes_twice_as_long_is_named() -> None:
    run = even_run(5)
    run.workers.append(run.add())
    for number in range(30):
        run.work(5, 2 + number, 1.0)
    found = run.summary(40).slowest
    assert found is not None
    assert (found.name, found.function) == ("w6", "f")
    assert found.factor == pytest.approx(1.92, abs=0.01)
    assert "w6 on h0: its tasks of f took 1.9 times as long" in str(run.summary(40))


@pytest.mark.parametrize("tasks", [5, 30])
def test_workers_alike_and_few_tasks_name_none(tasks: int) -> None:
    run = even_run(5, tasks)
    if tasks == 5:
        run.work(0, 20, 30.0)
    assert run.summary(60).slowest is None


def test_no_worker_is_named_if_the_record_has_not_all_of_its_tasks() -> None:
    run = even_run(5)
    run.workers.append(run.add())
    for number in range(30):
        run.work(5, 2 + number, 1.0)
    run.work(0, 50, 0.1, function="g")
    run.activity.functions["f"].tasks += 1  # of a worker that was forgotten
    assert run.summary(60).slowest is None


# Advice


def test_short_tasks_one_by_one_with_much_time_on_the_way() -> None:
    run = Run()
    for number in range(400):
        run.work(number % 4, 2 + number / 100, 0.001, 10, way=0.03, answers=10)
    (advice,) = run.summary(6).advice
    assert advice.startswith("f: 4,000 tasks of 100 µs, 1.0 in a message, and ")
    assert "larger chunksize" in advice


@pytest.mark.parametrize(
    ("answers", "way", "seconds"), [(1, 0.03, 0.001), (10, 0.0, 0.001), (10, 0.03, 0.05)]
)
def test_no_advice_for_many_in_a_message_a_short_way_or_long_tasks(
    answers: int, way: float, seconds: float
) -> None:
    run = Run()
    for number in range(400):
        run.work(number % 4, 2 + number / 8, seconds, 10, way=way, answers=answers)
    assert run.summary(60).advice == ()


def test_long_tasks_in_chunks_and_idle_workers_at_the_end() -> None:
    run = Run()
    for worker, chunks in enumerate((1, 1, 1, 3)):
        for number in range(chunks):
            run.work(worker, 2 + 5 * number, 5.0, 5, chunk=5)
    (advice,) = run.summary(17).advice
    assert advice == (
        "f: tasks of 1 s were in chunks of up to 5, and 3 of 4 workers had none in the last 10 s. "
        "Pass chunksize=1, so that the others share the rest."
    )
    assert str(run.summary(17)).splitlines()[-1] == f"advice     {advice}"


@pytest.mark.parametrize(("tasks", "chunk"), [(1, 1), (5, 1), (1, 5)])
def test_no_advice_for_tasks_that_need_not_stay_together(tasks: int, chunk: int) -> None:
    run = Run()
    for worker, answers in enumerate((1, 1, 1, 3)):
        for number in range(answers):
            run.work(worker, 2 + 5 * number, 5.0, tasks, chunk=chunk)
    assert run.summary(17).advice == ()


def test_much_pickling_and_a_long_start() -> None:
    run = Run()
    run.activity.pickling = 3.0
    pickling, start = run.summary(2).advice
    assert "initializer" in pickling
    assert start.startswith("The workers waited for hosts and started for 50 % of their time")
