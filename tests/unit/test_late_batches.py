"""The ledger: no task waits for long behind another one that takes long."""

from __future__ import annotations

import pytest

from fiber._engine.ledger import Ledger
from fiber._engine.load import CHECK_EVERY, LATE_AFTER, LATE_TIMES, RECALL_AFTER
from fiber._engine.tasks import Batch, WorkerEntry
from unit.ledger_steps import answer, assign_all, job_of, known, ledger_with, run_to_end

PAST = 10 * LATE_AFTER
"""A time at which each batch is late that was assigned at 0, if its tasks are short."""


def recall(ledger: Ledger, now: float) -> list[WorkerEntry]:
    """Have the ledger look for late batches, also if the next check is later."""
    ledger.recall(now)
    return ledger.recall(now + CHECK_EVERY)


def put_back(ledger: Ledger, worker: WorkerEntry, now: float = PAST) -> None:
    """Answer a recall: the worker has not read its second batch."""
    ledger.put_back(worker, [worker.queue[1].seq], now)


def full(workers: int, tasks: int) -> tuple[Ledger, list[WorkerEntry]]:
    """Return a ledger whose workers have two batches of one task each, while others wait."""
    ledger, entries = ledger_with(workers)
    job_of(ledger, range(tasks))
    assign_all(ledger)
    assert ledger.recall(0.0) == []
    return ledger, entries


def starts(batches: list[Batch]) -> list[int]:
    return [batch.start for batch in batches]


def test_an_unread_task_behind_a_late_one_is_recalled_while_others_wait() -> None:
    ledger, (late, other) = full(2, 100)
    answer(ledger, other.queue[0], PAST)
    assign_all(ledger, PAST)
    assert ledger.has_assignable()
    assert ledger.recall(PAST) == [late]
    assert late not in recall(ledger, PAST), "asked twice"


def test_the_ledger_looks_for_late_batches_at_the_time_that_it_said() -> None:
    ledger, workers = full(2, 100)
    due = ledger.next_recall()
    assert due == CHECK_EVERY
    assert ledger.recall(due / 2) == []
    assert ledger.next_recall() == due
    assert set(ledger.recall(due)) == set(workers)


def test_there_is_no_time_to_look_while_no_batch_is_unread() -> None:
    ledger, _ = ledger_with(2)
    job_of(ledger, range(2))
    assign_all(ledger)
    assert ledger.recall(0.0) == []
    assert ledger.next_recall() is None
    assert ledger.recall(PAST) == []
    assert ledger.next_recall() is None


def test_nobody_looks_for_late_batches_of_the_only_worker() -> None:
    ledger, _ = full(1, 100)
    assert ledger.next_recall() is None
    assert recall(ledger, PAST) == []
    assert ledger.next_recall() is None


def test_recalled_batches_call_for_no_further_look() -> None:
    ledger, workers = full(2, 100)
    assert set(ledger.recall(PAST)) == set(workers)
    assert ledger.next_recall() is None
    for worker in workers:
        put_back(ledger, worker)
    assert ledger.recall(PAST) == []
    assert ledger.next_recall() is None


def test_a_batch_that_takes_as_long_as_predicted_is_not_late() -> None:
    ledger, workers = ledger_with(2)
    predicted = 10 * 20e-3
    job_of(ledger, range(100), unit=10, pace=known(20e-3))
    assign_all(ledger)
    due = LATE_TIMES * predicted
    assert recall(ledger, due - CHECK_EVERY - 1e-6) == []
    assert set(recall(ledger, due)) == set(workers)


def test_a_late_worker_gets_nothing_more_until_it_answers() -> None:
    ledger, (late, other) = full(2, 100)
    answer(ledger, other.queue[0], PAST)
    assign_all(ledger, PAST)
    ledger.recall(PAST)
    put_back(ledger, late)
    answer(ledger, other.queue[0], PAST)
    assert {batch.worker for batch in assign_all(ledger, PAST)} == {other}
    assert len(late.queue) == 1
    answer(ledger, late.queue[0], PAST)
    assert late in [batch.worker for batch in assign_all(ledger, PAST)]
    assert len(late.queue) == 2


def test_recalled_tasks_are_the_next_to_be_sent() -> None:
    ledger, (late, other) = full(2, 100)
    unread = late.queue[1].start
    ledger.recall(PAST)
    put_back(ledger, late)
    answer(ledger, other.queue[0], PAST)
    assert starts(assign_all(ledger, PAST))[0] == unread


