"""Waiting for something that happens once, interrupted and from many threads."""

from __future__ import annotations

import gc
import signal
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from fiber._runtime import threads
from fiber._runtime.threads import Latch, Waiters, acquire
from fiber._runtime.work_items import InputStream
from patience import PATIENCE


class Stop(BaseException):
    """Exception that a signal's handler raises."""


def stop(signum: int, frame: Any) -> None:
    raise Stop


@pytest.fixture
def _signals_raise() -> Iterator[None]:
    before = signal.signal(signal.SIGUSR1, stop)
    yield
    signal.signal(signal.SIGUSR1, before)


def test_a_latch_stays_set() -> None:
    latch = Latch()
    assert not latch.is_set()
    assert not latch.wait(0)
    latch.set()
    latch.set()
    assert latch.is_set()
    assert latch.wait()
    assert latch.wait(0)


def test_a_latch_wakes_all_waiters() -> None:
    latch = Latch()
    went_on: list[bool] = []
    threads = [
        threading.Thread(target=lambda: went_on.append(latch.wait(PATIENCE))) for _ in range(20)
    ]
    for thread in threads:
        thread.start()
    while len(latch._waiters._locks) < len(threads):
        assert all(thread.is_alive() for thread in threads)
    latch.set()
    for thread in threads:
        thread.join()
    assert went_on == [True] * len(threads)
    assert latch._waiters._locks == []


def test_two_waking_waiters_release_each_lock_once() -> None:
    waiters = Waiters()
    locks = [waiters.join() for _ in range(1000)]
    threads = [threading.Thread(target=waiters.wake) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not any(lock.locked() for lock in locks)


def test_a_timed_out_wait_leaves_no_waiter() -> None:
    latch = Latch()
    for timeout in (0, 0.001, -1.0):
        assert not latch.wait(timeout)
    assert latch._waiters._locks == []


def test_leaving_while_one_is_released() -> None:
    waiters = Waiters()
    lock = waiters.join()
    waiters.wake()
    waiters.leave(lock)
    assert not lock.locked()


def test_a_latch_that_is_set_between_check_and_wait_ends_the_wait(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    latch = Latch()
    join = Waiters.join

    def joined_too_late(waiters: Waiters) -> threading.Lock:
        latch.set()
        return join(waiters)

    monkeypatch.setattr(Waiters, "join", joined_too_late)
    assert latch.wait()


@pytest.mark.usefixtures("_signals_raise")
def test_a_signal_that_raises_in_a_wait_leaves_it_to_others() -> None:
    latch = Latch()
    main = threading.main_thread()

    def interrupt() -> None:
        while not latch._waiters._locks:
            pass
        signal.pthread_kill(main.ident or 0, signal.SIGUSR1)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(Stop):
        latch.wait(PATIENCE)
    thread.join()
    assert not latch.wait(0)
    latch.set()
    assert latch.wait(0)


@pytest.mark.usefixtures("_signals_raise")
def test_a_signal_that_raises_as_the_wait_begins_leaves_it_to_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    latch = Latch()
    join = Waiters.join

    def interrupted(waiters: Waiters) -> threading.Lock:
        lock = join(waiters)
        signal.raise_signal(signal.SIGUSR1)
        return lock

    monkeypatch.setattr(Waiters, "join", interrupted)
    with pytest.raises(Stop):
        latch.wait()
    monkeypatch.undo()
    threads = [threading.Thread(target=latch.wait) for _ in range(3)]
    for thread in threads:
        thread.start()
    latch.set()
    for thread in threads:
        thread.join()
    assert latch._waiters._locks == []


def test_a_handler_may_set_the_latch_whose_wait_it_interrupts() -> None:
    latch = Latch()
    before = signal.signal(signal.SIGUSR1, lambda signum, frame: latch.set())
    try:
        timer = threading.Timer(
            0.01, signal.pthread_kill, (threading.main_thread().ident, signal.SIGUSR1)
        )
        timer.start()
        assert latch.wait(PATIENCE)
        timer.join()
    finally:
        signal.signal(signal.SIGUSR1, before)


class Sets:
    """Sets a latch when it is collected."""

    def __init__(self, latch: Latch) -> None:
        self.latch = latch
        self.me = self

    def __del__(self) -> None:
        self.latch.set()


@pytest.mark.slow
def test_a_finalizer_at_any_allocation_may_set_it() -> None:
    gc.collect()
    threshold = gc.get_threshold()
    gc.disable()
    try:
        for count in range(30):
            latch = Latch()
            Sets(latch)
            gc.set_threshold(gc.get_count()[0] + count)
            gc.enable()
            latch.wait(0)
            other = Latch()
            other.set()
            assert other.wait()
            gc.disable()
            gc.collect()
            assert latch.wait(0)
    finally:
        gc.set_threshold(*threshold)
        gc.enable()


@pytest.mark.parametrize("timeout", [None, float("inf"), 10**400])
def test_acquire_accepts_any_timeout(timeout: float | None) -> None:
    lock = threading.Lock()
    assert acquire(lock, timeout)


@pytest.mark.parametrize("timeout", [-5.0, 0, 0.01])
def test_a_limit_ends_the_wait(timeout: float) -> None:
    lock = threading.Lock()
    lock.acquire()
    assert not acquire(lock, timeout)


@pytest.mark.usefixtures("_signals_raise")
def test_a_signal_that_did_not_wake_the_waiting_thread_is_not_slept_over() -> None:
    latch = Latch()

    def strike() -> None:
        while not latch._waiters._locks or not asleep(threading.main_thread()):
            assert not latch.is_set()
        # It is noted here, and the main thread, which is to run the handler, sleeps on.
        signal.pthread_kill(threading.get_ident(), signal.SIGUSR1)

    striker = threading.Thread(target=strike)
    rescuer = threading.Timer(PATIENCE, latch.set)
    striker.start()
    rescuer.start()
    with pytest.raises(Stop):
        latch.wait()
    rescuer.cancel()
    striker.join()
    rescuer.join()
    assert not latch.is_set(), "the signal was slept over until the latch was set"


@pytest.mark.usefixtures("_signals_raise")
def test_a_signal_interrupts_a_thread_that_reads_the_input_of_a_pool() -> None:
    stream = InputStream(1, lambda: None)
    reads, over = threading.Event(), threading.Event()
    struck = list[bool]()

    class Items:
        def __iter__(self) -> Iterator[int]:
            reads.set()
            return iter(())

    def strike() -> None:
        reads.wait()
        while not asleep(threading.main_thread()):
            pass
        signal.pthread_kill(threading.get_ident(), signal.SIGUSR1)
        struck.append(over.wait(PATIENCE))
        stream.end()

    striker = threading.Thread(target=strike)
    striker.start()
    with pytest.raises(Stop):
        stream.read(Items())
    over.set()
    striker.join()
    assert struck == [True], "the signal was slept over until the stream ended"


def asleep(thread: threading.Thread) -> bool:
    """Return whether the kernel has put the thread to sleep."""
    with open(f"/proc/self/task/{thread.native_id}/stat") as file:
        return file.read().rpartition(") ")[2].startswith("S")


def test_a_wait_while_the_interpreter_ends_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    # By then the interpreter has stopped the thread that would set the latch.
    monkeypatch.setattr(threads, "sys", SimpleNamespace(is_finalizing=lambda: True))
    with pytest.raises(RuntimeError, match="the interpreter is ending"):
        Latch().wait()
