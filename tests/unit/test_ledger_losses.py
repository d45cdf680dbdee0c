"""The ledger: what comes back, what is lost, who leaves."""

from __future__ import annotations

import pytest

from fiber._engine.chunks import SLOW
from fiber._engine.load import RECALL_AFTER
from fiber._engine.tasks import Limits
from unit.ledger_steps import answer, assign_all, job_of, known, ledger_with, run_to_end

# Taking back


def test_idle_workers_ask_for_tasks_that_others_have_not_begun() -> None:
    ledger, (one, other) = ledger_with(2)
    job_of(ledger, range(4))
    batches = assign_all(ledger)
    for batch in batches:
        if batch.worker is one:
            answer(ledger, batch)
    assert ledger.recall(RECALL_AFTER / 2) == []
    assert ledger.next_recall() == pytest.approx(RECALL_AFTER)
    assert ledger.recall(RECALL_AFTER) == [other]
    assert ledger.recall(RECALL_AFTER) == [], "asked twice"
    ledger.put_back(other, [other.queue[1].seq], RECALL_AFTER)
    (stolen,) = assign_all(ledger)
    assert stolen.worker is one


def test_a_worker_without_an_answer_does_not_keep_others_from_being_asked() -> None:
    ledger, (one, other, third) = ledger_with(3)
    job_of(ledger, range(6))
    for batch in assign_all(ledger):
        if batch.worker is one:
            answer(ledger, batch)
    assert len(ledger.recall(RECALL_AFTER)) == 1
    assert len(ledger.recall(RECALL_AFTER)) == 1
    assert other.recalled
    assert third.recalled
    assert ledger.next_recall() is None


def test_the_time_to_ask_is_the_time_that_was_said() -> None:
    ledger, (one, other) = ledger_with(2)
    job_of(ledger, range(4))
    for batch in assign_all(ledger):
        if batch.worker is one:
            answer(ledger, batch)
    other.since = 17.26  # 17.26 + RECALL_AFTER - 17.26 < RECALL_AFTER
    due = ledger.next_recall()
    assert due is not None
    assert ledger.recall(due) == [other]


def test_no_recall_is_sent_while_tasks_wait() -> None:
    ledger, (one, _) = ledger_with(2)
    job_of(ledger, range(4), pace=known(2 * SLOW))
    assign_all(ledger)
    answer(ledger, one.queue[0])
    assert ledger.recall(1.0) == []


def test_an_empty_answer_to_a_recall_changes_no_task() -> None:
    ledger, (worker, _) = ledger_with(2)
    job_of(ledger, range(4))
    assign_all(ledger)
    worker.recalled = True
    ledger.put_back(worker, [], 0.0)
    assert not worker.recalled
    assert len(worker.queue) == 2


def test_put_back_ignores_batches_of_others() -> None:
    ledger, (one, other) = ledger_with(2)
    job_of(ledger, range(4))
    assign_all(ledger)
    ledger.put_back(one, [other.queue[1].seq], 0.0)
    assert len(other.queue) == 2


def test_tasks_that_come_back_are_the_next_to_be_given() -> None:
    ledger, (worker,) = ledger_with(1)
    job_of(ledger, range(10))
    first, second = assign_all(ledger)
    ledger.put_back(worker, [first.seq, second.seq], 0.0)
    assert [batch.start for batch in assign_all(ledger)] == [0, 1]


def test_an_unreadable_batch_is_sent_again_one_by_one() -> None:
    ledger, _ = ledger_with(1)
    job = job_of(ledger, range(5), pace=known(1e-6))
    (batch,) = assign_all(ledger)
    assert ledger.split(batch.seq, 0.0) is None
    for task in range(5):
        (single,) = assign_all(ledger)
        assert (single.start, len(single.items)) == (task, 1)
        if task == 3:
            culprit = ledger.split(single.seq, 0.0)
            assert culprit is not None
            assert culprit.start == 3
        else:
            answer(ledger, single)
    assert job.finished


def test_a_cancelled_job_is_forgotten() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(10))
    running, unread = assign_all(ledger)
    assert ledger.cancel(job) == [worker]
    assert not assign_all(ledger)
    assert ledger.demand() == 2, "they still hold up a worker"
    ledger.put_back(worker, [unread.seq], 0.0)
    assert answer(ledger, running) == []
    assert ledger.demand() == 0
    assert not job.waiting
    assert ledger.idle() == [worker], "the worker is not free for other work"


