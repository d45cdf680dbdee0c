"""Barriers, used by threads on the barrier's host and by threads of another host.

Host ``a`` has the barrier.  Its hub takes the steps of a wait for the threads of host ``b``.
"""

from __future__ import annotations

import gc
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from queue import SimpleQueue
from threading import BrokenBarrierError
from typing import Any

import pytest

import fiber
from census import wait_until
from fiber import synchronize
from fiber._hub import parties as hub_parties
from fiber._hub import shared_blocks
from fiber._hub.client import HubStream
from fiber._hub.hosted import HostedSemaphore
from fiber._hub.protocol import Op, Status
from fiber._sync.semaphore import COUNTING
from hosts import Far, Hosts, Wire
from patience import PATIENCE

MANY = 30

Moved = Callable[[Any], Any]


@pytest.fixture(params=["one host", "two hosts"])
def moved(request: pytest.FixtureRequest, far: Far) -> Moved:
    """Moves a barrier to where the threads are that a test looks at."""
    return far if request.param == "two hosts" else lambda barrier: barrier


@pytest.fixture(autouse=True)
def _bells(hosts: Hosts) -> Iterator[None]:
    """Lets threads that use a barrier on its host ring the bell of that host's hub."""
    _doorbell.append(hosts["a"].doorbell.ring)
    yield
    _doorbell.clear()


_doorbell: list[Callable[[], None]] = []


