"""The loop: order, timers, descriptors, errors in callbacks, and how it ends."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest

from census import wait_until
from fiber._transport import loop as loop_module
from fiber._transport.loop import Loop
from fiber.errors import FiberError
from patience import PATIENCE


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    yield ends
    for fd in ends:
        try:
            os.close(fd)
        except OSError:
            pass  # the test closed it itself


@pytest.fixture
def complaints(monkeypatch: pytest.MonkeyPatch) -> list[BaseException]:
    """Return the exceptions of callbacks."""
    seen: list[BaseException] = []
    monkeypatch.setattr(sys, "excepthook", lambda _kind, error, _trace: seen.append(error))
    return seen


def settled(loop: Loop) -> None:
    """Wait until the loop has done what was asked of it so far."""
    done = threading.Event()
    loop.call_soon(done.set)
    assert done.wait(PATIENCE)


def test_calls_are_made_in_order_on_its_thread(loop: Loop) -> None:
    calls: list[tuple[int, bool]] = []
    for number in range(100):
        loop.call_soon(lambda n: calls.append((n, loop.on_thread())), number)
    settled(loop)
    assert calls == [(number, True) for number in range(100)]
    assert not loop.on_thread()


def test_calls_from_many_threads_all_arrive_each_thread_in_order(loop: Loop) -> None:
    calls: list[tuple[int, int]] = []

    def ask(me: int) -> None:
        for number in range(200):
            loop.call_soon(calls.append, (me, number))

    threads = [threading.Thread(target=ask, args=(me,)) for me in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    settled(loop)
    for me in range(4):
        assert [number for who, number in calls if who == me] == list(range(200))


def test_timers_fire_in_order_of_their_time(loop: Loop) -> None:
    fired: list[str] = []
    last = threading.Event()

    def third() -> None:
        fired.append("third")
        last.set()

    loop.call_later(0.03, third)
    loop.call_later(0.02, fired.append, "second")
    loop.call_later(0.0, fired.append, "first")
    assert last.wait(PATIENCE)
    assert fired == ["first", "second", "third"]


def test_a_cancelled_timer_never_fires(loop: Loop) -> None:
    fired: list[str] = []
    last = threading.Event()
    cancelled = loop.call_later(0.01, fired.append, "cancelled")
    loop.call_later(0.02, last.set)
    cancelled.cancel()
    assert last.wait(PATIENCE)
    assert fired == []


def test_a_timer_asked_for_by_a_callback_fires(loop: Loop) -> None:
    fired = threading.Event()
    loop.call_soon(lambda: loop.call_later(0.001, fired.set))
    assert fired.wait(PATIENCE)


def test_calls_that_ask_for_more_calls_do_not_keep_descriptors_waiting(
    loop: Loop, pipe: tuple[int, int]
) -> None:
    heard = threading.Event()

    def again() -> None:
        if not heard.is_set():
            loop.call_soon(again)

    def hear() -> None:
        os.read(pipe[0], 1)
        heard.set()

    loop.register(pipe[0], hear)
    loop.call_soon(again)
    os.write(pipe[1], b"x")
    assert heard.wait(PATIENCE)
    loop.unregister(pipe[0])


def test_a_reader_gets_data_and_the_end(loop: Loop, pipe: tuple[int, int]) -> None:
    heard: list[bytes] = []
    ended = threading.Event()

    def read() -> None:
        heard.append(os.read(pipe[0], 100))
        if not heard[-1]:
            loop.unregister(pipe[0])
            ended.set()

    loop.register(pipe[0], read)
    os.write(pipe[1], b"data")
    os.close(pipe[1])
    assert ended.wait(PATIENCE)
    assert heard == [b"data", b""]


def test_earlier_requests_run_before_later_events(loop: Loop, pipe: tuple[int, int]) -> None:
    """Register an expectation with ``call_soon``, then cause the event: the order is kept."""
    reading, writing = pipe
    seen: list[str] = []
    busy, go_on, heard = threading.Event(), threading.Event(), threading.Event()

    def hear() -> None:
        seen.append(os.read(reading, 100).decode())
        heard.set()

    def be_busy() -> None:
        busy.set()
        go_on.wait(PATIENCE)

    loop.register(reading, hear)
    loop.call_soon(be_busy)
    assert busy.wait(PATIENCE)
    loop.call_soon(seen.append, "expected")
    os.write(writing, b"happened")
    go_on.set()
    assert heard.wait(PATIENCE)
    loop.unregister(reading)
    assert seen == ["expected", "happened"]


def test_many_ready_descriptors_are_served_in_groups_and_in_turn(
    loop: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop_module, "_EVENTS", 2)
    readable = [os.eventfd(1) for _ in range(6)]
    calls: list[object] = []
    all_called = threading.Event()

    def call(fd: int) -> None:
        if not calls:
            loop.call_soon(calls.append, "asked for meanwhile")
        calls.append(fd)
        if set(readable) <= set(calls):
            all_called.set()

    def all_ready() -> None:
        for fd in readable:
            loop.register(fd, partial(call, fd))

    loop.call_soon(all_ready)  # on its thread, so that one poll could see them all
    assert all_called.wait(PATIENCE)
    for fd in readable:
        loop.unregister(fd)
        os.close(fd)
    assert calls.index("asked for meanwhile") <= 2


def test_a_writer_is_called_until_it_is_taken_back(loop: Loop, pipe: tuple[int, int]) -> None:
    calls: list[int] = []
    enough = threading.Event()

    def write() -> None:
        calls.append(len(calls))
        if len(calls) == 3:
            loop.want_write(pipe[1], None)
            enough.set()

    loop.register(pipe[1], lambda: None)
    loop.call_soon(loop.want_write, pipe[1], write)
    assert enough.wait(PATIENCE)
    settled(loop)
    assert calls == [0, 1, 2]
    loop.unregister(pipe[1])


def test_a_descriptor_that_a_callback_forgot_is_not_called_in_the_same_round(loop: Loop) -> None:
    ends = [os.pipe() for _ in range(2)]
    readers = [reader for reader, _ in ends]
    calls: list[int] = []
    called = threading.Event()

    def first_come(me: int) -> None:
        calls.append(me)
        for reader in readers:
            loop.unregister(reader)
        called.set()

    def both_ready() -> None:
        for reader in readers:
            loop.register(reader, partial(first_come, reader))
        for _, writer in ends:
            os.write(writer, b"x")

    loop.call_soon(both_ready)  # on its thread, so that one poll sees both
    assert called.wait(PATIENCE)
    settled(loop)
    assert len(calls) == 1
    for fd in (fd for pair in ends for fd in pair):
        os.close(fd)


def test_an_error_in_a_callback_is_shown_and_does_not_stop_the_loop(
    loop: Loop, pipe: tuple[int, int], complaints: list[BaseException]
) -> None:
    def broken(*_: Any) -> None:
        raise ValueError("broken callback")

    def broken_reader() -> None:
        os.read(pipe[0], 1)
        broken()

    loop.call_soon(broken)
    loop.call_later(0, broken)
    loop.register(pipe[0], broken_reader)
    os.write(pipe[1], b"x")
    deadline = time.monotonic() + PATIENCE
    while len(complaints) < 3 and time.monotonic() < deadline:
        settled(loop)
    assert [str(error) for error in complaints] == ["broken callback"] * 3
    loop.unregister(pipe[0])


def test_stop_waits_for_the_end_and_leaves_no_descriptor() -> None:
    before = os.listdir("/proc/self/fd")
    loop = Loop()
    loop.start_thread("short")
    calls: list[str] = []
    loop.call_soon(calls.append, "asked before the stop")
    loop.stop()
    assert calls == ["asked before the stop"]
    assert not any(thread.name == "short" for thread in threading.enumerate())
    assert os.listdir("/proc/self/fd") == before
    loop.stop()  # the second close does nothing


def test_a_loop_whose_thread_could_not_be_started_can_be_stopped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    before = len(os.listdir("/proc/self/fd"))
    loop = Loop()
    monkeypatch.setattr(threading.Thread, "start", refuse)
    with pytest.raises(RuntimeError, match="can't start new thread"):
        loop.start_thread("never")
    loop.stop()
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_call_after_the_end_writes_into_no_foreign_descriptor() -> None:
    loop = Loop()
    loop.start_thread("short")
    loop.stop()
    # The next file to open gets the numbers that the loop had.
    others = [os.eventfd(0, os.EFD_NONBLOCK) for _ in range(4)]
    loop.call_soon(lambda: None)
    for fd in others:
        with pytest.raises(BlockingIOError):
            os.eventfd_read(fd)
        os.close(fd)


def test_a_signal_handler_interrupts_the_loop_of_the_main_thread() -> None:
    loop = Loop()
    before = signal.signal(signal.SIGALRM, lambda *_: loop.call_soon(loop.stop))
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.01)
        loop.run()
    finally:
        signal.signal(signal.SIGALRM, before)


def test_now_is_monotonic_seconds() -> None:
    before: Callable[[], float] = time.monotonic
    assert before() <= Loop.now() <= time.monotonic()


@pytest.mark.parametrize("seconds", [math.inf, 1e7, 1e300])
def test_a_timer_of_ages_does_not_stop_it(loop: Loop, seconds: float) -> None:
    timer = loop.call_later(seconds, pytest.fail, "so soon")
    settled(loop)
    settled(loop)
    timer.cancel()
    settled(loop)


def test_timers_that_were_cancelled_long_before_their_time_do_not_pile_up(loop: Loop) -> None:
    loop.call_later(300, pytest.fail)  # comes before them, and is not due either
    for _ in range(20):
        for timer in [loop.call_later(600, pytest.fail) for _ in range(1000)]:
            timer.cancel()
        settled(loop)
    assert len(loop._timers) < 5000


class Dependent:
    def __init__(self) -> None:
        self.error: FiberError | None = None

    def broken(self, error: FiberError) -> None:
        self.error = error


def test_dependents_learn_that_the_loop_failed() -> None:
    loop = Loop()
    dependent, forgotten = Dependent(), Dependent()
    loop.depend(dependent)
    loop.depend(forgotten)
    del forgotten
    loop.call_soon(os.close, loop._epoll.fileno())
    with pytest.raises(OSError, match="Bad file descriptor"):
        loop.run()
    assert isinstance(dependent.error, FiberError)
    assert not loop.running
    with pytest.raises(FiberError, match="has ended by OSError"):
        loop.depend(dependent)
    loop.call_soon(pytest.fail)  # it is not closed
    loop.stop()


def test_a_closed_epoll_descriptor_ends_the_loop_with_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(loop_module, "LONGEST_POLL", 0.05)
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    loop, dependent = Loop(), Dependent()
    loop.depend(dependent)
    loop.start_thread("loop under test")
    settled(loop)
    os.close(loop._epoll.fileno())
    assert wait_until(lambda: dependent.error is not None, PATIENCE)
    assert loop._thread is not None
    loop._thread.join(PATIENCE)