def test_a_cancelled_broadcast_is_forgotten() -> None:
    ledger, (worker,) = ledger_with(1)
    job = ledger.open()
    ledger.pin(job, worker, "a")
    ledger.pin(job, None, "b")
    ledger.cancel(job)
    ledger.add("late", 0.0)
    assert not assign_all(ledger)


def test_items_of_unfinished_tasks() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, "abcd")
    first, _ = assign_all(ledger)
    answer(ledger, first)
    ledger.pin(job, worker, "p")
    ledger.pin(job, None, "q")
    assert sorted(ledger.unfinished(job)) == ["b", "c", "d", "p", "q"]


def test_an_expired_task_is_done_and_its_worker_gets_no_more() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(2), alone=True)
    (batch,) = assign_all(ledger)
    receipt = ledger.expire(batch.seq)
    assert receipt is not None
    assert job.done == 1
    assert answer(ledger, batch) == [], "the result of an expired task counted"
    assert not assign_all(ledger)
    assert ledger.lose(worker, (), (batch.seq, 0)) == []
    assert ledger.expire(batch.seq) is None


# Losing


def test_a_lost_worker_s_tasks_run_elsewhere() -> None:
    ledger, (one, _) = ledger_with(2)
    job_of(ledger, range(20))
    assign_all(ledger)
    running, unread = one.queue
    assert ledger.lose(one, [unread.seq], (running.seq, 0)) == []
    assert sorted(run_to_end(ledger)) == list(range(20))


def test_only_the_running_task_is_charged() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(10), pace=known(1e-4), eager=True)
    batch, *unread = assign_all(ledger)
    assert len(batch.items) > 4
    ledger.receive(batch.worker, batch.seq, 0, 2, 0.0)
    ledger.lose(worker, [other.seq for other in unread], (batch.seq, 3))
    assert job.charges.deaths == {3: 1}
    ledger.add("next", 0.0)
    spans: list[tuple[int, int]] = []
    while len(spans) < 3:
        batches = assign_all(ledger)
        spans += [(b.start, len(b.items)) for b in batches]
        for b in batches:
            answer(ledger, b)
    assert spans[0] == (2, 1), "what was done before it, without a result, comes first"
    assert spans[1] == (3, 1), "the suspect does not run alone"
    assert spans[2][0] == 4


def test_a_death_is_charged_to_the_whole_stride_of_very_short_tasks() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(1000), pace=known(1e-5))
    batch, _ = assign_all(ledger)
    assert batch.stride > 1
    ledger.lose(worker, (), (batch.seq, batch.stride))
    assert sorted(job.charges.deaths) == list(range(batch.stride, 2 * batch.stride))


def test_results_that_came_clear_of_suspicion() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(10), pace=known(1e-4), eager=True)
    batch = assign_all(ledger)[0]
    ledger.receive(batch.worker, batch.seq, 0, 2, 0.0)
    ledger.lose(worker, (), (batch.seq, 0))
    assert job.charges.deaths == {}


@pytest.mark.parametrize("running", [None, (10**6, 0)])
def test_without_a_note_all_tasks_of_the_batch_are_suspect(
    running: tuple[int, int] | None,
) -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(10), pace=known(1e-4))
    batch, queued = assign_all(ledger)
    ledger.lose(worker, (), running)
    assert job.charges.deaths == dict.fromkeys(range(len(batch.items)), 1)
    assert len(job.waiting) == 10
    assert len(queued.items) > 0


def test_a_task_that_kills_every_worker_has_its_tries_and_no_more() -> None:
    ledger, _ = ledger_with(0)
    job = job_of(ledger, ["good", "bad", "good"], limits=Limits(2))
    deaths = 0
    losses = []
    while not job.finished:
        worker = ledger.add("w", 0.0)
        assign_all(ledger)
        while worker.queue and "bad" not in worker.queue[0].items:
            answer(ledger, worker.queue[0])
            assign_all(ledger)
        if not worker.queue:
            continue
        deaths += 1
        batch = worker.queue[0]
        unread = [b.seq for b in list(worker.queue)[1:]]
        losses += ledger.lose(worker, unread, (batch.seq, list(batch.items).index("bad")))
    assert deaths == 3
    assert [(loss.task, loss.counts.deaths, loss.item) for loss in losses] == [(1, 3, "bad")]


