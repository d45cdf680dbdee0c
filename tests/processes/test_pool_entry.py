"""Entering a pool from anywhere: signal handlers, finalizers, forks; at any line of Fiber's code.

A handler or a finalizer runs between two lines of any code of its thread.  So these tests
strike at lines: once at each of Fiber's that a thread passes.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from multiprocessing import util
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

import pytest

import fiber
from fiber import pool as pool_module
from fiber import process
from fiber._agent import agent, zygote_link
from fiber._engine.scheduler import Scheduler
from fiber._runtime import executor, popen, state, workers
from fiber._runtime.state import runtime
from fiber._runtime.work_items import InputStream
from fiber.pool import Pool
from patience import PATIENCE
from processes import pool_tasks as tasks
from processes.pool_programs import run_program, wait_until

FIBER = str(Path(fiber.__file__).parent)


class Stop(BaseException):
    """Exception that a signal's handler raises."""


@pytest.fixture
def pool() -> Iterator[Pool]:
    """Two workers that must be of use to the end, and know of nothing undone then."""
    pool = fiber.Pool(2)
    yield pool
    assert pool.apply(tasks.square, (3,)) == 9
    wait_until(lambda: not unfinished(pool), "all that was asked for is done or forgotten")
    assert pool.map(tasks.square, iter(range(10))) == [x * x for x in range(10)]
    pool.close()
    pool.join()


def unfinished(pool: Pool) -> list[Any]:
    """The jobs that are not done, but for that of single calls, which has nothing to do."""
    jobs = list(pool._executor._scheduler.ledger.jobs)
    return [job for job in jobs if job.owner.future is not None or job.done < job.fed]


CALLS: dict[str, Callable[[Pool], object]] = {
    "apply": lambda pool: pool.apply(tasks.square, (3,)),
    "apply_async": lambda pool: pool.apply_async(tasks.square, (3,)).get(PATIENCE),
    "broadcast": lambda pool: pool.broadcast(tasks.square, 3),
    "map": lambda pool: pool.map(tasks.square, [1, 2, 3]),
    "map an iterator": lambda pool: pool.map(tasks.square, iter(range(20))),
    "starmap": lambda pool: pool.starmap(tasks.add, [(1, 2), (3, 4)]),
    "map_async": lambda pool: pool.map_async(tasks.square, [1, 2, 3]).get(PATIENCE),
    "imap": lambda pool: list(pool.imap(tasks.square, [1, 2, 3])),
    "imap an iterator": lambda pool: list(pool.imap(tasks.square, iter(range(5)))),
    "imap_unordered": lambda pool: list(
        pool.imap_unordered(tasks.square, iter(range(9)), buffersize=2)
    ),
}

each_call = pytest.mark.parametrize("call", CALLS.values(), ids=CALLS.keys())


class Striking:
    """Block in which an action runs once at each line of Fiber's, or of some of its modules.

    An error of the action is raised at the line, and ends the striking. Lines of finalizers are
    spared then, because errors there are lost.
    """

    def __init__(self, action: Callable[[], object], *modules: ModuleType) -> None:
        self.struck: set[tuple[Any, int]] = set()
        self._action = action
        self._files = tuple(str(module.__file__) for module in modules) or FIBER
        self._before: Any = None

    def begin(self) -> None:
        self._before = sys.gettrace()
        sys.settrace(self._trace)

    def end(self) -> None:
        sys.settrace(self._before)

    def __enter__(self) -> Striking:
        self.begin()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.end()

    def _trace(self, frame: FrameType, event: str, argument: Any) -> Any:
        if not frame.f_code.co_filename.startswith(self._files) or _within_finalizer(frame):
            return None
        line = (frame.f_code, frame.f_lineno)
        if event == "line" and line not in self.struck:
            self.struck.add(line)
            self._action()
        return self._trace


