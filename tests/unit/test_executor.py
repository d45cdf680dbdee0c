"""The executor against workers, a loop and background threads that do nothing by themselves."""

from __future__ import annotations

import gc
import pickle
import signal
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any

import pytest

from fiber._agent.interface import ExitReport
from fiber._agent.last_words import TELL
from fiber._engine import load
from fiber._runtime import exchange, workers
from fiber._runtime.answers import Pickled, TaskFailure
from fiber._runtime.executor import PoolExecutor
from fiber._runtime.threads import Latch
from fiber._runtime.work_items import Call, InputStream
from fiber._runtime.workers import KILL_AFTER, WorkerHandle
from fiber._wire import work
from fiber.errors import FiberError, WorkerDied
from patience import PATIENCE
from processes import pool_tasks as tasks
from unit.executor_rig import Results, Rig

"""Yield to another thread."""


@pytest.fixture
def pickled() -> list[int]:
    """The items that were pickled by code of their own."""
    pickled: list[int] = []
    tasks.state["pickled"] = pickled
    return pickled


# Giving


def test_a_map_is_done_when_each_worker_has_answered(rig: Rig) -> None:
    results = rig.map(range(4))
    for handle, child in zip(rig.handles, rig.children, strict=True):
        assert [seq for seq, _ in child.packets]
        for seq, _ in list(child.packets):
            rig.answer(handle, seq, [seq])
    assert len(results.outcomes) == 4
    assert results.done == 1


def test_a_call_is_done_when_its_worker_has_answered(rig: Rig) -> None:
    results = rig.call()
    (handle,) = rig.busy
    rig.answer(handle, rig.child(handle).packets[0][0], [9])
    assert (results.outcomes, results.done) == ({0: 9}, 1)


def test_many_short_calls_in_a_row_travel_together(rig: Rig) -> None:
    first = [rig.call() for _ in range(2)]
    for handle in list(rig.busy):
        rig.say(handle, rig.child(handle).packets[0][0], 0, None, 1e-7, [9], [])
    assert [results.done for results in first] == [1, 1]
    sent = len(list(rig.deliveries()))
    many = [rig.call() for _ in range(10)]
    rig.loop.pass_time(1.0)
    while rig.ledger.batches:
        rig.answer_batch(next(iter(rig.ledger.batches.values())))
    assert [results.done for results in many] == [1] * 10
    assert len(list(rig.deliveries())) - sent < 10


