"""``fiber.Executor``: futures, maps, options, errors, ends."""

from __future__ import annotations

import asyncio
import contextlib
import os
import pickle
import threading
import weakref
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import fiber
from fiber import futures
from fiber._runtime import executor_group, start_methods
from fiber._runtime.jobs import CallQueue
from fiber._runtime.work_items import Call
from fiber.futures import CallFuture
from patience import PATIENCE
from processes import pool_tasks as tasks
from processes.pool_programs import run_program, wait_until
from unit.interrupting import INSTRUCTIONS, is_interrupted


@pytest.fixture
def executor() -> Iterator[fiber.Executor]:
    with fiber.Executor(2) as executor:
        yield executor


# Futures


def test_a_future_is_concurrent_futures(executor: fiber.Executor) -> None:
    future = executor.submit(tasks.add, 1, y=2)
    assert isinstance(future, futures.Future)
    assert future.result(PATIENCE) == 3
    assert future.done()
    assert not future.running()
    assert not future.cancel()


def test_wait_and_as_completed(executor: fiber.Executor, tmp_path: Path) -> None:
    waits = executor.submit(tasks.wait_for, tmp_path / "gate")
    both: list[futures.Future[Any]] = [executor.submit(tasks.square, 3), waits]
    done, waiting = futures.wait(both, PATIENCE, futures.FIRST_COMPLETED)
    assert ({future.result() for future in done}, waiting) == ({9}, {waits})
    (tmp_path / "gate").touch()
    assert [future.result() for future in futures.as_completed([waits], PATIENCE)] == ["gate"]


def test_a_lock_of_a_future_that_is_not_given_back_holds_up_no_other(tmp_path: Path) -> None:
    # A signal's handler that raises between the two leaves it so, in any of the lock's users.
    with fiber.Executor(1) as executor:
        taken = executor.submit(tasks.wait_for, tmp_path / "gate")
        cancelled = [executor.submit(tasks.square, number) for number in range(100)][-1]
        with taken._condition, cancelled._condition:
            assert cancelled.cancel()
            (tmp_path / "gate").touch()
            assert executor.submit(tasks.square, 3).result(PATIENCE) == 9
            with fiber.Pool(1) as pool:
                assert pool.apply(tasks.square, (4,)) == 16
        assert taken.result(PATIENCE) == "gate"
        assert futures.wait([cancelled], PATIENCE).done == {cancelled}


def test_callbacks_run_neither_on_the_loops_thread_nor_too_late(
    executor: fiber.Executor, tmp_path: Path
) -> None:
    names: list[str] = []
    called = threading.Event()

    def note(future: futures.Future[Any]) -> None:
        names.append(threading.current_thread().name)
        assert future.done()
        called.set()

    executor.submit(tasks.wait_for, tmp_path / "gate").add_done_callback(note)
    (tmp_path / "gate").touch()
    assert called.wait(PATIENCE)
    done = executor.submit(tasks.square, 1)
    done.result(PATIENCE)
    done.add_done_callback(note)
    assert names == ["fiber-pool-callbacks", threading.current_thread().name]


def test_a_task_that_raises(executor: fiber.Executor) -> None:
    error = executor.submit(tasks.raise_value_error, 4).exception(PATIENCE)
    assert isinstance(error, ValueError)
    assert "in raise_value_error" in str(error.__cause__)


def test_an_argument_that_does_not_pickle_is_the_futures_error(executor: fiber.Executor) -> None:
    argument = executor.submit(tasks.identity, tasks.Unpicklable()).exception(PATIENCE)
    assert "cannot be pickled" in str(argument)
    result = executor.submit(tasks.odd_results, 2).exception(PATIENCE)
    assert isinstance(result, fiber.pool.MaybeEncodingError)
    unreadable = executor.submit(tasks.odd_results, 3).exception(PATIENCE)
    assert isinstance(unreadable, fiber.pool.MaybeEncodingError)
    assert executor.submit(tasks.square, 2).result(PATIENCE) == 4


def test_asyncio_awaits_them(executor: fiber.Executor) -> None:
    async def main() -> tuple[list[int], int]:
        loop = asyncio.get_running_loop()
        squares = [loop.run_in_executor(executor, tasks.square, n) for n in range(10)]
        one = asyncio.wrap_future(executor.submit(tasks.square, 9))
        return await asyncio.gather(*squares), await one

    assert asyncio.run(main()) == ([n * n for n in range(10)], 81)


