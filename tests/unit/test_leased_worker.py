"""Work of a leased worker, as its caller counts it and the loop notes it."""

from __future__ import annotations

from typing import Any, cast

import pytest

from fiber._engine.activity import FUNCTIONS, OTHER_FUNCTIONS
from fiber._runtime.leases import UNUSED, LeasedWorker


class Handle:
    def did(self, tasks: int) -> None:
        assert tasks == 1


@pytest.fixture
def worker() -> LeasedWorker:
    return LeasedWorker(cast("Any", Handle()), 10.0)


def test_the_work_of_each_function_is_reported_once(worker: LeasedWorker) -> None:
    worker.did("train", 3.0, False)
    worker.did("evaluate", 1.0, True)
    worker.did("train", 0.0, False)
    train, evaluate = worker.take_work(20.0)
    assert (train.function, train.tasks, train.failed, train.seconds) == ("train", 2, 0, 3.0)
    assert (evaluate.function, evaluate.tasks, evaluate.failed) == ("evaluate", 1, 1)
    assert (train.begin, train.end, evaluate.begin, evaluate.end) == (16.0, 19.0, 19.0, 20.0)
    assert worker.take_work(21.0) == []
    worker.did("evaluate", 0.0, False)
    (again,) = worker.take_work(22.0)
    assert (again.function, again.tasks, again.failed) == ("evaluate", 1, 0)
    assert (again.begin, again.end) == (22.0 - UNUSED, 22.0)


def test_no_report_begins_before_the_last_note(worker: LeasedWorker) -> None:
    worker.did("train", 3.0, False)
    (report,) = worker.take_work(11.0)
    assert (report.begin, report.end) == (10.0, 11.0)


def test_functions_beyond_a_number_are_counted_together(worker: LeasedWorker) -> None:
    for number in range(FUNCTIONS + 5):
        worker.did(f"function {number}", 0.0, False)
    *_, last = worker.take_work(20.0)
    assert (last.function, last.tasks) == (OTHER_FUNCTIONS, 5)
