"""Scheduler's next steps for a pool, decision by decision."""

from __future__ import annotations

import math
from typing import Any

from fiber._engine.load import RECALL_AFTER
from fiber._engine.scheduler import IDLE_DEATHS, Decisions, Scheduler
from fiber._engine.start_failures import FIRST_PAUSE, RAISED_PATIENCE, StartFailure
from fiber._engine.tasks import Job, Limits, WorkerEntry
from unit.ledger_steps import answer, known

RAISED = StartFailure("pool worker 'w'", "exit status 1", "no such device")


class Member:
    """A worker's process."""

    def __init__(self) -> None:
        self.worker: WorkerEntry | None = None
        self.leaving = False

    @property
    def ready(self) -> WorkerEntry:
        assert self.worker is not None
        return self.worker


def start(scheduler: Scheduler, decisions: Decisions, now: float = 0.0) -> list[Member]:
    """Do as was decided: start so many, and have them become ready."""
    members = [Member() for _ in range(decisions.start)]
    for member in members:
        scheduler.starting(member)
    for member in members:
        scheduler.ready(member, now)
    return members


def pool(minimum: int, maximum: int | None = None, **options: Any) -> tuple[Scheduler, list[Any]]:
    """A scheduler, and its first workers, which are ready."""
    scheduler = Scheduler(minimum, maximum or minimum, **options)
    return scheduler, start(scheduler, scheduler.decide(0.0))


def job_of(scheduler: Scheduler, tasks: int, **options: Any) -> Job:
    job = scheduler.ledger.open("owner", **options)
    scheduler.ledger.feed(job, range(tasks))
    scheduler.ledger.close(job)
    return job


def finish(scheduler: Scheduler, decisions: Decisions, now: float) -> Decisions:
    """Answer all that is assigned, from there on, until nothing is left."""
    while decisions.assign:
        for batch in decisions.assign:
            answer(scheduler.ledger, batch, now)
        decisions = scheduler.decide(now)
    return decisions


def nothing(decisions: Decisions) -> bool:
    """Return whether there is no work, now or later."""
    return decisions == Decisions([], [], 0, [], [], [], math.inf, False)


# Work and workers


def test_a_pool_begins_with_its_minimum_and_then_rests() -> None:
    scheduler = Scheduler(2, 5)
    decisions = scheduler.decide(0.0)
    assert decisions.start == 2
    start(scheduler, decisions)
    assert nothing(scheduler.decide(0.0))


def test_tasks_are_assigned_as_soon_as_they_come() -> None:
    scheduler, members = pool(2)
    job = job_of(scheduler, 2)
    decisions = scheduler.decide(0.0)
    assert {batch.worker.key for batch in decisions.assign} == set(members)
    assert nothing(finish(scheduler, decisions, 0.0))
    assert job.finished


def test_a_pool_grows_with_its_work_up_to_its_maximum() -> None:
    scheduler, _ = pool(1, 3)
    job_of(scheduler, 100)
    decisions = scheduler.decide(0.0)
    assert decisions.start == 2
    for _ in range(decisions.start):
        scheduler.starting(Member())
    assert scheduler.decide(0.0).start == 0


def test_a_lost_worker_is_replaced_and_its_task_runs_elsewhere() -> None:
    scheduler, members = pool(1)
    job = job_of(scheduler, 1)
    (batch,) = scheduler.decide(0.0).assign
    assert scheduler.gone(members[0], 0.0, running=(batch.seq, 0)) == []
    decisions = scheduler.decide(0.0)
    assert (decisions.start, decisions.assign) == (1, [])
    assert job.charges.deaths == {0: 1}
    start(scheduler, decisions)
    assert len(scheduler.decide(0.0).assign) == 1


def test_a_task_that_had_its_tries_is_a_loss() -> None:
    scheduler, members = pool(1)
    job = job_of(scheduler, 1, limits=Limits(0))
    (batch,) = scheduler.decide(0.0).assign
    (loss,) = scheduler.gone(members[0], 0.0, running=(batch.seq, 0))
    assert (loss.job, loss.task, loss.counts.deaths) == (job, 0, 1)
    assert job.finished


def test_a_worker_that_did_all_it_may_is_dismissed_and_replaced() -> None:
    scheduler, members = pool(1, max_tasks=1)
    job_of(scheduler, 2, unit=1)
    (batch,) = scheduler.decide(0.0).assign
    answer(scheduler.ledger, batch)
    decisions = scheduler.decide(0.0)
    assert decisions.dismiss == members
    assert decisions.start == 1
    assert members[0].leaving
    assert scheduler.decide(0.0).dismiss == []