def barrier_of(parties: int, action: Any = None) -> Any:
    """Return a new barrier of host a."""
    barrier: Any = fiber.Barrier(parties, action)
    for part in (barrier._cond._waiters, barrier._cond._lock._semlock):
        part._ring = _doorbell[0]
    return barrier


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets waiting threads look for dead members all the time."""
    monkeypatch.setattr(synchronize, "RECHECK", 0.01)
    monkeypatch.setattr(hub_parties, "RECHECK", 0.01)


class Comer(threading.Thread):
    """Thread that waits at a barrier each time that it is told to."""

    def __init__(self, barrier: Any) -> None:
        super().__init__()
        self.barrier = barrier
        self.orders: SimpleQueue[float | None] = SimpleQueue()
        self.results: SimpleQueue[Any] = SimpleQueue()
        self.start()

    def run(self) -> None:
        while (timeout := self.orders.get()) is not None:
            try:
                self.results.put(self.barrier.wait(timeout))
            except Exception as error:
                self.results.put(type(error))

    def come(self, timeout: float = PATIENCE) -> None:
        """Begin to wait, and return once the barrier counts this thread."""
        before = self.barrier.n_waiting
        self.orders.put(timeout)
        assert wait_until(lambda: self.barrier.n_waiting == before + 1, PATIENCE)

    def result(self) -> Any:
        """Return what the wait returned, or the type of its error."""
        return self.results.get(timeout=PATIENCE)


@contextmanager
def comers(*barriers: Any) -> Iterator[list[Comer]]:
    """Yield a thread for each."""
    threads = [Comer(barrier) for barrier in barriers]
    try:
        yield threads
    finally:
        for thread in threads:
            thread.orders.put(None)
            thread.join()


def meet(threads: Sequence[Comer], timeout: float = PATIENCE) -> list[Any]:
    """Let all wait; return what they got, sorted."""
    for thread in threads:
        thread.orders.put(timeout)
    return sorted((thread.result() for thread in threads), key=str)


def die(barrier: Any) -> None:
    """Close the sockets of a barrier of another host, as the end of its process would."""
    for part in (barrier._members, barrier._cond._waiters, barrier._cond._lock._semlock):
        for stream in part._streams:
            stream._sock.shutdown(socket.SHUT_RDWR)


# Indices


def test_each_gets_another_index_in_each_pass(far: Far) -> None:
    here = barrier_of(5)
    there = far(here)
    with comers(here, here, there, there, there) as threads:
        for _ in range(MANY):
            assert meet(threads) == [0, 1, 2, 3, 4]
    assert (here.n_waiting, here.broken) == (0, False)


def test_each_gets_another_index_if_there_are_more_threads_than_parties(far: Far) -> None:
    here = barrier_of(2)
    there = far(here)
    with comers(here, there, there, there) as threads:
        for _ in range(MANY):
            assert meet(threads) == [0, 0, 1, 1]
    assert (here.n_waiting, here.broken) == (0, False)


@pytest.mark.usefixtures("quick")
def test_indices_differ_if_one_comes_after_many_looks(
    moved: Moved, far: Far, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = barrier_of(3)
    there = moved(here)
    looks, remove_dead = [], type(here._members).remove_dead

    def counted(waiters: Any) -> Any:
        looks.append(1)
        return remove_dead(waiters)

    monkeypatch.setattr(type(here._members), "remove_dead", counted)
    with comers(there, there, far(here)) as threads:
        for late in threads:
            early = [thread for thread in threads if thread is not late]
            for thread in early:
                thread.come()
            looks.clear()
            assert wait_until(lambda: len(looks) > 20, PATIENCE)
            late.orders.put(PATIENCE)
            assert sorted(thread.result() for thread in threads) == [0, 1, 2]
    assert (here.n_waiting, here.broken) == (0, False)


def test_a_pass_takes_one_request_of_each(far: Far, wires: tuple[Wire, Wire]) -> None:
    there = far(barrier_of(3))
    up, _ = wires
    with comers(there, there, there) as threads:
        for _ in range(3):  # until each has a stream
            meet(threads)
        before = up.frames
        for _ in range(10):
            meet(threads)
        assert up.frames - before == 30


# Barriers that break


def test_a_timeout_breaks_it_for_all_until_it_is_reset(far: Far) -> None:
    here = barrier_of(3)
    there = far(here)
    with comers(here, there, there) as threads:
        assert meet(threads) == [0, 1, 2]
        *early, late = threads
        assert meet(early, timeout=0.01) == [BrokenBarrierError] * 2
        assert meet([late]) == [BrokenBarrierError]
        assert (here.n_waiting, here.broken, there.broken) == (0, True, True)
        there.reset()
        assert meet(threads) == [0, 1, 2]


@pytest.mark.parametrize("timeout", [0, -1, 1e-9, float("nan")])
def test_a_timeout_that_is_over_breaks_it(moved: Moved, timeout: float) -> None:
    with pytest.raises(BrokenBarrierError, match="did not come"):
        moved(barrier_of(2)).wait(timeout)


@pytest.mark.parametrize("timeout", [None, float("inf"), 1e300, sys.maxsize])
def test_a_timeout_without_an_end_is_none(moved: Moved, timeout: float | None) -> None:
    there = moved(barrier_of(2))
    with comers(there) as (other,):
        other.come()
        assert {there.wait(timeout), other.result()} == {0, 1}


def test_a_reset_breaks_the_waits_and_nothing_else(moved: Moved, far: Far) -> None:
    here = barrier_of(3)
    there = moved(here)
    with comers(there, there, far(here)) as threads:
        for reset in (here.reset, there.reset):
            for thread in threads[1:]:
                thread.come()
            reset()
            assert [thread.result() for thread in threads[1:]] == [BrokenBarrierError] * 2
            assert meet(threads) == [0, 1, 2]


def test_an_abort_breaks_the_waits_and_later_ones(moved: Moved, far: Far) -> None:
    here = barrier_of(3)
    there = moved(here)
    with comers(there, there, far(here)) as threads:
        for abort in (here.abort, there.abort):
            for thread in threads[1:]:
                thread.come()
            abort()
            assert [thread.result() for thread in threads[1:]] == [BrokenBarrierError] * 2
            assert meet(threads) == [BrokenBarrierError] * 3
            there.reset()
            assert meet(threads) == [0, 1, 2]


@pytest.mark.usefixtures("quick")
def test_a_process_that_dies_while_it_waits_breaks_it(far: Far) -> None:
    here = barrier_of(3)
    there, other = far(here), far(here)
    with comers(there, other) as (dying, waiting):
        dying.come()
        waiting.come()
        die(there)
        assert waiting.result() is BrokenBarrierError
        assert issubclass(dying.result(), EOFError)
        with pytest.raises(BrokenBarrierError):
            here.wait(PATIENCE)
        here.reset()
        with comers(here, here) as more:
            assert meet([waiting, *more]) == [0, 1, 2]


@pytest.mark.usefixtures("quick")
def test_a_process_that_dies_between_two_waits_breaks_it(far: Far) -> None:
    here = barrier_of(2)
    there = far(here)
    with comers(here, there) as threads:
        assert meet(threads) == [0, 1]
        die(there)
        with pytest.raises(BrokenBarrierError, match="a process that took part has died"):
            here.wait(PATIENCE)


@pytest.mark.usefixtures("quick")
def test_a_process_that_ends_in_good_order_is_not_missed(far: Far) -> None:
    here = barrier_of(2)
    with comers(here, far(here)) as threads:
        assert meet(threads) == [0, 1]
    del threads
    gc.collect()
    with comers(far(here)) as (other,):
        other.come()
        assert {here.wait(PATIENCE), other.result()} == {0, 1}


# Interrupts


@contextmanager
def ctrl_c_once(ready: Callable[[], bool]) -> Iterator[None]:
    """Expect Ctrl-C in the block, and press it in this thread once ``ready()``."""

    def press() -> None:
        wait_until(ready, PATIENCE)
        os.kill(os.getpid(), signal.SIGINT)

    pressing = threading.Thread(target=press)
    pressing.start()
    try:
        yield
        pytest.fail("the wait was not interrupted")
    except KeyboardInterrupt:
        pressing.join()


def test_ctrl_c_in_a_wait_leaves_the_barrier_as_it_was(moved: Moved, far: Far) -> None:
    here = barrier_of(3)
    there = moved(here)
    with comers(there, far(here)) as others:
        for waiting in range(3):
            for thread in others[:waiting]:
                thread.come()
            if waiting < 2:
                with ctrl_c_once(lambda: here.n_waiting == waiting + 1):  # noqa: B023
                    there.wait()
                assert (here.n_waiting, here.broken) == (waiting, False)
            for thread in others[waiting:]:
                thread.come()
            indices = {there.wait(PATIENCE), *(thread.result() for thread in others)}
            assert indices == {0, 1, 2}


def test_indices_differ_if_the_first_to_come_was_interrupted(moved: Moved, far: Far) -> None:
    """CPython's barrier gives the index 1 twice here."""
    here = barrier_of(3)
    there = moved(here)
    with comers(far(here), here) as others:

        def follow() -> None:
            wait_until(lambda: here.n_waiting == 1, PATIENCE)
            others[0].orders.put(PATIENCE)

        second = threading.Thread(target=follow)
        second.start()
        with ctrl_c_once(lambda: here.n_waiting == 2):
            there.wait()
        second.join()
        others[1].come()
        assert {there.wait(PATIENCE), *(thread.result() for thread in others)} == {0, 1, 2}


