"""Growth, shrinking and end of a pool without leftovers."""

from __future__ import annotations

import gc
import os
import pickle
import signal
import subprocess
import sys
import textwrap
import threading
import time
import warnings
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import fiber
from fiber.process import PoolProcess
from fiber.results import ApplyResult
from patience import PATIENCE
from processes import pool_tasks as tasks
from processes.pool_programs import ENVIRON, is_alive, run_program, wait_until

on_each_backend = pytest.mark.usefixtures("backend")

# The end


@on_each_backend
def test_close_lets_everything_be_done_once(tmp_path: Path) -> None:
    pool = fiber.Pool(2)
    results = [pool.apply_async(tasks.nap_and_return, (n,)) for n in range(100)]
    counted = pool.map_async(tasks.count, [tmp_path / str(n) for n in range(50)], chunksize=1)
    mapped = pool.map_async(tasks.square, range(100))
    iterator = pool.imap(tasks.square, iter(range(100)))
    pool.close()
    pool.join()
    assert [result.get(0) for result in results] == list(range(100))
    assert counted.get(0) == [1] * 50
    assert mapped.get(0) == list(iterator) == [x * x for x in range(100)]
    assert pool._pool == []


def test_join_waits_for_callbacks() -> None:
    seen: list[int] = []

    def slowly(value: int) -> None:
        time.sleep(0.01)
        seen.append(value)

    pool = fiber.Pool(2)
    for n in range(10):
        pool.apply_async(tasks.identity, (n,), callback=slowly)
    pool.close()
    pool.join()
    assert sorted(seen) == list(range(10))


def test_join_does_not_wait_for_results_to_be_consumed() -> None:
    pool = fiber.Pool(2)
    iterator = pool.imap(tasks.square, iter(range(50)), buffersize=3)
    pool.close()
    pool.join()
    assert list(iterator) == [x * x for x in range(50)]


@on_each_backend
def test_a_closed_pool_accepts_no_call() -> None:
    pool = fiber.Pool(1)
    pool.close()
    pool.close()
    calls: list[Callable[..., object]] = [
        pool.map,
        pool.map_async,
        pool.imap,
        pool.imap_unordered,
        pool.starmap,
    ]
    for call in calls:
        with pytest.raises(ValueError, match="Pool not running"):
            call(tasks.square, [(1,)])
    calls = [pool.apply, pool.apply_async, pool.broadcast]
    for call in calls:
        with pytest.raises(ValueError, match="Pool not running"):
            call(tasks.square)
    with pytest.raises(ValueError, match="Pool not running"), pool:
        pass
    pool.join()


def test_join_before_close_is_an_error() -> None:
    with fiber.Pool(1) as pool, pytest.raises(ValueError, match="Pool is still running"):
        pool.join()
    pool.join()


@on_each_backend
def test_terminate_is_prompt_and_ends_every_wait() -> None:
    pool = fiber.Pool(3)
    results = [pool.apply_async(tasks.sleep, (600,)) for _ in range(5)]
    mapped = pool.map_async(tasks.sleep, [600] * 10_000, chunksize=1)
    ordered = pool.imap(tasks.sleep, iter([600] * 1000))
    unordered = pool.imap_unordered(tasks.sleep, [600] * 1000)
    pids = [process.pid for process in pool._pool]
    pool.terminate()
    pool.join()
    assert not any(is_alive(pid) for pid in pids)
    every: list[ApplyResult[Any]] = [*results, mapped]
    for result in every:
        with pytest.raises(fiber.FiberError, match="terminated"):
            result.get(PATIENCE)
        assert not result.successful()
    for iterator in (ordered, unordered):
        with pytest.raises(fiber.FiberError, match="terminated"):
            iterator.next(PATIENCE)
        with pytest.raises(StopIteration):
            iterator.next(PATIENCE)