def test_without_retries_a_task_runs_once() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, ["a", "b"], limits=Limits(0))
    (batch,) = assign_all(ledger)
    (loss,) = ledger.lose(worker, (), (batch.seq, 0))
    assert (loss.task, loss.counts.deaths) == (0, 1)
    assert len(job.waiting) == 1


def test_the_loss_of_an_idle_worker_costs_no_attempt() -> None:
    ledger, (worker,) = ledger_with(1)
    assert ledger.lose(worker, (), (1, 0)) == []
    assert ledger.idle() == []
    assert not ledger.workers


# Leaving


def test_a_busy_worker_does_not_leave() -> None:
    ledger, (worker,) = ledger_with(1)
    job_of(ledger, range(1))
    (batch,) = assign_all(ledger)
    assert not ledger.leave(worker)
    answer(ledger, batch)
    assert ledger.leave(worker)
    job_of(ledger, range(1))
    assert not assign_all(ledger)


def test_demand_counts_waiting_and_running_tasks() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(10))
    assign_all(ledger)
    ledger.pin(job, worker, "x")
    assert ledger.demand() == 11
    assert ledger.assign(0.0) is None


def test_demand_counts_the_tasks_of_a_chunk_as_one() -> None:
    ledger, _ = ledger_with(2)
    job_of(ledger, range(50), unit=24)
    assert ledger.demand() == 3, "two whole chunks and one of two tasks"
    batches = assign_all(ledger)
    assert ledger.demand() == 3
    ledger.receive(batches[0].worker, batches[0].seq, 0, 23, 0.0)
    assert ledger.demand() == 3, "the chunk is not done"
    answer(ledger, batches[0])
    assert ledger.demand() == 2


def test_demand_counts_each_suspect_of_a_lost_chunk() -> None:
    ledger, (worker,) = ledger_with(1)
    job_of(ledger, range(24), unit=24)
    (batch,) = assign_all(ledger)
    ledger.lose(worker, [], (batch.seq, 0))
    alone = batch.stride
    assert ledger.demand() == (alone if alone == 24 else alone + 1)


def test_demand_counts_the_tasks_that_a_worker_gives_back_by_chunks() -> None:
    ledger, (worker,) = ledger_with(1)
    job_of(ledger, range(6), unit=2, pace=known(1e-6))
    (batch,) = assign_all(ledger)
    assert (len(batch.items), ledger.demand()) == (6, 3)
    ledger.receive(worker, batch.seq, 0, 2, 0.0, kept=2)
    assert ledger.demand() == 2


def test_demand_counts_no_task_whose_time_is_over() -> None:
    ledger, _ = ledger_with(1)
    job_of(ledger, ["a", "b"], unit=2, alone=True)
    (batch,) = assign_all(ledger)
    assert ledger.demand() == 2
    ledger.expire(batch.seq)
    assert ledger.demand() == 1


def test_demand_counts_no_tasks_that_wait_until_results_are_read() -> None:
    ledger, _ = ledger_with(2)
    job = job_of(ledger, range(10), pace=known(2 * SLOW))
    first, second = assign_all(ledger)
    ledger.pause(job, True)
    assert ledger.demand() == 2
    ledger.lose(first.worker, [first.seq], None)
    assert ledger.demand() == 2, "a task that comes back does not wait for that"
    answer(ledger, second)
    (again,) = assign_all(ledger)
    assert again.start == first.start
    answer(ledger, again)
    assert ledger.demand() == 0
    ledger.pause(job, False)
    assert ledger.demand() == 8
    ledger.pause(job, True)
    ledger.cancel(job)
    assert ledger.demand() == 0


def test_a_paused_job_assigns_only_tasks_that_came_back() -> None:
    ledger, _ = ledger_with(2)
    job = ledger.open(pace=known(SLOW / 10))
    ledger.feed(job, ["a", "b"])
    given = assign_all(ledger)
    ledger.pause(job, True)
    for batch in reversed(given):
        ledger.put_back(batch.worker, [batch.seq], 0.0)
    ledger.feed(job, ["c"] * 100)
    again = assign_all(ledger)
    assert [item for batch in again for item in batch.items] == ["a", "b"]