def _within_finalizer(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_name == "__del__":
            return True
        frame = frame.f_back
    return False


# Signals


@pytest.fixture
def _signals_raise() -> Iterator[None]:
    """Raise from the handler of SIGUSR1, without the garbage collection, which loses errors."""

    def stop(signum: int, frame: Any) -> None:
        raise Stop

    before = signal.signal(signal.SIGUSR1, stop)
    gc.collect()
    gc.disable()
    yield
    gc.enable()
    gc.collect()
    signal.signal(signal.SIGUSR1, before)


@pytest.mark.slow
@pytest.mark.usefixtures("_signals_raise")
@each_call
def test_a_handler_that_raises_at_any_line_loses_this_call_only(
    pool: Pool, call: Callable[[Pool], object]
) -> None:
    striking = Striking(lambda: signal.raise_signal(signal.SIGUSR1))
    struck = -1
    while len(striking.struck) > struck:
        struck = len(striking.struck)
        with contextlib.suppress(Stop), striking:
            call(pool)
        assert pool.apply_async(tasks.square, (3,)).get(PATIENCE) == 9
        wait_until(lambda: not unfinished(pool), "the interrupted call is forgotten or done")
    assert struck > 10


@pytest.mark.usefixtures("_signals_raise")
@pytest.mark.filterwarnings("ignore:unclosed running:ResourceWarning")
@pytest.mark.parametrize("method", ["close", "terminate", "__exit__"])
def test_a_pool_whose_end_was_interrupted_at_any_line_ends_when_it_is_dropped(method: str) -> None:
    striking = Striking(lambda: signal.raise_signal(signal.SIGUSR1))
    struck = -1
    while len(striking.struck) > struck:
        struck = len(striking.struck)
        pool = fiber.Pool(min_workers=0, max_workers=1)
        ended = pool._executor.ended
        with contextlib.suppress(Stop), striking:
            getattr(pool, method)()
        del pool
        assert ended.wait(PATIENCE)
    assert struck > 5


@each_call
def test_a_handler_at_any_line_may_use_the_pool(pool: Pool, call: Callable[[Pool], object]) -> None:
    found: list[Any] = []

    def use(signum: int, frame: Any) -> None:
        found.append(pool.apply_async(tasks.square, (3,)))
        found.append(pool.map_async(tasks.square, [1, 2]))
        assert pool.apply(tasks.square, (4,)) == 16

    before = signal.signal(signal.SIGUSR1, use)
    try:
        with Striking(lambda: signal.raise_signal(signal.SIGUSR1)) as striking:
            call(pool)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert len(found) == 2 * len(striking.struck) > 20
    assert [result.get(PATIENCE) for result in found] == [9, [1, 4]] * len(striking.struck)


@pytest.mark.parametrize(
    ("function", "call"),
    [
        ("PoolExecutor.call", "pool.apply_async(abs, (1,))"),
        ("InputStream.read", "pool.map(abs, iter([1]))"),
    ],
)
def test_a_signal_handler_may_terminate_the_pool_that_it_interrupts(
    function: str, call: str
) -> None:
    done = run_program(f"""
        import signal
        import fiber
        from fiber._runtime.executor import PoolExecutor
        from fiber._runtime.work_items import InputStream
        real = {function}
        def interrupted(*args, **options):
            signal.raise_signal(signal.SIGTERM)
            return real(*args, **options)
        {function} = interrupted
        pool = fiber.Pool(1)
        signal.signal(signal.SIGTERM, lambda *_: pool.terminate())
        try:
            {call}
        except (fiber.FiberError, ValueError):
            pass
        pool.join()
        print("ended")
    """)
    assert (done.stdout, done.stderr) == ("ended\n", "")


def test_no_handler_is_ever_changed(pool: Pool) -> None:
    changes: list[Any] = []

    def spy(frame: FrameType, event: str, argument: Any) -> None:
        if event == "c_call" and argument.__module__ == "_signal":
            changes.append(argument.__name__)

    handlers = [signal.getsignal(number) for number in signal.valid_signals()]
    before = sys.getprofile()
    sys.setprofile(spy)  # this is the main thread, and no other can change any
    try:
        for call in CALLS.values():
            call(pool)
        with fiber.Pool(1) as other:
            other.map(tasks.square, range(3))
        other.join()
    finally:
        sys.setprofile(before)
    assert changes == []
    assert [signal.getsignal(number) for number in signal.valid_signals()] == handlers


def test_handlers_in_c_live_on(pool: Pool, tmp_path: Path) -> None:
    heard: list[int] = []
    before = signal.signal(signal.SIGUSR1, lambda signum, frame: heard.append(signum))
    try:
        with (tmp_path / "traces").open("w+") as file:
            faulthandler.register(signal.SIGUSR1, file=file, chain=True)
            try:
                for call in CALLS.values():
                    call(pool)
                signal.raise_signal(signal.SIGUSR1)
            finally:
                faulthandler.unregister(signal.SIGUSR1)
            file.seek(0)
            assert "most recent call first" in file.read()
        assert heard == [signal.SIGUSR1]
    finally:
        signal.signal(signal.SIGUSR1, before)


# Finalizers


@each_call
def test_a_finalizer_at_any_line_may_use_the_pool(
    pool: Pool, call: Callable[[Pool], object]
) -> None:
    found: list[Any] = []

    class Finalized:
        def __del__(self) -> None:
            found.append(pool.apply_async(tasks.square, (3,)))

    with Striking(Finalized) as striking:
        call(pool)
    assert len(found) == len(striking.struck) > 10
    assert [result.get(PATIENCE) for result in found] == [9] * len(found)


@contextlib.contextmanager
def striking_at_the_loop(action: Callable[[], object]) -> Iterator[Striking]:
    """The same for the lines that the loop thread passes."""
    loop = runtime().loop
    striking = Striking(action)
    loop.call_soon(striking.begin)
    yield striking
    ended = threading.Event()
    loop.call_soon(striking.end)
    loop.call_soon(ended.set)
    assert ended.wait(PATIENCE), "the loop thread waits for something"


def test_a_finalizer_at_any_line_of_the_loop_may_use_the_pool(pool: Pool) -> None:
    found: list[Any] = []

    class Finalized:
        def __del__(self) -> None:
            found.append(pool.apply_async(tasks.square, (3,)))
            repr(pool)

    with striking_at_the_loop(Finalized) as striking:
        for call in CALLS.values():
            call(pool)
        pool.map_async(tasks.square, [tasks.Point(3).x, 2]).get(PATIENCE)
        with fiber.Pool(1) as other:
            other.map(tasks.square, range(3))
        other.join()
    assert len(found) == len(striking.struck) > 100
    assert [result.get(PATIENCE) for result in found] == [9] * len(found)


def test_a_pool_may_be_dropped_at_any_line_of_the_loop(pool: Pool) -> None:
    # Of many that have no workers yet: those are quickly made.
    dropped = [fiber.Pool(min_workers=0, max_workers=1) for _ in range(600)]
    ended = [other._executor.ended for other in dropped]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        with striking_at_the_loop(lambda: dropped and dropped.pop()) as striking:
            for call in CALLS.values():
                call(pool)
        assert len(striking.struck) > 100
        dropped.clear()
    for latch in ended:
        assert latch.wait(PATIENCE)


def test_calls_that_wait_are_refused_to_a_finalizer_on_the_loop_thread() -> None:
    done = run_program("""
        import threading, time
        import fiber
        from fiber._runtime.state import runtime
        from processes import pool_tasks as tasks
        with fiber.Pool(2) as pool:
            late = pool.apply_async(time.sleep, (60,))
            for wait in (
                lambda: pool.map(tasks.square, [3]),
                lambda: pool.map(tasks.square, iter([3])),
                lambda: pool.starmap(time.sleep, [(60,)]),
                lambda: next(pool.imap(tasks.square, [3])),
                lambda: pool.broadcast(tasks.square, 3),
                late.get,
                fiber.Process(target=time.sleep, args=(60,)).start,
            ):
                over = threading.Event()
                def attempt():
                    try:
                        wait()
                    except RuntimeError as error:
                        print(error)
                    over.set()
                runtime().loop.call_soon(attempt)
                over.wait()
            print(late.ready(), pool.apply_async(tasks.square, (3,)).get())
    """)
    *refusals, last = done.stdout.splitlines()
    assert (last, done.stderr) == ("False 9", "")
    assert len(refusals) == 7
    assert all("cannot wait" in refusal for refusal in refusals)


@pytest.mark.parametrize("method", ["ready", "decide", "gone"])
def test_a_pool_that_the_collector_finds_while_the_loop_works_for_it_ends(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    forgotten, collected = threading.Event(), threading.Event()
    real = getattr(Scheduler, method)

    def collecting(scheduler: Scheduler, *args: Any, **options: Any) -> Any:
        if forgotten.is_set() and not collected.is_set():
            gc.collect()
            collected.set()
        return real(scheduler, *args, **options)

    monkeypatch.setattr(Scheduler, method, collecting)
    gc.disable()
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            pool = fiber.Pool(1)
            (process,) = pool._pool
            pid = process.pid
            pool.me = pool  # type: ignore[attr-defined]
            del pool, process
            forgotten.set()
            os.kill(pid, signal.SIGKILL)
            assert collected.wait(PATIENCE)
            wait_until(lambda: caught, "it is forgotten")
        assert [warning.category for warning in caught] == [ResourceWarning]
        caught.clear()
    finally:
        gc.enable()
    wait_until(lambda: not multiprocessing.active_children(), "its workers end")


# Starts


STARTING = (
    agent,
    executor,
    pool_module,
    popen,
    process,
    state,
    workers,
    zygote_link,
)


def living() -> list[Any]:
    """The children of this host's agent, which knows all that there are."""
    return list(runtime().backend._children.values())  # type: ignore[attr-defined]


def at_exit() -> list[Any]:
    """Pools that are there, and will be waited for."""
    gc.collect()
    finalizers: list[Any] = list(util._finalizer_registry.values())  # type: ignore[attr-defined]
    return [each for each in finalizers if each._callback is pool_module._abandon]


@pytest.mark.slow
@pytest.mark.usefixtures("_signals_raise")
@pytest.mark.filterwarnings("ignore:unclosed running:ResourceWarning")
def test_a_pool_whose_start_was_interrupted_at_any_line_leaves_no_worker() -> None:
    striking = Striking(lambda: signal.raise_signal(signal.SIGUSR1), *STARTING)
    struck = -1
    while len(striking.struck) > struck:
        struck = len(striking.struck)
        pools = []
        with contextlib.suppress(Stop), striking:
            pools.append(fiber.Pool(1))
        pools.clear()
        wait_until(lambda: not living(), "its worker ends")
    assert struck > 100
    wait_until(lambda: not at_exit(), "the end of the program has nothing to wait for")


@pytest.mark.usefixtures("_signals_raise")
def test_a_process_whose_start_was_interrupted_at_any_line_ends_or_is_known() -> None:
    striking = Striking(lambda: signal.raise_signal(signal.SIGUSR1), *STARTING)
    struck = -1
    while len(striking.struck) > struck:
        struck = len(striking.struck)
        with contextlib.suppress(Stop), striking:
            fiber.Process(target=time.sleep, args=(60,)).start()
        for known in multiprocessing.active_children():
            known.kill()
            known.join()
        wait_until(lambda: not living(), "it ends")
    assert struck > 50


def test_a_runtime_whose_making_was_interrupted_leaves_no_thread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise Stop

    state.shutdown()
    monkeypatch.setattr(util, "Finalize", interrupt)
    with pytest.raises(Stop):
        runtime()
    monkeypatch.undo()
    assert "fiber-io" not in [thread.name for thread in threading.enumerate()]
    with fiber.Pool(1) as pool:
        assert pool.apply(tasks.square, (3,)) == 9
    pool.join()


def test_a_runtime_made_within_making_one_keeps_its_hub() -> None:
    done = run_program("""
        import fiber
        from fiber._runtime import state
        real = state._make_backend
        def interrupted(runtime):
            state._make_backend = real
            state.runtime()
            return real(runtime)
        state._make_backend = interrupted
        with fiber.Pool(1) as pool:
            print(pool.apply(type, (fiber.Queue(),)).__name__)
    """)
    assert (done.stdout, done.stderr) == ("Queue\n", "")


# Forks


def forked(action: Callable[[], bytes]) -> bytes:
    """Return the result of a child that is forked from here."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            os.write(write, action())
        finally:
            os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as file:
        found = file.read()
    os.waitpid(pid, 0)
    return found


@pytest.mark.slow
def test_children_forked_by_another_thread_have_the_programs_handlers(pool: Pool) -> None:
    handler: Any = signal.getsignal(signal.SIGINT)
    expected = repr(handler).encode()
    found: list[bytes] = []

    def fork() -> None:
        for _ in range(100):
            found.append(forked(lambda: repr(signal.getsignal(signal.SIGINT)).encode()))

    thread = threading.Thread(target=fork)
    thread.start()
    while thread.is_alive():
        pool.apply(tasks.square, (3,))
    thread.join()
    assert set(found) == {expected}


@pytest.mark.parametrize(
    "ending", ["sys.exit(7)", "raise SystemExit(7)", "pool.terminate(); sys.exit(7)"]
)
def test_a_fork_within_the_block_of_a_pool_ends_as_it_says(ending: str) -> None:
    program = f"""
        import os, sys
        import fiber
        from processes import pool_tasks as tasks
        with fiber.Pool(1) as pool:
            pool.map(tasks.square, range(3))
            pid = os.fork()
            if pid == 0:
                {ending}
            print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
            print(pool.map(tasks.square, range(3)))
        pool.join()
    """
    # From Python 3.12 on os.fork() warns of any thread.
    done = run_program(program, {"PYTHONWARNINGS": "ignore::DeprecationWarning"})
    assert (done.stdout, done.stderr) == ("7\n[0, 1, 4]\n", "")


# A reader that is interrupted


def test_a_stream_whose_reader_was_interrupted_is_forgotten(
    pool: Pool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(stream: InputStream, iterable: Any) -> None:
        raise Stop

    monkeypatch.setattr(InputStream, "read", interrupted)
    with pytest.raises(Stop):
        pool.map(tasks.square, iter(range(5)))
    monkeypatch.undo()
    wait_until(lambda: not unfinished(pool), "it is forgotten")