def strike_after(operation: Op, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let Ctrl-C come when the reply to a request has come and was not looked at."""
    ask = HubStream.ask

    def struck(stream: HubStream, asked: Op, *args: Any, **options: Any) -> Any:
        reply = ask(stream, asked, *args, **options)
        if asked is operation and threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt
        return reply

    monkeypatch.setattr(HubStream, "ask", struck)


@pytest.mark.parametrize("operation", [Op.MEET, Op.ACTED])
@pytest.mark.parametrize("action", [None, int])
def test_ctrl_c_as_a_wait_ends_leaves_no_one_counted(
    far: Far, monkeypatch: pytest.MonkeyPatch, operation: Op, action: Any
) -> None:
    here = barrier_of(2, action)
    there = far(here)
    with comers(here) as (other,):
        other.come()
        with monkeypatch.context() as patch:
            strike_after(operation, patch)
            if operation is Op.ACTED and action is None:
                there.wait()
            else:
                with pytest.raises(KeyboardInterrupt):
                    there.wait()
        # The action was to be called, so that the others cannot go on.
        breaks = operation is Op.MEET and action is not None
        assert (other.result() is BrokenBarrierError) == here.broken == breaks
        assert here.n_waiting == 0
        here.reset()
        other.come()
        assert {there.wait(PATIENCE), other.result()} == {0, 1}


def test_ctrl_c_before_the_lock_is_free_ends_the_wait(far: Far) -> None:
    here = barrier_of(2)
    there = far(here)
    held = threading.Event()

    def hold() -> None:
        with here._cond:
            held.set()
            assert interrupted.wait(PATIENCE)

    interrupted = threading.Event()
    holder = threading.Thread(target=hold)
    holder.start()
    assert held.wait(PATIENCE)
    asked = there._members._streams[0]
    with ctrl_c_once(lambda: asked._unsettled and asked._number > 0):
        there.wait()
    interrupted.set()
    holder.join()
    assert here.n_waiting == 0
    with comers(there) as (other,):
        other.come()
        assert {here.wait(PATIENCE), other.result()} == {0, 1}


def test_ctrl_c_while_the_lock_is_taken_no_longer_counts_the_thread(far: Far) -> None:
    here = barrier_of(2)
    there = far(here)
    taken, free = threading.Event(), threading.Event()

    def hold() -> None:
        wait_until(lambda: here.n_waiting == 1, PATIENCE)
        with here._cond:
            taken.set()
            free.wait(PATIENCE)

    def free_it() -> None:
        wait_until(lambda: withdrawn(there), PATIENCE)
        free.set()

    holder = threading.Thread(target=hold)
    freeing = threading.Thread(target=free_it)
    holder.start()
    freeing.start()
    with ctrl_c_once(taken.is_set):
        there.wait()
    holder.join()
    freeing.join()
    assert here.n_waiting == 0
    with comers(there) as (other,):
        other.come()
        assert {here.wait(PATIENCE), other.result()} == {0, 1}


def withdrawn(there: Any) -> bool:
    """Tell whether the process has begun to give up its request."""
    return bool(there._members._streams[0]._number > there._members._streams[0]._asked)


# Actions


def test_the_last_to_come_calls_the_action_before_any_goes(moved: Moved, far: Far) -> None:
    acted: list[Any] = []
    here = barrier_of(3)
    there = moved(here)
    other = far(here)
    for barrier in (here, there, other):
        barrier._action = lambda: acted.append((threading.get_ident(), here.n_waiting))
    with comers(here, other) as threads:
        for count in range(1, 4):
            for thread in threads:
                thread.come()
            assert {there.wait(PATIENCE), *(thread.result() for thread in threads)} == {0, 1, 2}
            assert acted == [(threading.get_ident(), 3)] * count


def test_an_action_that_fails_breaks_the_barrier(moved: Moved) -> None:
    def fail() -> None:
        raise ZeroDivisionError

    there = moved(barrier_of(2))
    there._action = fail
    with comers(there) as (other,):
        other.come()
        with pytest.raises(ZeroDivisionError):
            there.wait()
        assert other.result() is BrokenBarrierError
        assert there.broken
        there._action = None
        there.reset()
        other.come()
        assert {there.wait(PATIENCE), other.result()} == {0, 1}


def test_an_action_may_use_the_barrier(moved: Moved) -> None:
    there = moved(barrier_of(1))
    there._action = there.abort
    assert there.wait(PATIENCE) == 0
    assert not there.broken  # as in threading: the last one lets all go after its action


def test_ctrl_c_in_an_action_breaks_the_barrier(moved: Moved) -> None:
    there = moved(barrier_of(2))
    acting = threading.Event()

    def act() -> None:
        acting.set()
        while True:  # one long wait would miss a signal that came just before it
            time.sleep(0.1)

    there._action = act
    with comers(there) as (other,):
        other.come()
        with ctrl_c_once(acting.is_set):
            there.wait()
        assert other.result() is BrokenBarrierError
        there._action = None
        there.reset()
        other.come()
        assert {there.wait(PATIENCE), other.result()} == {0, 1}


@pytest.mark.filterwarnings("ignore:.* ended while it held a lock:RuntimeWarning")
def test_a_process_that_dies_in_the_action_breaks_the_barrier(far: Far) -> None:
    here = barrier_of(2)
    there = far(here)
    there._action = lambda: die(there)
    with comers(here, there) as (other, dying):
        other.come()
        dying.orders.put(PATIENCE)
        assert other.result() is BrokenBarrierError
        assert issubclass(dying.result(), EOFError)
        here.reset()
        with comers(here) as (more,):
            assert meet([other, more]) == [0, 1]


# The lock


class _Passing:
    """Waiter that returns its token as soon as it has it, as the steps of a party do."""

    def __init__(self, semaphore: HostedSemaphore, answered: list[Status]) -> None:
        self._semaphore = semaphore
        self._answered = answered

    def answer(self, status: Status, value: int = 0, buffers: Sequence[memoryview] = ()) -> None:
        self._answered.append(status)
        self._semaphore.lend(lambda: False)


def test_any_number_of_waiters_can_return_their_token_at_once(hosts: Hosts) -> None:
    semaphore: Any = shared_blocks.create_semaphore(COUNTING, 0, 1)
    hosted = HostedSemaphore(hosts.loop, hosts["a"].doorbell, semaphore.block)
    answered: list[Status] = []
    count = 2 * sys.getrecursionlimit()

    def serve() -> None:
        for _ in range(count):
            hosted.acquire(_Passing(hosted, answered), lambda _: None)
        hosted.release()
        hosted.close()

    hosts.on_loop(serve)
    assert wait_until(lambda: len(answered) == count, PATIENCE)