def test_idle_workers_ask_for_unread_tasks_of_busy_ones() -> None:
    scheduler, _ = pool(2)
    job_of(scheduler, 4)
    decisions = scheduler.decide(0.0)
    idle, busy = (batch.worker for batch in decisions.assign[:2])
    for batch in list(idle.queue):
        answer(scheduler.ledger, batch)
    decisions = scheduler.decide(0.0)
    assert (decisions.recall, decisions.wake_at) == ([], RECALL_AFTER)
    decisions = scheduler.decide(RECALL_AFTER)
    assert decisions.recall == [busy]
    assert scheduler.decide(RECALL_AFTER).recall == [], "it was asked"


def test_a_worker_that_becomes_ready_after_its_dismissal_gets_no_tasks() -> None:
    scheduler = Scheduler(1, 1)
    member = Member()
    scheduler.starting(member)
    scheduler.let_go(member)
    scheduler.ready(member, 0.0)
    assert member.worker is None
    assert not scheduler.ledger.workers


# Idle workers


def test_workers_above_the_minimum_leave_when_they_have_been_idle_for_long() -> None:
    scheduler, _ = pool(1, 3, idle_timeout=10.0)
    job_of(scheduler, 3, pace=known(1.0))
    decisions = scheduler.decide(0.0)
    start(scheduler, decisions)
    first, *others = decisions.assign + scheduler.decide(0.0).assign
    for batch, now in zip(others, (1.0, 2.0), strict=True):
        answer(scheduler.ledger, batch, now)
    decisions = scheduler.decide(3.0)
    assert (decisions.dismiss, decisions.wake_at) == ([], 11.0)
    assert scheduler.decide(10.9).dismiss == []
    decisions = scheduler.decide(11.0)
    assert decisions.dismiss == [others[0].worker.key]
    assert decisions.wake_at == 12.0
    answer(scheduler.ledger, first, 11.5)
    decisions = scheduler.decide(12.0)
    assert decisions.dismiss == [others[1].worker.key]
    assert nothing(scheduler.decide(1000.0)), "the minimum stays"


def test_a_pool_whose_tasks_wait_until_results_are_read_shrinks_and_grows_again() -> None:
    scheduler, _ = pool(1, 3, idle_timeout=10.0)
    job = job_of(scheduler, 9, pace=known(1.0))
    start(scheduler, scheduler.decide(0.0))
    scheduler.decide(0.0)
    scheduler.ledger.pause(job, True)
    for batch in list(scheduler.ledger.batches.values()):
        answer(scheduler.ledger, batch, 1.0)
    decisions = scheduler.decide(11.0)
    assert (decisions.assign, decisions.start, len(decisions.dismiss)) == ([], 0, 2)
    scheduler.ledger.pause(job, False)
    assert scheduler.decide(12.0).start == 2


def test_a_worker_whose_host_ends_is_drained_once_and_replaced_at_once() -> None:
    scheduler, (member,) = pool(1)
    assert scheduler.drain(member)
    assert not scheduler.drain(member), "it leaves already"
    job_of(scheduler, 1)
    decisions = scheduler.decide(0.0)
    assert (decisions.assign, decisions.start) == ([], 1)
    scheduler.gone(member, 0.0)
    assert not scheduler.drain(member), "it is gone"


def test_without_an_idle_timeout_idle_workers_stay() -> None:
    scheduler, _ = pool(0, 2)
    job_of(scheduler, 2)
    start(scheduler, scheduler.decide(0.0))
    assert nothing(finish(scheduler, scheduler.decide(0.0), 0.0))
    assert nothing(scheduler.decide(1e9))


# Tasks that one worker alone may run


def test_a_task_for_each_worker_goes_to_those_that_are_starting_too() -> None:
    scheduler, members = pool(1, 2)
    late = Member()
    scheduler.starting(late)
    job = scheduler.ledger.open("owner")
    scheduler.pin_everywhere(job, "item")
    scheduler.ledger.close(job)
    (batch,) = scheduler.decide(0.0).assign
    assert batch.worker.key is members[0]
    answer(scheduler.ledger, batch)
    assert scheduler.decide(0.0).assign == []
    scheduler.ready(late, 0.0)
    (batch,) = scheduler.decide(0.0).assign
    assert batch.worker.key is late
    answer(scheduler.ledger, batch)
    assert job.finished


def test_the_pinned_task_of_a_lost_worker_goes_to_a_new_worker() -> None:
    scheduler, members = pool(1, 2)
    job = scheduler.ledger.open("owner")
    scheduler.pin_everywhere(job, "item")
    scheduler.ledger.close(job)
    scheduler.gone(members[0], 0.0)
    decisions = scheduler.decide(0.0)
    assert (decisions.start, decisions.assign) == (1, [])
    start(scheduler, decisions)
    assert len(scheduler.decide(0.0).assign) == 1