def test_a_coroutine_awaits_them(executor: Any, tmp_path: Path) -> None:
    async def square(number: int) -> int:
        result: int = await executor.submit(tasks.square, number)
        return result

    async def main() -> None:
        assert await asyncio.gather(*(square(n) for n in range(10))) == [n * n for n in range(10)]
        with pytest.raises(ValueError, match="4"):
            await executor.submit(tasks.raise_value_error, 4)
        for _ in range(2):
            executor.submit(tasks.wait_for, tmp_path / "gate")
        waits = [executor.submit(tasks.square, n) for n in range(10)]
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(waits[-1], 0.01)
        assert waits[-1].cancelled()
        (tmp_path / "gate").touch()
        assert await waits[0] == 0

    asyncio.run(main())


# Cancelling


def test_a_waiting_call_can_be_cancelled_and_never_runs(tmp_path: Path) -> None:
    gate, log = tmp_path / "gate", tmp_path / "log"
    with fiber.Executor(1) as executor:
        running = executor.submit(tasks.wait_for, gate)
        queued = [executor.submit(tasks.count, log) for _ in range(10)]
        last = executor.submit(tasks.square, 3)
        cancelled = [future for future in queued if future.cancel()]
        assert len(cancelled) >= 8  # a worker may have been given some ahead
        done, _ = futures.wait(cancelled, PATIENCE)
        assert done == set(cancelled)
        wait_until(running.running, "the first task runs")
        assert not running.cancel()
        gate.touch()
        assert last.result(PATIENCE) == 9
    assert tasks.runs(log) == 10 - len(cancelled)


def test_cancelling_that_is_interrupted_holds_up_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with fiber.Executor(1) as executor:
        executor.submit(tasks.wait_for, tmp_path / "gate")
        queued = [executor.submit(tasks.square, n) for n in range(10)]
        (engine,) = executor._group.executors()
        calls, call_soon = engine.calls, engine._loop.call_soon

        def interrupt(callback: Any, *args: Any) -> None:
            if callback == calls._drop_cancelled:
                raise KeyboardInterrupt
            call_soon(callback, *args)

        with monkeypatch.context() as patch:
            patch.setattr(calls._loop, "call_soon", interrupt)
            with pytest.raises(KeyboardInterrupt):
                queued[-1].cancel()
        assert queued[-2].cancel()
        assert futures.wait(queued[-2:], PATIENCE).done == set(queued[-2:])
        (tmp_path / "gate").touch()


