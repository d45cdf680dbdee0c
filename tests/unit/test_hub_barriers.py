"""Barriers of another host: the hub there carries out a whole wait.

Host ``a`` has the barrier; threads of this process wait on both hosts.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from queue import SimpleQueue
from typing import Any, cast

import pytest

import fiber
from census import wait_until
from fiber import synchronize
from fiber._hub import shared_blocks
from fiber._hub.hosted import HostedSemaphore
from fiber._hub.protocol import Status
from fiber._sync.semaphore import COUNTING
from hosts import Far, Hosts, Wire
from patience import PATIENCE


class Party(threading.Thread):
    """Thread that waits at a barrier each time that it is told to."""

    def __init__(self, barrier: Any) -> None:
        super().__init__()
        self.barrier = barrier
        self.orders: SimpleQueue[float | None] = SimpleQueue()
        self.results: SimpleQueue[int | type[BaseException]] = SimpleQueue()
        self.start()

    def run(self) -> None:
        while (timeout := self.orders.get()) is not None:
            try:
                self.results.put(self.barrier.wait(timeout))
            except threading.BrokenBarrierError as error:
                self.results.put(type(error))


@contextmanager
def parties(far: Far, barrier: Any, near: int, remote: int) -> Iterator[list[Party]]:
    """Yield parties at a barrier, those of its own host first."""
    other = far(barrier)
    threads = [Party(each) for each in [barrier] * near + [other] * remote]
    try:
        yield threads
    finally:
        for thread in threads:
            thread.orders.put(None)
            thread.join()


def meet(threads: list[Party], timeout: float = PATIENCE) -> list[Any]:
    """Let all wait; return what they got, sorted."""
    for thread in threads:
        thread.orders.put(timeout)
    return sorted((thread.results.get(timeout=PATIENCE) for thread in threads), key=str)


def test_each_gets_another_number_in_each_pass(far: Far) -> None:
    barrier = fiber.Barrier(5)
    with parties(far, barrier, 2, 3) as threads:
        for _ in range(30):
            assert meet(threads) == [0, 1, 2, 3, 4]
    assert (barrier.n_waiting, barrier.broken) == (0, False)


def test_a_pass_takes_one_request_of_each(
    far: Far, wires: tuple[Wire, Wire], monkeypatch: pytest.MonkeyPatch
) -> None:
    # One that waits for long, or comes before a thread of this host has left, takes more.
    monkeypatch.setattr(synchronize, "RECHECK", PATIENCE)
    up, _ = wires
    with parties(far, fiber.Barrier(3), 0, 3) as threads:
        for _ in range(3):  # until each has a stream, and the process a place
            meet(threads)
        before = up.frames
        for _ in range(10):
            meet(threads)
        assert up.frames - before == 30


def test_a_wait_goes_on_by_itself_if_the_others_are_late(
    far: Far, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(synchronize, "RECHECK", 0.01)
    barrier = fiber.Barrier(2)
    with parties(far, barrier, 1, 1) as (near, remote):
        assert meet([near, remote]) == [0, 1]
        steps = threading.Event()
        monkeypatch.setattr(
            synchronize.Condition, "wait", noting(steps, synchronize.Condition.wait)
        )
        remote.orders.put(PATIENCE)
        assert steps.wait(PATIENCE)
        near.orders.put(PATIENCE)
        assert {near.results.get(), remote.results.get()} == {0, 1}
        assert meet([near, remote]) == [0, 1]


def noting(event: threading.Event, function: Any) -> Any:
    def noted(*arguments: Any) -> Any:
        event.set()
        return function(*arguments)

    return noted


def test_threads_that_come_while_the_process_becomes_a_member_take_the_steps(
    far: Far, monkeypatch: pytest.MonkeyPatch
) -> None:
    barrier = fiber.Barrier(2)
    other: Any = far(barrier)
    enter, met = other._members.enter, []

    def look_meanwhile() -> Any:
        met.append(other._meet(time.monotonic() + PATIENCE))
        return enter()

    monkeypatch.setattr(other._members, "enter", look_meanwhile)
    with parties(cast("Far", lambda _: other), barrier, 1, 1) as threads:
        assert meet(threads) == [0, 1]
        assert met == [None]


def test_a_timeout_breaks_it_for_all_until_it_is_reset(far: Far) -> None:
    barrier = fiber.Barrier(3)
    with parties(far, barrier, 1, 2) as threads:
        assert meet(threads) == [0, 1, 2]
        *early, late = threads
        assert meet(early, timeout=0.01) == [threading.BrokenBarrierError] * 2
        assert meet([late]) == [threading.BrokenBarrierError]
        assert barrier.n_waiting == 0
        barrier.reset()
        assert meet(threads) == [0, 1, 2]


def test_a_reset_breaks_the_wait_of_another_host(far: Far) -> None:
    barrier = fiber.Barrier(2)
    with parties(far, barrier, 1, 1) as (near, remote):
        assert meet([near, remote]) == [0, 1]
        remote.orders.put(PATIENCE)
        assert wait_until(lambda: barrier.n_waiting == 1, PATIENCE)
        barrier.reset()
        assert remote.results.get(timeout=PATIENCE) is threading.BrokenBarrierError
        assert meet([near, remote]) == [0, 1]


def test_the_last_one_calls_the_action(far: Far) -> None:
    barrier = fiber.Barrier(2, action=_act)
    with parties(far, barrier, 1, 1) as (near, remote):
        assert meet([near, remote]) == [0, 1]
        near.orders.put(PATIENCE)
        assert wait_until(lambda: barrier.n_waiting == 1, PATIENCE)
        _acted.clear()
        remote.orders.put(PATIENCE)
        assert {near.results.get(), remote.results.get()} == {0, 1}
        assert _acted == [remote.ident]


_acted: list[int | None] = []


def _act() -> None:
    _acted.append(threading.get_ident())


def test_a_lost_host_breaks_it(hosts: Hosts, far: Far) -> None:
    barrier = fiber.Barrier(2)
    with parties(far, barrier, 1, 1) as (near, remote):
        assert meet([near, remote]) == [0, 1]
        remote.barrier._membership.close()  # as if its process had died
        near.orders.put(PATIENCE)
        assert near.results.get(timeout=PATIENCE) is threading.BrokenBarrierError


class _Passing:
    """Waiter that returns its token as soon as it has it, as the steps of a meeting do."""

    def __init__(self, semaphore: HostedSemaphore, answered: list[Status]) -> None:
        self._semaphore = semaphore
        self._answered = answered

    def answer(self, status: Status, value: int = 0, buffers: Sequence[memoryview] = ()) -> None:
        self._answered.append(status)
        self._semaphore.release()


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