def test_a_job_that_needs_a_new_worker_fails_if_none_starts_although_others_work() -> None:
    scheduler, members = pool(2)
    pinned = scheduler.ledger.open("owner")
    scheduler.pin_everywhere(pinned, "item")
    other = job_of(scheduler, 1)
    scheduler.gone(members[0], 0.0)
    now = 0.0
    while not (decisions := scheduler.decide(now)).failed:
        for _ in range(decisions.start):
            member = Member()
            scheduler.starting(member)
            scheduler.gone(member, now, failure=RAISED)
        now += 0.1
        assert now < 60.0
    ((job, error),) = decisions.failed
    assert job is pinned
    assert "no such device" in str(error)
    assert other in scheduler.ledger.jobs
    assert scheduler.workers.error is None
    assert decisions.end == []


# Lending


def test_a_worker_is_leased_while_it_is_not_needed() -> None:
    scheduler, members = pool(1)
    worker = members[0].ready
    assert scheduler.lease(worker)
    assert not scheduler.lease(worker), "it is"
    assert nothing(scheduler.decide(0.0)), "and so it is not missing"
    assert not scheduler.needs_leased()
    job_of(scheduler, 1)
    assert scheduler.needs_leased()
    assert scheduler.decide(0.0).assign == []
    scheduler.return_idle(worker, 0.0)
    assert len(scheduler.decide(0.0).assign) == 1
    assert not scheduler.needs_leased()


def test_a_worker_with_possible_work_is_not_leased() -> None:
    scheduler, members = pool(1)
    job_of(scheduler, 2)
    assert not scheduler.lease(members[0].ready), "something waits"
    scheduler.decide(0.0)
    assert not scheduler.lease(members[0].ready), "it is busy"
    scheduler, members = pool(1)
    scheduler.close()
    assert not scheduler.lease(members[0].ready), "it is about to end"
    scheduler, members = pool(1, max_tasks=5)
    assert not scheduler.lease(members[0].ready), "its tasks are counted"


def test_a_closed_pool_needs_its_leased_workers() -> None:
    scheduler, members = pool(1)
    assert scheduler.lease(members[0].ready)
    scheduler.close()
    assert scheduler.needs_leased()
    assert not scheduler.decide(0.0).over
    scheduler.return_idle(members[0].ready, 0.0)
    assert scheduler.decide(0.0).dismiss == members


def test_a_leased_worker_counts_as_busy_when_more_are_wanted() -> None:
    scheduler, members = pool(1, 2)
    assert scheduler.lease(members[0].ready)
    job_of(scheduler, 1)
    assert scheduler.decide(0.0).start == 1


def test_a_worker_that_is_returned_while_it_runs_a_call() -> None:
    scheduler, members = pool(1)
    worker = members[0].ready
    assert scheduler.lease(worker)
    seq = scheduler.ledger.next_seq()
    job = scheduler.ledger.open("owner")
    scheduler.return_busy(worker, seq, job, "call", 0.0)
    scheduler.ledger.close(job)
    assert scheduler.ledger.leased == 0
    assert not scheduler.lease(worker)
    receipt = scheduler.ledger.receive(worker, seq, 0, 1, 0.0)
    assert receipt is not None
    assert (receipt.job, receipt.item(0), job.finished) == (job, "call", True)
    assert scheduler.lease(worker)


def test_a_returned_worker_that_runs_an_abandoned_call_is_dismissed_after_it() -> None:
    scheduler, members = pool(1)
    worker = members[0].ready
    assert scheduler.lease(worker)
    seq = scheduler.ledger.next_seq()
    scheduler.return_busy(worker, seq, None, None, 0.0)
    assert not scheduler.lease(worker)
    scheduler.close()
    assert scheduler.decide(0.0).dismiss == []
    assert scheduler.ledger.receive(worker, seq, 0, 1, 0.0) is None
    assert scheduler.decide(0.0).dismiss == members


def test_a_lost_leased_worker_is_replaced() -> None:
    scheduler, members = pool(1)
    worker = members[0].ready
    assert scheduler.lease(worker)
    scheduler.gone(members[0], 0.0)
    assert scheduler.ledger.leased == 0
    assert scheduler.decide(0.0).start == 1
    scheduler.return_idle(worker, 0.0)
    scheduler.return_busy(worker, 7, None, None, 0.0)
    assert scheduler.ledger.leased == 0
    assert scheduler.ledger.batches == {}
    assert scheduler.ledger.idle() == [], "who is gone cannot come back"


# The end


