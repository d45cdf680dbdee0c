"""A pool's executor starts workers, and what it does where that cannot be done."""

from __future__ import annotations

import pickle
import signal
from typing import Any, NoReturn

import pytest

from fiber._agent.interface import Cause, ExitReport
from fiber._engine import scheduler, start_failures
from fiber._runtime.workers import KILL_AFTER
from fiber._wire import work
from fiber.errors import FiberError
from processes import pool_tasks as tasks
from unit.executor_rig import Rig


def test_an_executor_that_cannot_start_has_ended() -> None:
    rig = Rig(2, start=False, ready=False)

    def refuse(dependent: object) -> NoReturn:
        raise FiberError("the loop has failed")

    rig.loop.depend = refuse  # type: ignore[method-assign]
    with pytest.raises(FiberError, match="the loop has failed"):
        rig.executor.start()
    rig.loop.held = True  # as for ever
    rig.executor.terminate(RuntimeError("the program ends"))
    assert rig.executor.ended.is_set()


def test_a_pool_whose_first_workers_cannot_be_started_ends() -> None:
    rig = Rig(2, start=False)
    rig.refusal = OSError("too many open files")
    with pytest.raises(OSError, match="too many"):
        rig.executor.start()
    rig.close()
    assert not rig.handles


def test_a_worker_that_cannot_be_started_is_tried_again(rig: Rig) -> None:
    rig.refusal = OSError("too many open files")
    rig.lose(rig.handles[0])
    rig.background.run()
    assert len(rig.members) == 1
    rig.refusal = None
    for _ in range(3):
        rig.loop.pass_time(60.0)
        rig.background.run()
    rig.all_ready()
    assert len(rig.members) == 2


@pytest.fixture
def no_thread(rig: Rig) -> RuntimeError:
    """Make the background thread's start fail; return the error."""
    rig.background.refusal = RuntimeError("can't start new thread")
    return rig.background.refusal


def test_without_a_thread_to_pickle_them_tasks_fail(rig: Rig, no_thread: RuntimeError) -> None:
    results = rig.map([tasks.Tattling(n) for n in range(6)])
    assert results.done == 1
    failures = [results.outcomes[n] for n in range(6)]
    assert [failure.error for failure in failures] == [no_thread] * 6
    others = rig.map(range(4))
    rig.answer_all()
    assert others.done == 1


def test_without_a_thread_to_look_at_it_a_function_is_still_unusable(
    rig: Rig, no_thread: RuntimeError
) -> None:
    results = rig.map([1])
    (handle,) = rig.busy
    error = pickle.dumps(ValueError("it does not unpickle"))
    rig.say(handle, work.BROKEN, rig.child(handle).packets[0][0], error)
    assert results.error is no_thread
    assert not rig.busy


@pytest.mark.usefixtures("no_thread")
def test_without_a_thread_to_start_them_workers_are_tried_again(rig: Rig) -> None:
    rig.lose(rig.handles[0])
    assert len(rig.members) == 1
    rig.background.refusal = None
    for _ in range(3):
        rig.loop.pass_time(60.0)
        rig.background.run()
    rig.all_ready()
    assert len(rig.members) == 2


@pytest.mark.usefixtures("no_thread")
def test_without_a_thread_for_them_reports_harm_no_work(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(start_failures, "SAID_AFTER", -1.0)
    for handle in rig.members:
        rig.lose(handle)
    assert not rig.members


def test_an_initializers_pickler_may_raise_anything() -> None:
    rig = Rig(0, maximum=1, ready=False)
    rig.refusal = SystemExit("no")
    rig.map([1])
    rig.background.run()
    assert not rig.members
    rig.close()


def test_a_worker_that_is_not_ready_when_the_pool_closes_is_stopped() -> None:
    rig = Rig(1, ready=False)
    rig.executor.close()
    assert rig.children[0].told_to_end
    rig.lose(rig.handles[0])
    assert rig.executor.ended.is_set()
    rig.close()


def test_a_workers_complaint_is_the_users_error() -> None:
    rig = Rig(1, ready=False)
    results = rig.call()
    for _ in range(60):
        handle = rig.handles[-1]
        rig.say(handle, work.INIT_FAILED, "no such device", "")
        handle.exited(ExitReport(1, "exit status 1"))
        rig.loop.pass_time(1.0)
        rig.background.run()
        if results.error is not None:
            break
    assert "no such device" in str(results.error)
    with pytest.raises(FiberError, match="no such device"):
        rig.call()
    rig.close()


@pytest.mark.parametrize(
    ("cause", "told"), [(Cause.CHILD, True), (Cause.REFUSED, True), (Cause.AGENT_LOST, False)]
)
def test_the_end_of_a_worker_is_reported_by_its_cause(
    cause: Cause, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    failures: list[start_failures.StartFailure | None] = []
    gone = scheduler.PoolWorkerSet.gone

    def noting(self: Any, member: Any, now: float, failure: Any = None) -> None:
        failures.append(failure)
        gone(self, member, now, failure)

    monkeypatch.setattr(scheduler.PoolWorkerSet, "gone", noting)
    rig = Rig(1, ready=False)
    rig.handles[0].exited(ExitReport(1, "agent could not be started", cause=cause))
    assert [failure is not None for failure in failures] == [told]
    assert [failure.killed for failure in failures if failure] == [cause is Cause.REFUSED] * told
    rig.background.run()
    rig.close()


def test_a_pool_that_gives_up_kills_the_workers_that_do_not_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(start_failures, "TRIES", 1)
    monkeypatch.setattr(start_failures, "RAISED_PATIENCE", 0.0)
    rig = Rig(2, ready=False)
    results = rig.map(range(5))
    rig.handles[0].exited(ExitReport(1, "exit status 1"))
    assert results.error is not None
    assert rig.children[1].signals == [signal.SIGTERM]
    rig.loop.pass_time(KILL_AFTER)
    assert rig.children[1].signals == [signal.SIGTERM, signal.SIGKILL]
    rig.close()


def test_a_call_that_was_tried_again_leaves_no_state(rig: Rig) -> None:
    results = rig.call()
    (handle,) = rig.busy
    rig.lose(handle, running=(rig.child(handle).packets[0][0], 0))
    (job,) = rig.ledger.jobs
    assert list(job.charges.deaths.values()) == [1]
    rig.answer_all()
    assert (results.done, job.charges.deaths) == (1, {})