@on_each_backend
@pytest.mark.slow
def test_terminate_ends_workers_that_ignore_sigterm(tmp_path: Path) -> None:
    pool = fiber.Pool(1)
    pool.apply(signal.signal, (signal.SIGTERM, signal.SIG_IGN))
    pool.apply_async(tasks.announce_and_sleep, (tmp_path / "here",))
    (pid,) = tasks.wait_until_announced(tmp_path / "here")
    pool.terminate()
    assert not is_alive(pid)
    pool.join()


@on_each_backend
def test_terminate_twice_and_after_close() -> None:
    pool = fiber.Pool(1)
    pool.close()
    pool.terminate()
    pool.terminate()
    pool.join()
    pool.join()


def test_a_callback_may_terminate_the_pool(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    pool = fiber.Pool(2)
    result = pool.apply_async(tasks.wait_for, (gate,), callback=lambda _: pool.terminate())
    waiting = pool.map_async(tasks.sleep, [600] * 100, 1)
    gate.touch()
    with pytest.raises(fiber.FiberError, match="terminated"):
        waiting.get(PATIENCE)
    pool.join()
    assert result.get(PATIENCE) == "gate"


def test_terminate_while_the_input_is_read() -> None:
    gate = threading.Event()

    def source() -> Iterator[int]:
        yield 1
        gate.wait(PATIENCE)
        yield 2

    pool = fiber.Pool(1)
    iterator = pool.imap(tasks.square, source())
    assert iterator.next(PATIENCE) == 1
    pool.terminate()
    pool.join()
    gate.set()
    with pytest.raises(fiber.FiberError, match="terminated"):
        iterator.next(PATIENCE)


def test_a_map_that_is_waited_for_ends_with_the_pool(tmp_path: Path) -> None:
    pool = fiber.Pool(1)
    errors: list[BaseException] = []

    def work() -> None:
        try:
            pool.map(tasks.announce_and_sleep, iter([tmp_path / "here"] * 100))
        except fiber.FiberError as error:
            errors.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    tasks.wait_until_announced(tmp_path / "here")
    pool.terminate()
    thread.join(PATIENCE)
    assert len(errors) == 1
    pool.join()


# It has no owner


def test_an_unreferenced_pool_warns_and_ends() -> None:
    pool = fiber.Pool(2)
    assert pool.map(tasks.square, range(3)) == [0, 1, 4]
    pids = [process.pid for process in pool._pool]
    gone = weakref.ref(pool)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        del pool
        gc.collect()
    (warning,) = caught
    assert warning.category is ResourceWarning
    assert "unclosed running multiprocessing pool" in str(warning.message)
    caught.clear()
    del warning  # it names its source, the pool
    assert gone() is None
    wait_until(lambda: not any(map(is_alive, pids)), "the workers end")


def test_a_result_keeps_its_pool() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        result = fiber.Pool(1).map_async(tasks.nap_and_return, range(100))
        assert result.get(PATIENCE) == list(range(100))
        iterator = fiber.Pool(1).imap(tasks.nap_and_return, iter(range(100)))
        assert list(iterator) == list(range(100))
        gc.collect()


@pytest.mark.parametrize("workers", [1, 2], ids=["the first", "one of several"])
def test_a_pool_whose_making_is_interrupted_as_a_worker_was_started_leaves_none(
    monkeypatch: pytest.MonkeyPatch, workers: int
) -> None:
    started: list[PoolProcess] = []
    start = PoolProcess.start

    def interrupted(process: PoolProcess) -> None:
        start(process)
        started.append(process)
        if len(started) == workers:
            raise KeyboardInterrupt

    monkeypatch.setattr(PoolProcess, "start", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fiber.Pool(workers)
    for process in started:
        process.join(PATIENCE)
    assert [process.exitcode for process in started] == [-signal.SIGTERM] * workers


def test_pools_do_not_pickle() -> None:
    text = "pool objects cannot be passed between processes or pickled"
    with fiber.Pool(1) as pool, pytest.raises(NotImplementedError, match=text):
        pickle.dumps(pool)
    pool.join()


def test_a_fork_of_the_program_cannot_use_its_pool() -> None:
    with fiber.Pool(1) as pool:
        read, write = os.pipe()
        pid = os.fork()
        if pid == 0:
            try:
                try:
                    pool.map(tasks.square, range(3))
                except RuntimeError as error:
                    os.write(write, str(error).encode())
            finally:
                os._exit(0)
        os.close(write)
        with os.fdopen(read) as file:
            assert f"belongs to process {os.getpid()}" in file.read()
        os.waitpid(pid, 0)
        assert pool.map(tasks.square, range(3)) == [0, 1, 4]
    pool.join()


# Programs


@pytest.mark.parametrize("ending", ["", "pool.close()", "raise SystemExit(3)", "1 / 0"])
def test_a_program_may_end_with_a_living_pool(ending: str) -> None:
    done = run_program(f"""
        import fiber
        from processes import pool_tasks as tasks
        pool = fiber.Pool(2)
        print(pool.map(tasks.square, range(4)), *[process.pid for process in pool._pool], sep=";")
        waiting = pool.map_async(tasks.sleep, [600] * 100)
        {ending}
    """)
    values, *pids = done.stdout.strip().split(";")
    assert values == "[0, 1, 4, 9]"
    assert done.returncode == {"raise SystemExit(3)": 3, "1 / 0": 1}.get(ending, 0)
    assert "Traceback" not in done.stderr.replace("Traceback", "", ending == "1 / 0")
    wait_until(lambda: not any(is_alive(int(pid)) for pid in pids), "the workers end")


def test_a_pool_that_is_global_data_of_a_program() -> None:
    # cpython's bpo-38744 and bpo-39360: the pool is collected when modules are torn down.
    done = run_program("""
        import fiber
        problem = None
        class Holder:
            def __init__(self):
                self.pool = fiber.Pool(processes=1)
        def test():
            global problem
            problem = Holder()
            problem.pool.map(float, tuple(range(10)))
        if __name__ == "__main__":
            test()
    """)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("call", ["pool.map", "list(pool.imap", "pool.apply"])
def test_ctrl_c_ends_a_wait(tmp_path: Path, call: str) -> None:
    path = tmp_path / "here"
    arguments = "(path,)" if call == "pool.apply" else "[path] * 100"
    program = subprocess.Popen(
        [
            sys.executable,
            "-c",
            textwrap.dedent(f"""
                import pathlib
                import fiber
                from processes import pool_tasks as tasks
                path = pathlib.Path({str(path)!r})
                with fiber.Pool(2) as pool:
                    try:
                        {call}(tasks.announce_and_sleep, {arguments}){")" * call.count("(")}
                    except KeyboardInterrupt:
                        print("interrupted", flush=True)
            """),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | ENVIRON,
    )
    pids = tasks.wait_until_announced(path, 1 if call == "pool.apply" else 2)
    os.killpg(program.pid, signal.SIGINT)  # as a terminal does: the whole group
    out, err = program.communicate(timeout=PATIENCE)
    assert (program.returncode, out, err) == (0, "interrupted\n", "")
    assert not any(map(is_alive, pids))


def test_after_ctrl_c_the_pool_goes_on(tmp_path: Path) -> None:
    path, gate = tmp_path / "here", tmp_path / "gate"
    done = run_program(f"""
        import pathlib, signal, threading
        import fiber
        from processes import pool_tasks as tasks
        path, gate = pathlib.Path({str(path)!r}), pathlib.Path({str(gate)!r})

        def interrupt():
            tasks.wait_until_announced(path, 2)
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

        with fiber.Pool(2) as pool:
            threading.Thread(target=interrupt).start()
            try:
                pool.starmap(tasks.announce_and_wait, [(path, gate)] * 500, 1)
            except KeyboardInterrupt:
                gate.touch()
            print(pool.map(tasks.square, range(4)))
            print(len(tasks.announced(path)))
        pool.join()
    """)
    assert done.stderr == ""
    assert done.stdout.split("\n")[0] == "[0, 1, 4, 9]"


# Size


def test_a_pool_follows_the_work(tmp_path: Path) -> None:
    path, gate = tmp_path / "here", tmp_path / "gate"
    with fiber.Pool(min_workers=1, max_workers=4, idle_timeout=0.1) as pool:
        assert len(pool._pool) == 1
        result = pool.starmap_async(tasks.announce_and_wait, [(path, gate)] * 10, 1)
        assert len(tasks.wait_until_announced(path, 4)) == 4
        assert len(pool._pool) == 4
        gate.touch()
        assert result.get(PATIENCE) == ["gate"] * 10
        wait_until(lambda: len(pool._pool) == 1, "idle workers leave")
        assert pool.apply(tasks.square, (3,)) == 9
    pool.join()


def test_an_empty_pool_grows_for_an_iterator_that_is_read_later(tmp_path: Path) -> None:
    path, gate = tmp_path / "here", tmp_path / "gate"
    with fiber.Pool(min_workers=0, max_workers=3) as pool:
        assert pool._pool == []
        iterator = pool.imap(tasks.wait_for, iter([gate] * 10))
        wait_until(lambda: len(pool._pool) == 3, "it grows")
        gate.touch()
        assert list(iterator) == ["gate"] * 10
        assert pool.map(tasks.square, iter(range(5))) == [0, 1, 4, 9, 16]
        path.touch()
    pool.join()


def test_a_pool_shrinks_to_no_workers_between_tasks(tmp_path: Path) -> None:
    with fiber.Pool(min_workers=0, max_workers=2, idle_timeout=0.05) as pool:
        assert pool.broadcast(tasks.pid) == []
        for _ in range(3):
            assert pool.apply(tasks.square, (3,)) == 9
            wait_until(lambda: pool._pool == [], "idle workers leave")
    pool.join()


def test_busy_workers_do_not_leave(tmp_path: Path) -> None:
    path, gate = tmp_path / "here", tmp_path / "gate"
    with fiber.Pool(min_workers=1, max_workers=3, idle_timeout=0.02) as pool:
        results = [pool.apply_async(tasks.announce_and_wait, (path, gate)) for _ in range(3)]
        pids = set(tasks.wait_until_announced(path, 3))
        # A timer that comes after any with which the pool, by now, may watch for idle workers.
        passed, loop = threading.Event(), pool._executor._loop
        loop.call_later(0.04, passed.set)
        assert passed.wait(PATIENCE)
        staying = [process for process in pool._pool if not process._handle.leaving]
        assert {process.pid for process in staying} == pids
        gate.touch()
        assert [result.get(PATIENCE) for result in results] == ["gate"] * 3
    pool.join()


def test_processes_look_like_processes() -> None:
    with fiber.Pool(2) as pool:
        for process in pool._pool:
            assert process.is_alive()
            assert process.pid is not None
            assert process.exitcode is None
            assert process in fiber.active_children()
        assert pool._processes == 2
        assert "state=RUN pool_size=2" in repr(pool)
        processes = pool._pool
    pool.join()
    assert all(process.exitcode is not None for process in processes)
    assert not set(processes) & set(fiber.active_children())


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["local", "loopback"])
def test_classes_of_a_main_that_goes_by_value_come_back_as_themselves(backend: str) -> None:
    done = run_program(
        """
        import fiber
        class Point:
            def __init__(self, x):
                self.x = x
        class Trouble(Exception):
            pass
        def make(x):
            return Point(x), make
        def fail(x):
            raise Trouble(x)
        if __name__ == "__main__":
            with fiber.Pool(1) as pool:
                point, function = pool.apply(make, (3,))
                print(isinstance(point, Point), point.x, function is make)
                try:
                    pool.map(fail, [4])
                except Trouble as error:
                    print(error.args)
        """,
        {"FIBER_BACKEND": backend},
    )
    assert (done.stdout, done.stderr) == ("True 3 True\n(4,)\n", "")
