"""The ledger: every task is in one place, and its result counts once."""

from __future__ import annotations

import sys
from types import FrameType
from typing import Any

import pytest

from fiber._engine.chunks import SLOW
from fiber._engine.tasks import Limits, WrongAnswer
from unit.ledger_steps import answer, assign_all, job_of, known, ledger_with, run_to_end

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


def test_memory_of_assigned_tasks_is_released() -> None:
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


@pytest.mark.parametrize("needs", ["alone", "slow"])
def test_a_job_that_needs_an_idle_worker_gets_one(needs: str) -> None:
    ledger, (worker,) = ledger_with(1)
    big = job_of(ledger, range(1000))
    assign_all(ledger)
    small = job_of(ledger, ["x"], alone=needs == "alone", pace=known(2 * SLOW))
    given = []
    for _ in range(5):
        given += [batch.job for batch in assign_all(ledger)]
        answer(ledger, worker.queue[0])
    assert small in given, "the worker is always given more, and never idle"
    assert given.count(big) >= 2


def test_tasks_that_starting_workers_can_run_do_not_queue() -> None:
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


@pytest.mark.parametrize("options", [{"alone": True}, {"limits": Limits(0)}])
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


@pytest.mark.parametrize("others_idle", [True, False])
def test_to_look_for_a_pinned_task_takes_the_same_however_many_workers_there_are(
    others_idle: bool,
) -> None:
    def steps(workers: int) -> int:
        ledger, busy = ledger_with(workers)
        job_of(ledger, range(workers), alone=True)
        assert len(assign_all(ledger)) == workers
        for worker in busy:
            ledger.pin(ledger.open(), worker, "x")
        for number in range(workers if others_idle else 0):
            ledger.add(f"idle {number}", 0.0)
        taken: list[str] = []

        def trace(frame: FrameType, event: str, _arg: Any) -> Any:
            if "_engine" not in frame.f_code.co_filename:
                return None  # a finalizer that the garbage collector has just run
            frame.f_trace_opcodes = True
            taken.append(event)
            return trace

        before = sys.gettrace()
        sys.settrace(trace)
        try:
            assert ledger.assign(0.0) is None
        finally:
            sys.settrace(before)
        return len(taken)

    assert steps(100) == steps(3) > 0


def test_a_pinned_task_that_is_cancelled_is_not_looked_for() -> None:
    ledger, (worker,) = ledger_with(1)
    job = ledger.open()
    ledger.pin(job, worker, "x")
    ledger.cancel(job)
    assert assign_all(ledger) == []


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
    assert ledger.jobs_for_newcomers() == {job}
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


def test_unread_tasks_may_be_assigned_again() -> None:
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
    first = ledger.receive(batch.worker, batch.seq, 0, 4, 0.0)
    rest = ledger.receive(batch.worker, batch.seq, 4, 6, 0.0)
    assert first is not None
    assert rest is not None
    assert [(first.start, first.size), (rest.start, rest.size)] == [(0, 4), (4, 6)]
    assert job.finished


def test_repeated_and_late_results_do_not_count() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(10), pace=known(1e-6))
    (batch,) = assign_all(ledger)
    assert ledger.receive(worker, batch.seq, 0, 4, 0.0)
    assert ledger.receive(worker, batch.seq, 0, 4, 0.0) is None, "a repeated result counted"
    ledger.put_back(worker, [batch.seq], 0.0)
    (again,) = assign_all(ledger)
    assert ledger.receive(worker, batch.seq, 4, 6, 0.0) is None, "a result of before counted"
    ledger.lose(worker, (), None)
    assert ledger.receive(worker, again.seq, 0, 6, 0.0) is None, "a late result counted"
    assert job.done == 4


@pytest.mark.parametrize(
    ("seq", "offset", "count", "kept", "words"),
    [
        (1, 0, 1, None, "which another worker has"),
        (3, 0, 1, None, "which it never had"),
        (2, 3, 1, None, "results 3 to 4 of batch 2, which has 5 tasks and 2 results"),
        (2, 0, 1, None, "results 0 to 1 of batch 2"),
        (2, 2, 4, None, "results 2 to 6 of batch 2"),
        (2, 2, 1, 2, "it kept 2 of 5 tasks"),
        (2, 2, 1, 6, "it kept 6 of 5 tasks"),
    ],
)
def test_a_worker_answers_only_for_its_next_tasks(
    seq: int, offset: int, count: int, kept: int | None, words: str
) -> None:
    ledger, _ = ledger_with(2)
    job = job_of(ledger, range(10), unit=5)
    others, own = sorted(assign_all(ledger), key=lambda batch: batch.seq)
    assert (others.seq, own.seq) == (1, 2)
    assert ledger.receive(own.worker, 2, 0, 2, 0.0)
    with pytest.raises(WrongAnswer, match=words):
        ledger.receive(own.worker, seq, offset, count, 0.0, kept=kept)
    assert job.done == 2
    ledger.retire(own.worker)
    ledger.lose(own.worker, (), (2, 2))
    assert job.charges.deaths == {7: 1}, "the task that it ran is not charged, as for a death"
    assert sorted([5, 6, *run_to_end(ledger)]) == list(range(10))
    assert job.finished


def test_a_worker_gives_back_tasks_that_have_not_begun() -> None:
    ledger, (worker,) = ledger_with(1)
    job = job_of(ledger, range(10), pace=known(1e-6))
    (batch,) = assign_all(ledger)
    ledger.receive(batch.worker, batch.seq, 0, 2, 0.0, kept=3)
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
    receipt = ledger.receive(batch.worker, batch.seq, 0, 0, 0.0, kept=1)
    assert receipt is not None
    assert receipt.size == 0
    assert len(job.waiting) == 9


def test_retry_runs_a_task_again_until_it_had_its_tries() -> None:
    ledger, _ = ledger_with(1)
    job = job_of(ledger, ["a", "b"], pace=known(1e-6), limits=Limits(2))
    for attempt in range(3):
        (batch,) = assign_all(ledger)
        assert "b" in batch.items
        receipt = ledger.receive(batch.worker, batch.seq, 0, len(batch.items), 0.0)
        assert receipt is not None
        assert ledger.retry(receipt, 1) == (attempt < 2)
    assert job.finished


def test_retry_of_a_cancelled_job_is_refused() -> None:
    ledger, _ = ledger_with(1)
    job = job_of(ledger, range(2))
    batch = assign_all(ledger)[0]
    receipt = ledger.receive(batch.worker, batch.seq, 0, 1, 0.0)
    assert receipt is not None
    ledger.cancel(job)
    assert not ledger.retry(receipt, 0)