def test_a_loop_that_is_about_to_look_for_calls_is_woken_once(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.call()
    (handle,) = rig.busy
    rig.say(handle, rig.child(handle).packets[0][0], 0, None, 1e-7, [9], [])
    told: list[object] = []
    call_soon = rig.loop.call_soon

    def tell(callback: Callable[..., object], *args: Any) -> None:
        told.append(callback)
        call_soon(callback, *args)

    monkeypatch.setattr(rig.loop, "call_soon", tell)
    many = [rig.call() for _ in range(100)]
    assert len(told) < 10
    blocking = Call("now", b"", (), None, Results(), blocking=True)
    before = len(told)
    rig.executor.calls.put(blocking)
    assert len(told) == before + 1
    rig.loop.pass_time(1.0)
    while rig.ledger.batches:
        rig.answer_batch(next(iter(rig.ledger.batches.values())))
    assert [results.done for results in many] == [1] * 100


def test_a_function_is_sent_once_to_each_worker(rig: Rig) -> None:
    rig.map(range(4))
    for handle in rig.handles:
        assert rig.head(handle, 0).size
        assert not rig.head(handle, 1).size


def test_a_function_that_was_not_read_is_sent_again(rig: Rig) -> None:
    rig.map(range(4))
    handle, child = rig.handles[0], rig.children[0]
    handle.recalled([seq for seq, _ in child.packets])
    assert rig.head(handle, 2).size


def test_a_worker_that_forgot_a_function_is_sent_it_again(rig: Rig) -> None:
    rig.map(range(4))
    handle, child = rig.handles[0], rig.children[0]
    rig.say(handle, work.UNKNOWN, child.packets[1][0])
    assert rig.head(handle, 2).size


def test_the_same_function_has_the_same_identity(rig: Rig) -> None:
    one = rig.executor.function(tasks.square)
    assert rig.executor.function(tasks.square) is one
    assert rig.executor.function(tasks.add).id != one.id


def test_users_picklers_do_not_run_on_the_loop(rig: Rig, pickled: list[int]) -> None:
    rig.map([tasks.Tattling(n) for n in range(6)])
    assert pickled == []
    rig.background.run()
    assert len(pickled) == 4
    rig.answer(rig.handles[0], rig.children[0].packets[0][0], [None])
    assert len(pickled) == 4
    rig.background.run()
    assert len(pickled) == 5


def test_plain_items_are_sent_from_the_loop(rig: Rig) -> None:
    rig.map([(n, str(n)) for n in range(6)])
    rig.answer(rig.handles[0], rig.children[0].packets[0][0], [None])
    assert len(rig.children[0].packets) == 3
    assert not rig.background.submitted


def test_idle_workers_get_unread_tasks_of_busy_ones(rig: Rig) -> None:
    results = rig.map(range(4))
    idle, busy = rig.handles
    for seq, _ in list(rig.children[0].packets):
        rig.answer(idle, seq, [seq])
    assert rig.children[1].recalls == 0
    rig.loop.pass_time(load.RECALL_AFTER)
    assert rig.children[1].recalls == 1
    unread = rig.children[1].packets[1][0]
    busy.recalled([unread])
    rig.answer(idle, rig.children[0].packets[-1][0], [7])
    rig.answer(busy, unread, ["late"])
    rig.answer(busy, rig.children[1].packets[0][0], [8])
    assert results.done == 1
    assert "late" not in results.outcomes.values()


def test_the_task_behind_a_late_one_is_the_next_to_be_sent(rig: Rig) -> None:
    results = rig.map(range(20))
    late, other = rig.handles
    assert late.worker is not None
    assert other.worker is not None
    unread = late.worker.queue[1]
    rig.loop.pass_time(load.CHECK_EVERY)
    assert [child.recalls for child in rig.children] == [1, 1]
    assert not rig.loop.timers
    late.recalled([unread.seq])
    other.recalled([])
    rig.answer_batch(other.worker.queue[0])
    assert list(other.worker.queue[1].items) == list(unread.items)
    assert len(late.worker.queue) == 1
    rig.answer_all()
    assert (results.done, len(results.outcomes)) == (1, 20)


def test_an_item_that_does_not_pickle_concerns_its_task_alone(rig: Rig) -> None:
    results = rig.map([1, tasks.Unpicklable(), 2])
    rig.answer_all()
    assert results.done == 1
    failure = results.outcomes[1]
    assert type(failure) is TaskFailure
    assert "cannot be pickled" in str(failure.error)
    assert [results.outcomes[0], results.outcomes[2]] == [None, None]


@pytest.mark.parametrize("tries", [0, 2], ids=["to pickle it", "to find out why it does not"])
def test_a_pickler_may_raise_anything(rig: Rig, tries: int) -> None:
    results = rig.map([tasks.Exiting(tries)])
    rig.answer_all()
    assert results.done == 1
    failure = results.outcomes[0]
    assert type(failure) is TaskFailure
    assert type(failure.error) is SystemExit


def test_a_broadcast_goes_once_to_each_worker(rig: Rig) -> None:
    results = Results()
    rig.executor.broadcast(results, tasks.pid, ())
    assert [len(child.packets) for child in rig.children] == [1, 1]
    rig.answer_all()
    assert (len(results.outcomes), results.done) == (2, 1)


# Streams


def test_read_items_are_fed_until_the_end(rig: Rig) -> None:
    results = Results()
    item = rig.item(results)
    stream = rig.executor.open_stream(item)
    stream.read(range(3))
    rig.answer_all()
    assert (len(results.outcomes), results.done) == (3, 0)
    rig.executor.finish(item)
    assert results.done == 1


def test_an_answer_looks_at_no_stream_that_it_does_not_concern(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    items = [rig.item(Results()) for _ in range(20)]
    streams = [rig.executor.open_stream(item) for item in items]
    streams[0].read(range(2))
    looked_at: list[InputStream] = []
    take = InputStream.take

    def look(stream: InputStream) -> Any:
        looked_at.append(stream)
        return take(stream)

    monkeypatch.setattr(InputStream, "take", look)
    rig.answer_all()
    assert set(looked_at) <= {streams[0]}


def test_an_error_of_the_input_takes_the_place_of_the_next_task(rig: Rig) -> None:
    results = Results()
    item = rig.item(results)
    rig.executor.open_stream(item).read(range(2))
    rig.executor.finish(item, KeyError("input"))
    rig.answer_all()
    assert results.done == 1
    assert len(results.outcomes) == 3
    assert str(results.outcomes[2].error) == "'input'"


def test_a_cancelled_stream_lets_its_reader_end(rig: Rig) -> None:
    item = rig.item(Results())
    stream = rig.executor.open_stream(item)
    rig.executor.cancel(item)
    assert stream.ended
    stream.read(range(10**9))
    rig.executor.finish(item)
    assert not rig.maps


# Taking


def test_users_values_are_not_unpickled_on_the_loop(rig: Rig) -> None:
    results = rig.map(range(1))
    (handle,) = rig.busy
    data = pickle.dumps(tasks.UnreadableInWorker())
    seq = rig.child(handle).packets[0][0]
    rig.answer(handle, seq, [None], [(0, work.VALUE, data, 0)])
    outcome = results.outcomes[0]
    assert type(outcome) is Pickled
    assert outcome.decode() is tasks.identity


def test_a_batch_that_its_worker_cannot_read_is_sent_in_pieces(rig: Rig) -> None:
    results = rig.map(range(2), unit=2)
    (handle,) = rig.busy
    error = pickle.dumps(AttributeError("no such class"))
    rig.say(handle, work.UNREADABLE, rig.child(handle).packets[0][0], error)
    for handle in list(rig.busy):
        rig.say(handle, work.UNREADABLE, rig.child(handle).packets[-1][0], error)
    assert (len(results.outcomes), results.done) == (2, 1)
    assert all("no such class" in str(o.decode().error) for o in results.outcomes.values())


def test_a_finished_request_keeps_no_references(rig: Rig) -> None:
    # A wait for the collector is long where large arrays count as one object each.
    gc.disable()
    try:
        found = [rig.map(range(2)), rig.map([]), rig.call(timeout=60.0), cancelled := Results()]
        item = rig.item(cancelled)
        rig.executor.submit(item, range(9))
        rig.executor.cancel(item)
        del item, cancelled
        rig.answer_all()
        dead = [weakref.ref(results) for results in found]
        del found
        assert [ref() for ref in dead] == [None] * 4
    finally:
        gc.enable()


def test_a_cancelled_batch_is_not_sent(rig: Rig, pickled: list[int]) -> None:
    item = rig.item(Results())
    rig.executor.submit(item, [tasks.Tattling(n) for n in range(2)])
    rig.executor.cancel(item)
    rig.background.run()
    assert not list(rig.deliveries())
    assert pickled == []
    assert len(rig.ledger.idle()) == 2


def test_cancelling_a_done_or_unsubmitted_call_does_nothing(rig: Rig) -> None:
    results = Results()
    item = rig.item(results)
    rig.executor.cancel(item)
    rig.executor.submit(item, range(2))
    rig.answer_all()
    rig.executor.cancel(item)
    assert results.done == 1


# Losing


def test_assigned_but_unsent_tasks_are_not_charged(rig: Rig, pickled: list[int]) -> None:
    rig.map([tasks.Tattling(n) for n in range(2)])
    (job,) = rig.maps
    rig.lose(rig.handles[0])
    assert job.charges.deaths == {}
    assert rig.ledger.demand() == 2


def test_an_unreceived_packet_is_not_charged_to_its_tasks(rig: Rig) -> None:
    rig.children[0].gone = rig.children[1].gone = True
    rig.map(range(2))
    (job,) = rig.maps
    rig.lose(rig.handles[0])
    rig.lose(rig.handles[1])
    assert job.charges.deaths == {}


def test_the_running_task_of_a_dead_worker_is_charged_an_attempt(rig: Rig) -> None:
    results = rig.map(range(1), timeout=60.0)
    (batch,) = rig.ledger.batches.values()
    job = batch.job
    assert job is not None
    rig.lose(batch.worker.key, running=(batch.seq, 0))
    assert job.charges.deaths == {0: 1}
    assert not results.done
    assert len(rig.loop.timers) == 1, "its deadline counts from its next start"


def test_a_task_that_kills_its_workers(rig: Rig) -> None:
    results = rig.call()
    for attempt in range(4):
        (handle,) = rig.busy
        seq = rig.child(handle).packets[-1][0]
        rig.lose(handle, running=(seq, 0), pod=f"es-{attempt}", node="node-2")
        rig.background.run()
        rig.all_ready()
    outcome = results.outcomes[0]
    assert type(outcome) is TaskFailure
    assert isinstance(outcome.error, WorkerDied)
    assert "square" in outcome.error.task
    assert (outcome.error.pod, outcome.error.node) == ("es-3", "node-2")
    assert results.done == 1


def test_lost_workers_are_replaced_elsewhere_than_on_the_loop(rig: Rig) -> None:
    rig.lose(rig.handles[0])
    assert len(rig.handles) == 2
    rig.background.run()
    assert len(rig.handles) == 3


def test_a_task_over_its_time_fails_and_its_worker_is_killed(rig: Rig) -> None:
    results = rig.call(timeout=2.0)
    (handle,) = rig.busy
    rig.loop.pass_time(2.0)
    assert rig.child(handle).signals == [TELL]
    assert results.done == 0
    rig.lose(handle, stack="line 3 in f")
    assert "2 s" in str(results.outcomes[0].error)
    assert "line 3 in f" in str(results.outcomes[0].error)
    assert (len(results.outcomes), results.done) == (1, 1)


def test_an_answer_that_comes_before_its_worker_ends_counts(rig: Rig) -> None:
    results = rig.call(timeout=2.0)
    (handle,) = rig.busy
    rig.loop.pass_time(2.0)
    rig.answer(handle, rig.child(handle).packets[0][0], [9])
    rig.lose(handle)
    assert (results.outcomes, results.done) == ({0: 9}, 1)


def test_the_end_of_a_worker_is_waited_for_briefly(rig: Rig) -> None:
    results = rig.call(timeout=2.0)
    (handle,) = rig.busy
    rig.loop.pass_time(2.0)
    rig.loop.pass_time(exchange.STACK_PATIENCE)
    assert "2 s" in str(results.outcomes[0].error)
    assert rig.child(handle).signals == [TELL, signal.SIGKILL]
    rig.answer(handle, rig.child(handle).packets[0][0], [9])
    rig.lose(handle, stack="too late")
    assert (len(results.outcomes), results.done) == (1, 1)


# The end


def test_a_worker_gets_its_stop_again_after_a_recall(rig: Rig) -> None:
    rig.executor.close()
    told = rig.children[0].packets
    assert told == [(0, work.STOP_MESSAGE)]
    rig.handles[0].recalled([0])
    assert told == [(0, work.STOP_MESSAGE)] * 2


def test_a_call_that_a_recall_took_from_a_leased_worker_is_sent_again(rig: Rig) -> None:
    class Recalled:
        """The channel of a worker: what is sent on it meets a recall that was on its way."""

        def __init__(self, handle: WorkerHandle) -> None:
            self._handle = handle

        def send(self, seq: int, payload: bytes, buffers: object = ()) -> None:
            self._handle.recalled([seq])

        def receive(self, timeout: float) -> None:
            """The worker has nothing to answer."""

        def close(self) -> None:
            """Return no descriptor."""

    class Awaited(Results):
        def get(self) -> int:
            rig.answer_all()
            return self.done

    for handle, child in zip(rig.handles, rig.children, strict=True):
        child.lease_channel = partial(Recalled, handle)  # type: ignore[assignment,method-assign]
    for _ in range(2):  # the first one's answer leads to a lease of its worker
        assert rig.executor.call_and_wait(Awaited(), tasks.square, (3,), {}) == 1
    assert len(list(rig.deliveries())) == 2, "the second call was not sent again"


def test_after_close_the_rest_is_done_and_the_workers_leave(rig: Rig) -> None:
    results = [rig.map(range(5)), rig.call()]
    rig.executor.close()
    with pytest.raises(ValueError, match="not running"):
        rig.call()
    assert not any(child.told_to_end for child in rig.children)
    rig.answer_all()
    assert [found.done for found in results] == [1, 1]
    assert all(child.told_to_end for child in rig.children)
    for handle in list(rig.handles):
        handle.exited(ExitReport(0, "exit status 0"))
    assert rig.executor.ended.is_set()


def test_a_request_at_the_moment_of_the_end_fails(rig: Rig) -> None:
    rig.loop.held = True
    error = RuntimeError("terminated")
    rig.executor.terminate(error)
    found = [rig.map(range(2)), rig.call(), rig.call(timeout=1.0), Results()]
    item = rig.item(found[-1])
    stream = rig.executor.open_stream(item)
    rig.loop.release()
    stream.read(range(10**9))
    assert stream.ended
    assert all(results.error is not None for results in found)
    assert not rig.ledger.jobs
    rig.loop.held = False


def test_terminate_fails_unfinished_calls(rig: Rig) -> None:
    error = RuntimeError("terminated")
    found = [rig.map(range(100)), rig.call(), rig.call(timeout=60.0), Results()]
    stream = rig.executor.open_stream(rig.item(found[-1]))
    rig.executor.terminate(error)
    assert [results.error for results in found] == [error] * 4
    assert stream.ended
    assert [child.signals for child in rig.children] == [[signal.SIGTERM]] * 2
    rig.loop.pass_time(KILL_AFTER)
    assert [child.signals[1:] for child in rig.children] == [[signal.SIGKILL]] * 2


def test_waits_for_a_failed_loop_end() -> None:
    rig = Rig(2)
    found = [rig.map(range(100)), rig.call()]
    rig.executor.broken(FiberError("the loop has failed"))
    assert [str(results.error) for results in found] == ["the loop has failed"] * 2
    with pytest.raises(FiberError, match="the loop has failed"):
        rig.call()
    assert rig.executor.ended.is_set()
    assert [child.signals[-1:] for child in rig.children] == [[signal.SIGKILL]] * 2


def test_waits_for_workers_of_an_ended_pool_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig(2, ready=False)
    found = wait_in_a_thread(rig.executor, monkeypatch)
    rig.executor.terminate(RuntimeError("terminated"))
    for handle in rig.handles:
        rig.lose(handle)
    assert str(found.exception(PATIENCE)) == "Pool not running"


def test_waits_for_workers_of_a_failed_loop_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig(2, ready=False)
    rig.loop.held = True  # it has no work left
    found = wait_in_a_thread(rig.executor, monkeypatch)
    rig.executor.broken(FiberError("the loop has failed"))
    assert str(found.exception(PATIENCE)) == "the loop has failed"


def wait_in_a_thread(executor: PoolExecutor, patch: pytest.MonkeyPatch) -> Future[bool]:
    """Call ``wait_until_workers_up`` in a thread; return once it waits."""
    found: Future[bool] = Future()
    asked = threading.Event()

    def wait() -> None:
        try:
            found.set_result(executor.wait_until_up(None))
        except Exception as error:
            found.set_exception(error)

    class Noted(Latch):
        def wait(self, timeout: float | None = None) -> bool:
            asked.set()
            return super().wait(timeout)

    patch.setattr(workers, "Latch", Noted)
    threading.Thread(target=wait, daemon=True).start()
    assert asked.wait(PATIENCE)
    return found


def test_idle_workers_above_the_minimum_leave() -> None:
    rig = Rig(1, maximum=3, idle_timeout=10.0)
    rig.map(range(9))
    rig.background.run()
    rig.all_ready()
    assert len(rig.members) == 3
    rig.answer_all()
    rig.loop.pass_time(9.0)
    assert not any(child.told_to_end for child in rig.children)
    rig.loop.pass_time(1.5)
    assert sum(child.told_to_end for child in rig.children) == 2
    rig.close()