def test_a_closed_pool_finishes_its_tasks_and_then_ends() -> None:
    scheduler, members = pool(2)
    job_of(scheduler, 5)
    scheduler.close()
    decisions = scheduler.decide(0.0)
    assert (decisions.dismiss, decisions.over) == ([], False)
    decisions = finish(scheduler, decisions, 0.0)
    assert set(decisions.dismiss) == set(members)
    assert not decisions.over
    for member in members:
        scheduler.gone(member, 0.0)
    assert scheduler.decide(0.0) == Decisions([], [], 0, [], [], [], math.inf, True)


def test_a_closed_pool_replaces_workers_while_there_is_something_to_do() -> None:
    scheduler, members = pool(1)
    job_of(scheduler, 1)
    scheduler.decide(0.0)
    scheduler.close()
    scheduler.gone(members[0], 0.0)
    decisions = scheduler.decide(0.0)
    assert decisions.start == 1
    start(scheduler, decisions)
    decisions = finish(scheduler, scheduler.decide(0.0), 0.0)
    assert len(decisions.dismiss) == 1


def test_workers_that_are_starting_are_not_needed_by_a_closed_pool_without_work() -> None:
    scheduler = Scheduler(1, 1)
    member = Member()
    scheduler.starting(member)
    scheduler.close()
    decisions = scheduler.decide(0.0)
    assert decisions.dismiss == [member]
    assert scheduler.decide(0.0).dismiss == []
    scheduler.gone(member, 0.0)
    assert scheduler.decide(0.0).over


def test_a_pool_without_workers_that_is_closed_is_over() -> None:
    scheduler = Scheduler(0, 1)
    scheduler.close()
    assert scheduler.decide(0.0).over


def test_a_terminated_pool_ends_all_workers_and_starts_none() -> None:
    scheduler, members = pool(2)
    starting = Member()
    scheduler.starting(starting)
    job_of(scheduler, 100)
    assert set(scheduler.terminate()) == {*members, starting}
    assert all(member.leaving for member in (*members, starting))
    decisions = scheduler.decide(0.0)
    assert (decisions.start, decisions.over) == (0, False)
    for member in (*members, starting):
        scheduler.gone(member, 0.0, failure=RAISED)
    assert scheduler.decide(0.0).over
    assert scheduler.terminate() == []


# Giving up


def fail_all(scheduler: Scheduler, decisions: Decisions, now: float) -> None:
    for _ in range(decisions.start):
        member = Member()
        scheduler.starting(member)
        scheduler.gone(member, now, failure=RAISED)


def test_after_failures_the_scheduler_pauses_and_tries_one_worker() -> None:
    scheduler = Scheduler(3, 3)
    fail_all(scheduler, scheduler.decide(0.0), 0.0)
    decisions = scheduler.decide(0.0)
    assert (decisions.start, decisions.wake_at) == (0, FIRST_PAUSE)
    decisions = scheduler.decide(FIRST_PAUSE)
    assert (decisions.start, decisions.wake_at) == (1, math.inf)
    start(scheduler, decisions)
    assert scheduler.decide(FIRST_PAUSE).start == 2, "they can start again"


def test_if_no_worker_starts_all_jobs_fail_and_starting_workers_are_ended() -> None:
    scheduler = Scheduler(2, 2)
    job = job_of(scheduler, 5)
    slow = Member()
    scheduler.starting(slow)
    now = 0.0
    while scheduler.workers.error is None:
        member = Member()
        scheduler.starting(member)
        scheduler.gone(member, now, failure=RAISED)
        now += 0.1
    assert now > RAISED_PATIENCE
    decisions = scheduler.decide(now)
    assert decisions.failed == [(job, scheduler.workers.error)]
    assert decisions.end == [slow]
    assert (decisions.start, decisions.wake_at) == (0, math.inf)
    scheduler.ledger.cancel(job)
    decisions = scheduler.decide(now)
    assert (decisions.failed, decisions.end) == ([], []), "it is done"
    scheduler.gone(slow, now)
    assert not scheduler.decide(now).over, "nobody has closed it"
    scheduler.close()
    assert scheduler.decide(now).over


def test_workers_that_die_idle_are_replaced_slowly_without_giving_up() -> None:
    scheduler, members = pool(1)
    for _ in range(IDLE_DEATHS + 1):
        scheduler.gone(members[0], 0.0)
        decisions = scheduler.decide(0.0)
        assert decisions.start == 1
        members = start(scheduler, decisions)
    scheduler.gone(members[0], 0.0)
    decisions = scheduler.decide(0.0)
    assert (decisions.start, decisions.failed) == (0, [])
    assert decisions.wake_at < math.inf
    assert scheduler.decide(decisions.wake_at).start == 1
