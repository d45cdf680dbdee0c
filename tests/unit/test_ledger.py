"""The ledger: every task is in one place, and its result counts once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from fiber._engine.chunks import SLOW, Pace
from fiber._engine.ledger import PATIENCE, Batch, Job, Ledger, Worker


def known(seconds: float, largest: int = 10**4) -> Pace:
    pace = Pace()
    pace.observe(largest, seconds * largest)
    return pace


def ledger_with(workers: int, left: int | None = None) -> tuple[Ledger, list[Worker]]:
    ledger = Ledger()
    return ledger, [ledger.add(f"w{n}", 0.0, left) for n in range(workers)]


def job_of(ledger: Ledger, items: Sequence[Any], **options: Any) -> Job:
    job = ledger.open(**options)
    ledger.feed(job, items)
    ledger.close(job)
    return job


def assign_all(ledger: Ledger, now: float = 0.0) -> list[Batch]:
    batches = []
    while (batch := ledger.assign(now)) is not None:
        batches.append(batch)
    return batches


def answer(ledger: Ledger, batch: Batch, now: float = 0.0) -> list[int]:
    """The whole batch is done; returns the tasks whose results counted."""
    size = len(batch.items) - batch.received
    receipt = ledger.receive(batch.seq, batch.received, size, now, seconds=1e-3 * size)
    return list(range(receipt.start, receipt.start + receipt.size)) if receipt else []


def run_to_end(ledger: Ledger) -> list[int]:
    """Work everything off; returns the tasks in the order in which they were done."""
    done = []
    while batches := list(ledger.batches.values()) or assign_all(ledger):
        done += answer(ledger, batches[0])
        assign_all(ledger)
    return done


# Giving


def test_tasks_go_to_idle_workers_first_and_then_queue() -> None:
    ledger, workers = ledger_with(2)
    job_of(ledger, range(10))
    batches = assign_all(ledger)
    assert [len(batch.items) for batch in batches] == [1, 1, 1, 1]
    assert {batch.worker for batch in batches[:2]} == set(workers)
    assert all(len(worker.queue) == 2 for worker in workers)


def test_every_task_is_done_once_and_then_the_job_is_finished() -> None:
    ledger, _ = ledger_with(3)
    job = job_of(ledger, range(100))
    assert sorted(run_to_end(ledger)) == list(range(100))
    assert job.finished
    assert not ledger.jobs
    assert not ledger.batches


def test_a_job_without_tasks_is_finished_when_it_is_closed() -> None:
    ledger, _ = ledger_with(1)
    job = ledger.open()
    assert ledger.close(job)
    assert not ledger.jobs


def test_items_follow_their_tasks() -> None:
    ledger, _ = ledger_with(1)
    job_of(ledger, "abcdef", pace=known(1e-6))
    (batch,) = assign_all(ledger)
    assert (batch.start, list(batch.items)) == (0, list("abcdef"))


def test_tasks_fed_later_are_appended() -> None:
    ledger, _ = ledger_with(1)
    job = ledger.open(pace=known(1e-6))
    for block in ([0, 1], [2], [3, 4]):
        ledger.feed(job, block)
    batch = ledger.assign(0.0)
    assert batch is not None
    assert list(batch.items) == [0, 1, 2, 3, 4]


def test_memory_of_what_was_given_out_is_not_kept() -> None:
    ledger, _ = ledger_with(1)
    job = ledger.open(pace=known(1e-5))
    for n in range(20_000):
        ledger.feed(job, [n])
        for batch in assign_all(ledger):
            answer(ledger, batch)
    (stock,) = job.waiting._stocks or [[]]
    assert len(getattr(stock, "items", [])) < 5000


def test_slow_tasks_are_not_queued() -> None:
    ledger, _ = ledger_with(2)
    job_of(ledger, range(10), pace=known(2 * SLOW))
    assert len(assign_all(ledger)) == 2


def test_chunks_stay_whole() -> None:
    ledger, _ = ledger_with(2)
    job_of(ledger, range(100), unit=30)
    assert sorted(len(batch.items) for batch in assign_all(ledger)) == [10, 30, 30, 30]


def test_jobs_take_turns() -> None:
    ledger, _ = ledger_with(1)
    one, other = job_of(ledger, range(10)), job_of(ledger, range(10))
    order = []
    for _ in range(6):
        batches = assign_all(ledger)
        order += [batch.job for batch in batches]
        answer(ledger, next(iter(ledger.batches.values())))
    assert order[:6] == [one, other] * 3


def test_what_starting_workers_can_do_does_not_queue() -> None:
    ledger, _ = ledger_with(1)
    ledger.starting = 3
    job_of(ledger, range(4))
    assert len(assign_all(ledger)) == 1
    for n in range(3):
        ledger.starting -= 1
        ledger.add(f"late{n}", 0.0)
    assert len({batch.worker for batch in assign_all(ledger)}) == 3


def test_the_worker_that_was_busy_last_is_given_work_first() -> None:
    ledger, workers = ledger_with(3)
    job_of(ledger, range(1))
    (batch,) = assign_all(ledger)
    answer(ledger, batch)
    job_of(ledger, range(1))
    assert assign_all(ledger)[0].worker is batch.worker
    assert ledger.idle()[0] is not batch.worker
    assert set(ledger.idle()) == set(workers) - {batch.worker}


# Alone, pinned, limited


@pytest.mark.parametrize("options", [{"alone": True}, {"retries": 0}])
def test_tasks_that_travel_alone_go_to_idle_workers_only(options: dict[str, Any]) -> None:
    ledger, workers = ledger_with(2)
    job_of(ledger, range(10), pace=known(1e-6), **options)
    batches = assign_all(ledger)
    assert [len(batch.items) for batch in batches] == [1, 1]
    job_of(ledger, range(10), pace=known(1e-6))
    assert not assign_all(ledger), "something was queued behind a task that travels alone"
    assert all(len(worker.queue) == 1 for worker in workers)


def test_an_expired_task_of_a_cancelled_job_takes_its_worker_with_it() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(1), alone=True)
    (batch,) = assign_all(ledger)
    ledger.cancel(job)
    assert ledger.expire(batch.seq) is None
    assert worker.leaving


def test_pinned_tasks_run_on_their_worker() -> None:
    ledger, workers = ledger_with(3)
    job = ledger.open()
    for worker in workers:
        ledger.pin(job, worker, worker.key)
    ledger.close(job)
    batches = assign_all(ledger)
    assert all(batch.items == [batch.worker.key] for batch in batches)
    assert len(batches) == 3
    for batch in batches:
        answer(ledger, batch)
    assert job.finished


def test_a_pinned_task_waits_until_its_worker_is_idle() -> None:
    ledger, (worker,) = ledger_with(1)
    job_of(ledger, range(2))
    first, second = assign_all(ledger)
    job = ledger.open()
    ledger.pin(job, worker, "x")
    assert not assign_all(ledger)
    answer(ledger, first)
    assert not assign_all(ledger)
    answer(ledger, second)
    assert assign_all(ledger)[0].pin


def test_the_next_worker_takes_the_place_of_a_lost_one() -> None:
    ledger, (one, other) = ledger_with(2)
    job = ledger.open()
    ledger.pin(job, one, "a")
    ledger.pin(job, other, "b")
    ledger.close(job)
    batches = {batch.worker: batch for batch in assign_all(ledger)}
    ledger.lose(one, (), (batches[one].seq, 0))
    assert not assign_all(ledger)
    late = ledger.add("late", 0.0)
    (batch,) = assign_all(ledger)
    assert (batch.worker, batch.items) == (late, ["a"])


def test_a_new_worker_adopts_one_task_of_each_broadcast() -> None:
    ledger, _ = ledger_with(0)
    job = ledger.open()
    ledger.pin(job, None, "a")
    ledger.pin(job, None, "b")
    ledger.close(job)
    assert ledger.demand() == 2
    ledger.add("w0", 0.0)
    assert len(assign_all(ledger)) == 1
    ledger.add("w1", 0.0)
    assert len(assign_all(ledger)) == 1


def test_a_worker_is_given_no_more_than_it_may_do() -> None:
    ledger, (worker,) = ledger_with(1, left=3)
    job_of(ledger, range(10), pace=known(1e-6))
    (batch,) = assign_all(ledger)
    assert len(batch.items) == 3
    assert ledger.spent() == []
    answer(ledger, batch)
    assert ledger.spent() == [worker]
    assert ledger.spent() == [], "told twice"
    assert not assign_all(ledger)


def test_pinned_tasks_of_a_worker_that_is_spent_are_for_another() -> None:
    ledger, (worker,) = ledger_with(1, left=1)
    job_of(ledger, range(1))
    (batch,) = assign_all(ledger)
    job = ledger.open()
    ledger.pin(job, worker, "x")
    answer(ledger, batch)
    assert ledger.spent() == [worker]
    assert ledger.homeless() == [job]
    ledger.add("next", 0.0)
    assert assign_all(ledger)[0].items == ["x"]


def test_units_of_cancelled_batches_may_be_given_again() -> None:
    ledger, (worker,) = ledger_with(1, left=2)
    job = job_of(ledger, range(10))
    first, second = assign_all(ledger)
    ledger.cancel(job)
    ledger.put_back(worker, [first.seq, second.seq], 0.0)
    assert worker.left == 2
    assert ledger.spent() == []


def test_a_chunk_counts_as_one() -> None:
    ledger, (worker,) = ledger_with(1, left=2)
    job_of(ledger, range(100), unit=10, pace=known(1e-6))
    assert len(assign_all(ledger)[0].items) == 20
    assert worker.left == 0


def test_what_comes_back_unread_may_be_given_again() -> None:
    ledger, (worker,) = ledger_with(1, left=2)
    job_of(ledger, range(10))
    _, second = assign_all(ledger)
    ledger.put_back(worker, [second.seq], 0.0)
    assert worker.left == 1


# Taking


def test_results_may_come_in_pieces() -> None:
    ledger, _ = ledger_with(1)
    job = job_of(ledger, range(10), pace=known(1e-6))
    (batch,) = assign_all(ledger)
    first = ledger.receive(batch.seq, 0, 4, 0.0)
    rest = ledger.receive(batch.seq, 4, 6, 0.0)
    assert first is not None
    assert rest is not None
    assert [(first.start, first.size), (rest.start, rest.size)] == [(0, 4), (4, 6)]
    assert job.finished


def test_duplicate_late_and_foreign_results_do_not_count() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(10), pace=known(1e-6))
    (batch,) = assign_all(ledger)
    assert ledger.receive(batch.seq, 0, 4, 0.0)
    assert ledger.receive(batch.seq, 0, 4, 0.0) is None, "a duplicate counted"
    assert ledger.receive(batch.seq, 5, 1, 0.0) is None, "results with a gap counted"
    assert ledger.receive(batch.seq, 4, 7, 0.0) is None, "more results than tasks counted"
    assert ledger.receive(batch.seq + 1, 0, 1, 0.0) is None, "an unknown batch counted"
    ledger.lose(worker, (), None)
    assert ledger.receive(batch.seq, 4, 6, 0.0) is None, "a late result counted"
    assert job.done == 4


def test_a_worker_gives_back_what_it_has_not_begun() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(10), pace=known(1e-6))
    (batch,) = assign_all(ledger)
    ledger.receive(batch.seq, 0, 2, 0.0, kept=3)
    assert len(worker.queue) == 1
    assert len(job.waiting) == 7
    other = ledger.add("other", 0.0)
    again = next(batch for batch in assign_all(ledger) if batch.worker is other)
    assert again.start == 3
    assert answer(ledger, batch) == [2]
    assert sorted([0, 1, 2, *run_to_end(ledger)]) == list(range(10))


def test_giving_back_without_results() -> None:
    ledger, _ = ledger_with(1)
    job = job_of(ledger, range(10), pace=known(1e-6))
    (batch,) = assign_all(ledger)
    receipt = ledger.receive(batch.seq, 0, 0, 0.0, kept=1)
    assert receipt is not None
    assert receipt.size == 0
    assert len(job.waiting) == 9


def test_retry_runs_a_task_again_until_it_had_its_tries() -> None:
    ledger, _ = ledger_with(1)
    job = job_of(ledger, ["a", "b"], pace=known(1e-6), retries=2)
    for attempt in range(3):
        (batch,) = assign_all(ledger)
        assert "b" in batch.items
        receipt = ledger.receive(batch.seq, 0, len(batch.items), 0.0)
        assert receipt is not None
        assert ledger.retry(receipt, 1) == (attempt < 2)
    assert job.finished


def test_retry_of_a_cancelled_job_is_refused() -> None:
    ledger, _ = ledger_with(1)
    job = job_of(ledger, range(2))
    batch = assign_all(ledger)[0]
    receipt = ledger.receive(batch.seq, 0, 1, 0.0)
    assert receipt is not None
    ledger.cancel(job)
    assert not ledger.retry(receipt, 0)


# Taking back


def test_idle_workers_ask_for_what_others_have_not_begun() -> None:
    ledger, (one, other) = ledger_with(2)
    job_of(ledger, range(4))
    batches = assign_all(ledger)
    for batch in batches:
        if batch.worker is one:
            answer(ledger, batch)
    assert ledger.recall(PATIENCE / 2) == []
    assert ledger.next_recall() == pytest.approx(PATIENCE)
    assert ledger.recall(PATIENCE) == [other]
    assert ledger.recall(PATIENCE) == [], "asked twice"
    ledger.put_back(other, [other.queue[1].seq], PATIENCE)
    (stolen,) = assign_all(ledger)
    assert stolen.worker is one


def test_who_does_not_answer_does_not_keep_others_from_being_asked() -> None:
    ledger, (one, other, third) = ledger_with(3)
    job_of(ledger, range(6))
    for batch in assign_all(ledger):
        if batch.worker is one:
            answer(ledger, batch)
    assert len(ledger.recall(PATIENCE)) == 1
    assert len(ledger.recall(PATIENCE)) == 1
    assert other.recalled
    assert third.recalled
    assert ledger.next_recall() is None


def test_the_time_to_ask_is_the_time_that_was_said() -> None:
    ledger, (one, other) = ledger_with(2)
    job_of(ledger, range(4))
    for batch in assign_all(ledger):
        if batch.worker is one:
            answer(ledger, batch)
    other.since = 17.26  # 17.26 + PATIENCE - 17.26 < PATIENCE
    due = ledger.next_recall()
    assert due is not None
    assert ledger.recall(due) == [other]


def test_nothing_is_asked_for_while_something_waits() -> None:
    ledger, (one, _) = ledger_with(2)
    job_of(ledger, range(4), pace=known(2 * SLOW))
    assign_all(ledger)
    answer(ledger, one.queue[0])
    assert ledger.recall(1.0) == []


def test_an_empty_answer_to_a_recall_changes_nothing() -> None:
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
    ledger.put_back(worker, [unread.seq], 0.0)
    assert answer(ledger, running) == []
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


def test_an_expired_task_is_done_and_its_worker_is_given_nothing() -> None:
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
    job = job_of(ledger, range(10), pace=known(1e-4), exact=True)
    batch, *unread = assign_all(ledger)
    assert len(batch.items) > 4
    ledger.receive(batch.seq, 0, 2, 0.0)
    ledger.lose(worker, [other.seq for other in unread], (batch.seq, 3))
    assert job.attempts == {3: 1}
    ledger.add("next", 0.0)
    spans = []
    while len(spans) < 3:
        batches = assign_all(ledger)
        spans += [(b.start, len(b.items)) for b in batches]
        for b in batches:
            answer(ledger, b)
    assert spans[0] == (2, 1), "what was done before it, without a result, comes first"
    assert spans[1] == (3, 1), "the suspect does not run alone"
    assert spans[2][0] == 4


def test_of_very_short_tasks_a_stride_is_suspect() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(1000), pace=known(1e-5))
    batch, _ = assign_all(ledger)
    assert batch.stride > 1
    ledger.lose(worker, (), (batch.seq, batch.stride))
    assert sorted(job.attempts) == list(range(batch.stride, 2 * batch.stride))


def test_results_that_came_clear_of_suspicion() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(10), pace=known(1e-4), exact=True)
    batch = assign_all(ledger)[0]
    ledger.receive(batch.seq, 0, 2, 0.0)
    ledger.lose(worker, (), (batch.seq, 0))
    assert job.attempts == {}


@pytest.mark.parametrize("running", [None, (10**6, 0)])
def test_without_a_note_all_tasks_of_the_batch_are_suspect(
    running: tuple[int, int] | None,
) -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(10), pace=known(1e-4))
    batch, queued = assign_all(ledger)
    ledger.lose(worker, (), running)
    assert job.attempts == dict.fromkeys(range(len(batch.items)), 1)
    assert len(job.waiting) == 10
    assert len(queued.items) > 0


def test_a_task_that_kills_every_worker_has_its_tries_and_no_more() -> None:
    ledger, _ = ledger_with(0)
    job = job_of(ledger, ["good", "bad", "good"], retries=2)
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
    assert [(loss.task, loss.attempts, loss.item) for loss in losses] == [(1, 3, "bad")]


def test_without_retries_a_task_runs_once() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, ["a", "b"], retries=0)
    (batch,) = assign_all(ledger)
    (loss,) = ledger.lose(worker, (), (batch.seq, 0))
    assert (loss.task, loss.attempts) == (0, 1)
    assert len(job.waiting) == 1


def test_a_worker_lost_with_nothing_to_do_costs_nothing() -> None:
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


def test_demand_counts_what_waits_and_what_runs() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(10))
    assign_all(ledger)
    ledger.pin(job, worker, "x")
    assert ledger.demand() == 11
    assert ledger.hungry() is False
