"""Calls that share options, and their cancellation, one step of the loop at a time."""

from __future__ import annotations

from concurrent.futures import CancelledError

import pytest

from fiber._engine.tasks import Limits
from fiber._runtime.jobs import CallQueue
from fiber.errors import FiberError
from fiber.futures import CallFuture
from processes import pool_tasks as tasks
from unit.executor_rig import Rig


@pytest.fixture
def rig() -> Rig:
    return Rig(1)


def called(rig: Rig, queue: CallQueue, number: int) -> CallFuture[int]:
    future: CallFuture[int] = CallFuture(rig.executor, queue)
    rig.executor.call(future, tasks.square, (number,), {}, queue=queue)
    return future


def test_a_call_that_is_cancelled_before_sending_is_not_sent(rig: Rig) -> None:
    queue = CallQueue(cancellable=True)
    rig.loop.held = True
    calls = [called(rig, queue, number) for number in range(4)]
    assert [calls[0].cancel(), calls[2].cancel()] == [True, True]
    rig.loop.release()
    rig.answer_all()
    assert [call.cancelled() for call in calls] == [True, False, True, False]
    assert [call.done() for call in calls] == [True] * 4
    assert len(list(rig.deliveries())) == 2
    assert not calls[1].cancel()


def test_a_call_that_is_cancelled_while_it_waits_leaves_no_work(rig: Rig) -> None:
    queue = CallQueue(cancellable=True)
    calls = [called(rig, queue, number) for number in range(10)]
    given = sum(call.running() for call in calls)
    assert 0 < given < 10
    assert sum(call.cancel() for call in calls) == 10 - given
    assert rig.ledger.demand() == given
    rig.answer_all()
    assert all(call.done() for call in calls)


def test_a_queue_that_is_closed_leaves_no_job(rig: Rig) -> None:
    queue = CallQueue(cancellable=True)
    call = called(rig, queue, 3)
    assert len(rig.ledger.jobs) == 1
    rig.executor.calls.close(queue)
    rig.answer_all()
    assert call.done()
    assert not rig.ledger.jobs


def test_options_are_those_of_the_queue(rig: Rig) -> None:
    once, again = CallQueue(limits=Limits(0)), CallQueue(limits=Limits(5))
    called(rig, once, 1)
    called(rig, again, 1)
    assert {job.charges.limits.retries for job in rig.ledger.jobs} == {0, 5}


def test_a_waiting_caller_gets_the_end(rig: Rig) -> None:
    queue = CallQueue(cancellable=True)
    calls = [called(rig, queue, number) for number in range(5)]
    cancelled = calls[4]
    cancelled.cancel()
    rig.executor.terminate(FiberError("the end"))
    assert all(call.done() for call in calls)
    with pytest.raises(FiberError, match="the end"):
        calls[0].result(0)
    with pytest.raises(CancelledError):
        cancelled.result(0)


def test_cancelling_all_spares_running_calls(rig: Rig) -> None:
    queue = CallQueue(cancellable=True)
    calls = [called(rig, queue, number) for number in range(10)]
    results = rig.map(range(100))
    running = [call for call in calls if call.running()]
    rig.executor.cancel_all(CancelledError())
    assert isinstance(results.error, CancelledError)
    assert [call for call in calls if not call.cancelled()] == running
    rig.answer_all()
    assert all(call.done() and not call.cancelled() for call in running)