def test_recalled_tasks_go_before_those_of_other_jobs() -> None:
    ledger, workers = ledger_with(2)
    job_of(ledger, range(2))
    assign_all(ledger)
    one = job_of(ledger, ["one"])
    (unread,) = assign_all(ledger)
    late = unread.worker
    (free,) = (worker for worker in workers if worker is not late)
    for _ in range(10):
        job_of(ledger, range(100))
    assign_all(ledger)
    ledger.recall(0.0)
    assert late in ledger.recall(PAST)
    put_back(ledger, late)
    answer(ledger, free.queue[0], PAST)
    assert next(iter(assign_all(ledger, PAST))).job is one


def test_a_recall_gives_a_job_its_turn_back_and_no_more() -> None:
    ledger, (late, other) = full(2, 100)
    job = late.queue[0].job
    rival = job_of(ledger, range(100))
    ledger.recall(PAST)
    put_back(ledger, late)
    taken = []
    for _ in range(8):
        answer(ledger, other.queue[0], PAST)
        taken += [batch.job for batch in assign_all(ledger, PAST)]
    assert taken == [job, rival] * 4


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_tasks_come_back_in_the_order_of_the_job_whoever_answers_first(
    order: tuple[int, ...],
) -> None:
    ledger, workers = full(4, 100)
    *late, free = workers
    unread = sorted(worker.queue[1].start for worker in late)
    ledger.recall(PAST)
    for at in order:
        put_back(ledger, late[at])
    found: list[int] = []
    while len(found) < len(unread):
        answer(ledger, free.queue[0], PAST)
        found += starts(assign_all(ledger, PAST))
    assert found[: len(unread)] == unread


def test_a_recall_may_come_after_the_worker_has_read_the_batch() -> None:
    ledger, (late, _) = full(2, 20)
    ledger.recall(PAST)
    done = answer(ledger, late.queue[0], PAST)
    assign_all(ledger, PAST)
    ledger.put_back(late, [], PAST)
    assert len(late.queue) == 2
    assert sorted(done + run_to_end(ledger)) == list(range(20))


def test_a_batch_that_was_sent_after_the_recall_may_come_back_with_the_answer() -> None:
    ledger, (late, _) = full(2, 20)
    ledger.recall(PAST)
    done = answer(ledger, late.queue[0], PAST)
    assign_all(ledger, PAST)
    ledger.put_back(late, [batch.seq for batch in late.queue], PAST)
    assert not late.queue
    assert sorted(done + run_to_end(ledger)) == list(range(20))


def test_a_worker_that_dies_before_its_answer_loses_no_task() -> None:
    ledger, (late, _) = full(2, 20)
    ledger.recall(PAST)
    running, unread = late.queue
    assert ledger.lose(late, [unread.seq], (running.seq, 0)) == []
    ledger.put_back(late, [unread.seq], PAST)
    assert ledger.next_recall() is None
    assert sorted(run_to_end(ledger)) == list(range(20))


def test_recalled_tasks_do_not_count_for_maxtasksperchild() -> None:
    ledger, (late, _) = ledger_with(2, left=2)
    job_of(ledger, range(20))
    assign_all(ledger)
    ledger.recall(0.0)
    ledger.recall(PAST)
    assert late.left == 0
    put_back(ledger, late)
    assert late.left == 1
    answer(ledger, late.queue[0], PAST)
    assert ledger.spent() == []
    assign_all(ledger, PAST)
    assert [len(late.queue), late.left] == [1, 0]


def test_a_new_worker_gets_the_recalled_task_first() -> None:
    ledger, (late, _) = full(2, 100)
    unread = late.queue[1].start
    ledger.recall(PAST)
    put_back(ledger, late)
    new = ledger.add("new", PAST)
    assert assign_all(ledger, PAST)[0].worker is new
    assert new.queue[0].start == unread


def test_a_leaving_worker_is_asked_too() -> None:
    ledger, (late, _) = full(2, 100)
    ledger.retire(late)
    assert late in ledger.recall(PAST)


def test_an_idle_worker_still_asks_at_once() -> None:
    ledger, (busy, idle) = full(2, 4)
    for batch in list(idle.queue):
        answer(ledger, batch)
    assert ledger.next_recall() == RECALL_AFTER
    assert ledger.recall(RECALL_AFTER) == [busy]


def test_a_task_runs_if_one_worker_does_not_wait_for_it() -> None:
    """All other workers run a task that waits for the one that is unread at the first of them."""
    ledger, workers = full(4, 10_000)
    *waiting, free = workers
    wanted = waiting[0].queue[1].start
    now = 0.0
    while all(wanted not in range(batch.start, batch.stop) for batch in free.queue):
        assert now < (len(workers) + 1) * (LATE_AFTER + CHECK_EVERY), "it waits for ever"
        now += 1e-3
        answer(ledger, free.queue[0], now)
        assign_all(ledger, now)
        for worker in ledger.recall(now):
            put_back(ledger, worker, now)
        assign_all(ledger, now)