def test_for_cancelled_tasks_no_worker_is_waited_for(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    executor = fiber.Executor(1, initializer=tasks.start_slowly, initargs=(gate,))
    future = executor.submit(tasks.square, 1)
    executor.shutdown(cancel_futures=True, wait=False)
    wait_until(future.cancelled, "it is cancelled")
    gate.touch()
    executor.shutdown()


def test_shutdown_can_cancel_waiting_calls(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    executor = fiber.Executor(1)
    first = executor.submit(tasks.wait_for, gate)
    wait_until(first.running, "the first task runs")
    rest = [executor.submit(tasks.square, n) for n in range(20)]
    results = executor.map(tasks.square, range(20))
    executor.shutdown(wait=False, cancel_futures=True)
    wait_until(lambda: sum(future.cancelled() for future in rest) >= 18, "most are cancelled")
    gate.touch()
    executor.shutdown()
    started: list[futures.Future[Any]] = [first, *rest]
    assert all(future.done() for future in started)
    with pytest.raises(futures.CancelledError):
        list(results)


# Maps


@pytest.mark.parametrize("chunksize", [1, 7, 1000])
def test_map(executor: fiber.Executor, chunksize: int) -> None:
    assert list(executor.map(tasks.square, range(50), chunksize=chunksize)) == [
        n * n for n in range(50)
    ]
    found = executor.map(tasks.add, range(50), iter(range(60)), chunksize=chunksize)
    assert list(found) == [2 * n for n in range(50)]


def test_map_without_iterables_or_items(executor: fiber.Executor) -> None:
    assert list(executor.map(tasks.square)) == []
    assert list(executor.map(tasks.square, [])) == []


def test_map_ends_with_the_first_error(executor: fiber.Executor) -> None:
    results = executor.map(tasks.raise_if_odd, [0, 2, 3, 4])
    assert [next(results), next(results)] == [0, 2]
    with pytest.raises(ValueError, match="3"):
        next(results)
    assert list(results) == []


def test_map_has_a_deadline(executor: fiber.Executor, tmp_path: Path) -> None:
    gates = [tmp_path / "open", tmp_path / "shut"]
    gates[0].touch()
    assert list(executor.map(tasks.wait_for, gates[:1], timeout=PATIENCE)) == ["open"]
    results = executor.map(tasks.wait_for, gates[1:], timeout=0.1)
    with pytest.raises(TimeoutError, match="not there in time"):
        next(results)
    gates[1].touch()


def test_map_reads_no_more_than_its_buffer(executor: fiber.Executor) -> None:
    read: list[int] = []

    def numbers() -> Iterator[int]:
        for n in range(1000):
            read.append(n)
            yield n

    results: Any = executor.map(tasks.square, numbers(), buffersize=4)
    assert [next(results) for _ in range(3)] == [0, 1, 4]
    assert len(read) <= 8
    results.close()


def _refused(refused: bool) -> contextlib.AbstractContextManager[object]:
    if not refused:
        return contextlib.nullcontext()
    return pytest.raises(RuntimeError, match="cannot schedule new futures after shutdown")


@pytest.mark.parametrize("size", [3, 5, 6, 300])
@pytest.mark.parametrize("unit", [1, 2])
def test_after_shutdown_a_map_reads_no_more_than_its_buffer(size: int, unit: int) -> None:
    read: list[int] = []

    def numbers() -> Iterator[int]:
        for n in range(size):
            read.append(n)
            yield n

    with fiber.Executor(2) as executor:
        results = executor.map(tasks.square, numbers(), buffersize=4, chunksize=unit)
        taken = [next(results)]
        executor.shutdown()
        allowed = min(size, 5 // unit * unit)
        assert len(read) == allowed
    with _refused(size > allowed):
        taken.extend(results)
    assert taken == [n * n for n in range(allowed)]
    assert len(read) == min(size, allowed + 1)


def test_map_of_an_item_that_does_not_pickle(executor: fiber.Executor) -> None:
    results = executor.map(tasks.ExitingInMaster(), [1])
    with pytest.raises(BaseException, match=r".*"):
        next(results)
    with pytest.raises(RuntimeError, match="cannot be pickled"):
        next(executor.map(tasks.identity, [tasks.Unpicklable()]))


def test_map_keeps_no_result(executor: fiber.Executor) -> None:
    for taken in executor.map(tasks.identity, [{1}, {2}]):
        held = weakref.ref(taken)
        del taken
        assert held() is None


@pytest.mark.parametrize("wrong", [{"chunksize": 0}, {"buffersize": 0}, {"chunksize": -1}])
def test_map_refuses_invalid_options(executor: fiber.Executor, wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"1\+"):
        executor.map(tasks.square, [1], **wrong)


@pytest.mark.parametrize("wrong", [(5,), ([1], 5), (5, [1]), (None,)])
def test_map_of_a_value_that_is_not_iterable_fails_at_the_call(
    executor: fiber.Executor, wrong: tuple[Any, ...]
) -> None:
    with ThreadPoolExecutor(1) as other:
        for each in (other, executor):
            with pytest.raises(TypeError, match="object is not iterable"):
                each.map(tasks.add, *wrong)


@pytest.mark.parametrize("kind", [list, tuple, iter, set, dict.fromkeys])
def test_map_takes_any_iterable(executor: fiber.Executor, kind: Any) -> None:
    assert list(executor.map(tasks.square, kind([0, 1, 2]))) == [0, 1, 4]


# Deaths


def test_a_task_that_kills_its_worker_runs_again_elsewhere(
    executor: fiber.Executor, tmp_path: Path
) -> None:
    assert executor.submit(tasks.die_at_first, tmp_path / "log").result(PATIENCE) == "lived"


def test_a_task_that_kills_every_worker_breaks_no_other(
    executor: fiber.Executor, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    others = [executor.submit(tasks.square, n) for n in range(20)]
    error = executor.options(retries=1).submit(tasks.die_when_counted, log).exception(PATIENCE)
    assert isinstance(error, futures.BrokenProcessPool)
    assert isinstance(error, fiber.WorkerDied)
    assert (error.exitcode, error.attempts, tasks.runs(log)) == (3, 2, 2)
    assert [future.result(PATIENCE) for future in others] == [n * n for n in range(20)]
    copied = pickle.loads(pickle.dumps(error))
    assert (type(copied), str(copied), copied.exitcode) == (type(error), str(error), 3)
    with pytest.raises(futures.BrokenProcessPool):
        list(executor.options(retries=0).map(tasks.die_if, [(1, 1)]))


@pytest.mark.slow
def test_an_initializer_that_raises_breaks_it() -> None:
    with fiber.Executor(1, initializer=tasks.refuse) as executor:
        error = executor.submit(tasks.square, 1).exception(PATIENCE)
        assert isinstance(error, futures.BrokenExecutor)
        assert isinstance(error.__cause__, fiber.StartError)
        assert "no such device" in str(error)
        with pytest.raises(futures.BrokenProcessPool, match="no such device"):
            executor.submit(tasks.square, 1)
        with pytest.raises(futures.BrokenProcessPool):
            executor.map(tasks.square, [1])
        assert executor._broken


def test_terminate_workers_ends_all_waits(tmp_path: Path) -> None:
    executor = fiber.Executor(1)
    called = threading.Event()
    pending = [executor.submit(tasks.announce_and_sleep, tmp_path / "a") for _ in range(3)]
    pending[2].add_done_callback(lambda _: called.set())
    tasks.wait_until_announced(tmp_path / "a")
    executor.terminate_workers()
    for future in pending:
        with pytest.raises(futures.BrokenProcessPool, match="terminate_workers"):
            future.result(PATIENCE)
    assert called.wait(PATIENCE)
    executor.shutdown()


# Options


@pytest.mark.slow
def test_options_apply_to_calls_that_are_submitted_through_them(
    executor: fiber.Executor, tmp_path: Path
) -> None:
    hurried = executor.options(timeout=0.2, retries=0)
    with pytest.raises(fiber.TimeoutError, match=r"timeout of 0\.2 s"):
        hurried.submit(tasks.sleep, 60).result(PATIENCE)
    with pytest.raises(fiber.TimeoutError):
        list(hurried.map(tasks.sleep, [60]))
    assert executor.submit(tasks.sleep, 0.3).result(PATIENCE) == 0.3
    assert hurried.options(timeout=30).submit(tasks.sleep, 0.3).result(PATIENCE) == 0.3
    hurried.shutdown()
    with pytest.raises(RuntimeError, match="cannot schedule new futures after shutdown"):
        executor.submit(tasks.square, 1)


def test_dropped_options_leave_no_state_in_the_engine(executor: fiber.Executor) -> None:
    executor.submit(tasks.square, 1).result(PATIENCE)
    (engine,) = executor._group.executors()
    before = len(engine._ledger.jobs)
    for n in range(5):
        assert executor.options(retries=n).submit(tasks.square, n).result(PATIENCE) == n * n
    wait_until(lambda: len(engine._ledger.jobs) == before, "their jobs are over")


def test_an_executor_retries_the_given_exceptions(tmp_path: Path) -> None:
    with fiber.Executor(1, retry_exceptions=ConnectionError) as executor:
        assert executor.submit(tasks.fail_until, tmp_path / "log", 2).result(PATIENCE) == "done"


def test_workers_come_with_the_work_and_are_replaced() -> None:
    with fiber.Executor(3, max_tasks_per_child=1) as executor:
        assert executor._processes == {}
        pids = [executor.submit(tasks.pid).result(PATIENCE) for _ in range(3)]
        assert len(set(pids)) == 3
    with fiber.Executor(3, idle_timeout=0.05) as executor:
        executor.submit(tasks.pid).result(PATIENCE)
        wait_until(lambda: not executor._processes, "idle workers leave")
        assert executor.submit(tasks.square, 2).result(PATIENCE) == 4


def test_a_replaced_worker_that_has_not_ended_is_not_counted(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    with fiber.Executor(
        1, max_tasks_per_child=1, initializer=tasks.end_slowly, initargs=(gate,)
    ) as executor:
        first = executor.submit(tasks.pid).result(PATIENCE)
        second = executor.submit(tasks.pid).result(PATIENCE)
        counted = set(executor._processes)
        gate.touch()
        assert first != second
        assert first not in counted


@pytest.mark.parametrize(
    ("options", "error", "says"),
    [
        ({"max_workers": 0}, ValueError, "max_workers must be greater than 0"),
        ({"max_workers": "2"}, TypeError, "max_workers must be a whole number"),
        ({"max_tasks_per_child": 0}, ValueError, "max_tasks_per_child must be greater than 0"),
        ({"initializer": 3}, TypeError, "initializer must be a callable"),
        ({"mp_context": "spawn"}, TypeError, "mp_context must be what fiber.get_context"),
        ({"retries": -1}, ValueError, "retries"),
    ],
)
def test_bad_options(options: Any, error: type[Exception], says: str) -> None:
    with pytest.raises(error, match=says):
        fiber.Executor(**options)
    with pytest.raises(ValueError, match=r"Executor\.options\(cpu=-1\): expected CPUs above 0"):
        fiber.Executor(1).options(cpu=-1)


def test_an_executor_is_refused_during_the_import_of_main(monkeypatch: pytest.MonkeyPatch) -> None:
    executor = fiber.Executor(1)
    monkeypatch.setattr(fiber.current_process(), "_inheriting", True, raising=False)
    with pytest.raises(RuntimeError, match='if __name__ == "__main__"'):
        executor.submit(os.getpid)


# Its end


def test_a_task_that_comes_while_it_is_shut_down(
    executor: fiber.Executor, monkeypatch: pytest.MonkeyPatch
) -> None:
    executor.submit(tasks.square, 1).result(PATIENCE)
    (engine,) = executor._group.executors()
    engine.close()  # as shutdown() does, after the group has said yes to another thread
    wait_until(lambda: engine._scheduler.closing, "it takes nothing more")
    with pytest.raises(RuntimeError, match="cannot schedule new futures after shutdown"):
        executor.submit(tasks.square, 2)
    late: CallFuture[Any] = CallFuture(engine, CallQueue())
    engine.calls.put(Call("late", b"", [], None, late))
    assert "after shutdown" in str(late.exception(PATIENCE))

    other = fiber.Executor(1)
    monkeypatch.setattr(start_methods, "check_main", other.shutdown)
    with pytest.raises(RuntimeError, match="cannot schedule new futures after shutdown"):
        other.submit(tasks.square, 3)
    assert not other._group.executors()


def test_ctrl_c_during_the_start_leaves_no_worker() -> None:
    made: list[fiber.Executor] = []

    def start() -> None:
        made.append(fiber.Executor(1))
        made[-1].submit(tasks.square, 2)

    stop = 0
    while is_interrupted(start, stop, {executor_group.__file__}, steps=INSTRUCTIONS):
        if made:
            made.pop().shutdown(cancel_futures=True)
        stop += 1
    made.pop().shutdown()
    wait_until(
        lambda: not any(thread.name.startswith("fiber-pool") for thread in threading.enumerate()),
        "no thread of theirs is left",
    )


def test_forgotten_it_ends_after_its_tasks() -> None:
    executor = fiber.Executor(2)
    results = executor.map(tasks.square, range(10))
    future = executor.submit(tasks.square, 11)
    (engine,) = executor._group.executors()
    del executor
    assert list(results) == [n * n for n in range(10)]
    assert future.result(PATIENCE) == 121
    del results, future
    assert engine.ended.wait(PATIENCE)


@pytest.mark.slow
def test_the_program_ends_after_its_tasks() -> None:
    done = run_program(
        """
        import fiber
        from processes import pool_tasks as tasks
        executor = fiber.Executor(2)
        future = executor.submit(tasks.sleep, 0.3)
        future.add_done_callback(lambda future: print(future.result(), flush=True))
        executor.map(print, ["mapped"])
        """
    )
    assert sorted(done.stdout.split()) == ["0.3", "mapped"], done.stderr
    assert done.stderr == ""


def test_calls_are_refused_once_the_program_ends() -> None:
    done = run_program(
        """
        import atexit
        def too_late():
            try:
                executor.submit(int)
            except RuntimeError as error:
                print(error)
        atexit.register(too_late)
        import fiber
        executor = fiber.Executor(1)
        executor.submit(int).result()
        """
    )
    assert done.stdout == "cannot schedule new futures after interpreter shutdown\n", done.stderr


def test_a_copy_in_a_fork_says_so(executor: fiber.Executor) -> None:
    executor.submit(tasks.square, 1).result(PATIENCE)
    ours, theirs = os.pipe()
    child = os.fork()
    if not child:
        with contextlib.suppress(BaseException):
            try:
                executor.submit(tasks.square, 1)
            except RuntimeError as error:
                os.write(theirs, str(error).encode())
            executor.shutdown()
        os._exit(0)
    os.waitpid(child, 0)
    os.close(theirs)
    with open(ours, "rb") as read:
        assert b"belongs to process" in read.read()


def test_an_executor_cannot_be_pickled(executor: fiber.Executor) -> None:
    with pytest.raises(NotImplementedError, match="cannot be passed"):
        pickle.dumps(executor)


def test_ctrl_c_in_a_with_block_cancels_waiting_calls(tmp_path: Path) -> None:
    pending: list[futures.Future[str]] = []

    def work() -> None:
        with fiber.Executor(1) as executor:
            pending.extend(executor.submit(tasks.wait_for, tmp_path / "gate") for _ in range(100))
            wait_until(pending[0].running, "the first task runs")
            (tmp_path / "gate").touch()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    assert all(future.done() for future in pending)
    assert sum(future.cancelled() for future in pending) > 90


def executor_in_a_task(n: int) -> list[int]:
    with fiber.Executor(2) as inner:
        return list(inner.map(tasks.square, range(n)))


def test_executors_nest(executor: fiber.Executor) -> None:
    assert executor.submit(executor_in_a_task, 5).result(PATIENCE) == [0, 1, 4, 9, 16]
