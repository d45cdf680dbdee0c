"""Number of workers that a pool needs, and when it stops trying."""

from __future__ import annotations

from typing import Any

import pytest

from fiber._engine.scheduler import IDLE_DEATHS, IDLE_PAUSE, PoolWorkerSet
from fiber._engine.start_failures import (
    FIRST_PAUSE,
    KILLED_PATIENCE,
    LAST_PAUSE,
    LAST_PAUSE_AT_WORK,
    RAISED_PATIENCE,
    SAID_AFTER,
    TRIES,
    StartFailure,
)
from fiber._engine.tasks import WorkerEntry
from fiber.errors import StartError

RAISED = StartFailure("pool worker 'w'", "exit status 1", "no such device")
KILLED = StartFailure("pool worker 'w'", "killed by SIGKILL", killed=True)


class Member:
    """A worker's process."""

    def __init__(self) -> None:
        self.worker: WorkerEntry | None = None
        self.leaving = False


@pytest.fixture
def workers() -> PoolWorkerSet:
    return PoolWorkerSet(2, 4)


def start(workers: PoolWorkerSet, *, ready: bool = False) -> Member:
    member = Member()
    workers.add(member)
    if ready:
        workers.ready(member, WorkerEntry(member, None))
    return member


def fail(workers: PoolWorkerSet, now: float, failure: StartFailure = RAISED) -> None:
    workers.gone(start(workers), now, failure)


def fail_until(
    workers: PoolWorkerSet, stop: float, failure: StartFailure, now: float = 0.0
) -> float:
    """Start one whenever that may be; each fails at once.  The time of the last."""
    while True:
        fail(workers, now, failure)
        due = workers.next_try()
        assert due is not None
        if workers.error is not None or due > stop:
            return now
        now = due


# How many


def test_the_number_of_workers_follows_the_demand_within_bounds(workers: PoolWorkerSet) -> None:
    assert [workers.wanted(demand) for demand in (0, 1, 2, 3, 4, 100)] == [2, 2, 2, 3, 4, 4]
    assert workers.missing(3, 0) == 3
    start(workers)
    assert workers.missing(3, 0) == 2
    assert workers.missing(0, 0) == 1


def test_newcomers_are_wanted_for_tasks_that_only_they_may_run(workers: PoolWorkerSet) -> None:
    for _ in range(2):
        start(workers, ready=True)
    assert workers.missing(1, 0) == 0
    assert workers.missing(1, 1) == 1
    start(workers)
    assert workers.missing(1, 1) == 0
    start(workers)
    assert workers.missing(1, 5) == 0, "more than the maximum"


def test_the_worker_set_counts_its_workers(workers: PoolWorkerSet) -> None:
    one, other = start(workers, ready=True), start(workers)
    assert (workers.size, workers.starting) == (2, 1)
    workers.let_go(other)
    workers.let_go(other)
    assert (workers.size, workers.starting, workers.staying()) == (1, 0, [one])
    workers.gone(other, 0.0, RAISED)
    workers.gone(one, 0.0, RAISED)
    workers.gone(one, 0.0, RAISED)
    assert (workers.size, workers.starting, workers.members) == (0, 0, {})
    assert workers.failures == 0, "who was told to go, or was ready, did not fail to start"


def test_all_missing_workers_are_started_at_once(workers: PoolWorkerSet) -> None:
    assert workers.startable(4, 0.0) == 4
    assert workers.next_try() is None


# Failures


@pytest.mark.parametrize(
    ("failure", "patience"), [(RAISED, RAISED_PATIENCE), (KILLED, KILLED_PATIENCE)]
)
def test_a_pool_gives_up_when_no_worker_starts_in_time(
    workers: PoolWorkerSet, failure: StartFailure, patience: float
) -> None:
    last = fail_until(workers, patience + LAST_PAUSE, failure)
    assert patience <= last <= patience + LAST_PAUSE
    assert isinstance(workers.error, StartError)
    assert workers.error is workers.trouble
    assert failure.reason in str(workers.error)
    assert failure.text in str(workers.error)


def test_however_many_fail_at_once_that_is_no_reason_to_give_up(workers: PoolWorkerSet) -> None:
    members = [start(workers) for _ in range(1000)]
    for member in members:
        workers.gone(member, 0.5, RAISED)
    assert workers.error is None
    assert workers.next_try() == 0.5 + FIRST_PAUSE, "one wave, one pause"


def test_however_long_it_takes_there_are_some_tries(workers: PoolWorkerSet) -> None:
    for at in range(TRIES - 1):
        fail(workers, 100.0 * at)
        assert workers.error is None
    fail(workers, 100.0 * TRIES)
    assert workers.error is not None


def test_a_killed_worker_does_not_end_a_pool_whose_workers_raised_before(
    workers: PoolWorkerSet,
) -> None:
    fail_until(workers, RAISED_PATIENCE / 2, RAISED)
    fail(workers, RAISED_PATIENCE + 1, KILLED)
    assert workers.error is None


def test_a_worker_that_raises_after_killed_ones_has_the_tries_of_its_kind(
    workers: PoolWorkerSet,
) -> None:
    fail_until(workers, KILLED_PATIENCE / 2, KILLED)
    fail(workers, KILLED_PATIENCE / 2, RAISED)
    assert workers.error is None, "it may be the first of its kind"
    fail(workers, KILLED_PATIENCE / 2 + RAISED_PATIENCE / 2, RAISED)
    fail(workers, KILLED_PATIENCE / 2 + RAISED_PATIENCE, RAISED)
    assert workers.error is not None


@pytest.mark.parametrize(
    ("failure", "patience"), [(RAISED, RAISED_PATIENCE), (KILLED, KILLED_PATIENCE)]
)
@pytest.mark.parametrize("told_to_go", [False, True])
def test_patience_begins_when_the_last_at_work_is_lost(
    workers: PoolWorkerSet, failure: StartFailure, patience: float, told_to_go: bool
) -> None:
    at_work = start(workers, ready=True)
    fail_until(workers, 300.0, failure)
    if told_to_go:
        workers.let_go(at_work)
    workers.gone(at_work, 300.0, None)
    fail(workers, 300.0 + patience / 2, failure)
    assert workers.error is None
    fail(workers, 300.0 + patience, failure)
    assert workers.error is not None


def test_workers_of_lost_hosts_do_not_count_as_failures(workers: PoolWorkerSet) -> None:
    for at in range(100):
        workers.gone(start(workers), float(at), None)
    assert (workers.failures, workers.error, workers.next_try()) == (0, None, None)


def test_a_worker_that_starts_clears_the_failures_of_others(workers: PoolWorkerSet) -> None:
    fail_until(workers, RAISED_PATIENCE / 2, RAISED)
    member = start(workers, ready=True)
    assert (workers.failures, workers.next_try()) == (0, None)
    assert workers.startable(3, 0.0) == 3
    workers.gone(member, 100.0, None)
    fail_until(workers, 100.0 + RAISED_PATIENCE / 2, RAISED, 100.0)
    assert workers.error is None, "time counts from the first failure after it"


def test_the_cause_of_a_refusal_is_kept() -> None:
    cause = OSError("too many open files")
    error = StartFailure("a pool worker", str(cause), killed=True, cause=cause).error(3)
    assert error.__cause__ is cause
    assert "too many open files" in str(error)


# Pauses


def test_pauses_between_waves_double_up_to_a_limit(workers: PoolWorkerSet) -> None:
    now, pauses = 0.0, []
    for _ in range(9):
        fail(workers, now, KILLED)
        due = workers.next_try()
        assert due is not None
        pauses.append(due - now)
        now = due
    assert pauses == pytest.approx([min(FIRST_PAUSE * 2**n, LAST_PAUSE) for n in range(9)])


def test_after_a_pause_one_worker_is_tried(workers: PoolWorkerSet) -> None:
    fail(workers, 10.0)
    assert workers.startable(4, 10.0) == 0
    assert workers.startable(4, 10.0 + FIRST_PAUSE) == 1
    member = start(workers)
    assert workers.startable(3, 99.0) == 0, "it has not shown yet that they can start"
    assert workers.next_try() is None
    workers.ready(member, WorkerEntry(member, None))
    assert workers.startable(3, 10.1) == 3


def test_failures_during_a_pause_belong_to_the_same_wave(workers: PoolWorkerSet) -> None:
    late = [start(workers) for _ in range(3)]
    fail(workers, 10.0)
    for member in late:
        workers.gone(member, 10.0 + FIRST_PAUSE / 2, RAISED)
    assert workers.next_try() == 10.0 + FIRST_PAUSE


def test_while_others_work_it_tries_again_less_and_less_often(workers: PoolWorkerSet) -> None:
    at_work = start(workers, ready=True)
    now = fail_until(workers, 1000.0, RAISED)
    assert workers.error is None
    assert workers.trouble is not None
    assert workers.next_try() == now + LAST_PAUSE_AT_WORK
    workers.gone(at_work, now, None)
    assert workers.next_try() == now + LAST_PAUSE, "nobody is at work: it is urgent"
    fail(workers, now + LAST_PAUSE)
    assert workers.error is not None


def test_workers_that_die_idle_again_and_again_are_replaced_slowly(workers: PoolWorkerSet) -> None:
    for _ in range(IDLE_DEATHS + workers.maximum):
        workers.gone(start(workers, ready=True), 5.0, None)
        assert workers.next_try() is None
    workers.gone(start(workers, ready=True), 5.0, None)
    assert workers.next_try() == 5.0 + IDLE_PAUSE
    start(workers, ready=True)
    assert workers.next_try() == 5.0 + IDLE_PAUSE, "that one is ready is nothing new"
    assert workers.startable(2, 5.0 + IDLE_PAUSE) == 1
    workers.did_something()
    assert workers.next_try() is None
    assert workers.error is None
    workers.gone(start(workers, ready=True), 7.0, None)
    assert workers.next_try() is None, "the count began again with the result"


def test_a_worker_that_dies_at_work_is_replaced_at_once(workers: PoolWorkerSet) -> None:
    batch: Any = object()
    for _ in range(100):
        member = start(workers, ready=True)
        assert member.worker is not None
        member.worker.queue.append(batch)
        workers.gone(member, 5.0, None)
    assert workers.next_try() is None


# Messages


def test_failures_that_last_are_reported_once(workers: PoolWorkerSet) -> None:
    fail(workers, 0.0, KILLED)
    assert workers.news(KILLED, 0.0) == ""
    fail(workers, SAID_AFTER, KILLED)
    news = workers.news(KILLED, SAID_AFTER)
    assert "2 tries" in news
    assert KILLED.reason in news
    fail(workers, SAID_AFTER + 1, KILLED)
    assert workers.news(KILLED, SAID_AFTER + 1) == ""
    start(workers, ready=True)
    fail(workers, 100.0, KILLED)
    assert workers.news(KILLED, 100.0) == ""
    fail(workers, 100.0 + SAID_AFTER, KILLED)
    assert workers.news(KILLED, 100.0 + SAID_AFTER) != "", "it is something new"


def test_an_error_needs_no_news(workers: PoolWorkerSet) -> None:
    last = fail_until(workers, 100.0, KILLED)
    assert workers.error is not None
    assert workers.news(KILLED, last) == ""
