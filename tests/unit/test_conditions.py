"""Conditions and barriers, on one host and between hosts."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import fiber
from census import wait_until
from fiber import synchronize
from fiber._hub import hosted, shared_blocks
from fiber._hub.client import HubStream
from fiber._hub.local import LocalCounter
from fiber._hub.protocol import Op
from fiber._sync.wait_list import WaitList
from hosts import Far, Hosts, background
from patience import PATIENCE

# From Python 3.12 on os.fork() warns of any thread, and the runtime's loop may be one.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")


@pytest.fixture
def hosts(all_caught: None) -> Iterator[Hosts]:
    hosts = Hosts()
    hosts.link("b", "a")
    with hosts.at("b"):
        yield hosts
    hosts.close()


@pytest.fixture(params=["one host", "two hosts"])
def brought(request: pytest.FixtureRequest, hosts: Hosts) -> Callable[[Any], Any]:
    """Brings a thing where another process could be."""
    return Far(hosts) if request.param == "two hosts" else lambda thing: thing


def on_thread(action: Callable[[], Any]) -> Any:
    results: list[Any] = []
    background(lambda: results.append(action())).join(PATIENCE)
    return results[0]


def test_a_thousand_threads_can_wait() -> None:
    waiters = shared_blocks.create_wait_list()
    places = [waiters.enter() for _ in range(1000)]
    waiters.notify(999)
    assert [waiters.leave(place) for place in places] == [True] * 999 + [False]


def waiter(condition: Any, woken: list[Any], name: str) -> threading.Thread:
    """A thread that waits, once it does."""
    before = condition._waiters.waiters()

    def wait() -> None:
        with condition:
            if condition.wait(PATIENCE):
                woken.append(name)

    thread = background(wait)
    wait_until(lambda: condition._waiters.waiters() == before + 1, PATIENCE)
    return thread


def fork_that(action: Callable[[], object]) -> int:
    """The pid of a process that does it."""
    pid = os.fork()
    if not pid:
        try:
            action()
        finally:
            os._exit(0)
    return pid


def kill(pid: int) -> None:
    os.kill(pid, 9)
    os.waitpid(pid, 0)


def test_the_things_of_dead_processes_go_to_the_counter() -> None:
    waiters, counter = shared_blocks.create_wait_list(), LocalCounter.create()
    os.waitpid(fork_that(lambda: waiters.hold(waiters.enter(), 3)), 0)
    waiters.hold(waiters.enter(), 2)
    assert waiters.held() == 5
    assert [waiters.reclaim(counter), counter.value(), waiters.held()] == [3, 3, 2]
    assert [waiters.reclaim(counter), counter.value()] == [0, 3]


# Conditions


@pytest.mark.slow
def test_the_first_to_come_is_the_first_to_be_notified(brought: Callable[[Any], Any]) -> None:
    here = fiber.Condition()
    woken: list[str] = []
    there = brought(here)
    threads = [waiter(condition, woken, name) for condition, name in ((there, "1"), (here, "2"))]
    for count in (1, 2):
        with here:
            here.notify()
        wait_until(lambda: len(woken) == count, PATIENCE)  # noqa: B023 - it is called at once
    assert woken == ["1", "2"]
    for thread in threads:
        thread.join(PATIENCE)


def test_notify_all_wakes_the_waiters_of_both_copies(brought: Callable[[Any], Any]) -> None:
    here = fiber.Condition(fiber.Lock())
    woken: list[str] = []
    there = brought(here)
    threads = [waiter(condition, woken, "") for condition in (here, there, here, there)]
    # A waiter counts as waiting before it releases the lock, or it could miss a notification.
    assert wait_until(lambda: repr(here) == "<Condition(<Lock(owner=None)>, 4)>", PATIENCE)
    with there:
        there.notify(1)
        there.notify_all()
    for thread in threads:
        thread.join(PATIENCE)
    assert len(woken) == 4
    assert not here._waiters.waiters()


def test_a_waiter_releases_the_lock_and_gets_it_back(brought: Callable[[Any], Any]) -> None:
    here = fiber.Condition()
    there = brought(here)
    with there, there:
        assert there.wait(0.01) is False
        assert not on_thread(lambda: here.acquire(False))
    assert here.acquire(timeout=PATIENCE)


def test_waiting_again_and_again_takes_no_more_streams(hosts: Hosts) -> None:
    there = Far(hosts)(fiber.Condition())
    with there:
        for _ in range(10):
            there.wait(0)
    assert len(there._waiters._streams) == 1


def test_ctrl_c_as_a_wait_begins_leaves_no_waiter(
    hosts: Hosts, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = fiber.Condition()
    there = Far(hosts)(here)
    ask = HubStream.ask

    def strike(stream: HubStream, operation: Op, *args: Any, **options: Any) -> Any:
        reply = ask(stream, operation, *args, **options)
        if operation is Op.ENTER:
            raise KeyboardInterrupt
        return reply

    monkeypatch.setattr(HubStream, "ask", strike)
    with there, pytest.raises(KeyboardInterrupt):
        there.wait()
    monkeypatch.undo()
    assert there._waiters.waiters() == 0
    with there:
        assert not there.wait(0)


def test_wait_for_returns_the_predicates_value(brought: Callable[[Any], Any]) -> None:
    there = brought(fiber.Condition())
    with there:
        assert there.wait_for(lambda: 0, timeout=0.01) == 0
        assert there.wait_for(lambda: "yes") == "yes"


def test_wait_and_notify_without_the_lock_are_refused(brought: Callable[[Any], Any]) -> None:
    there = brought(fiber.Condition())
    for call in (there.wait, there.notify, there.notify_all):
        with pytest.raises(AssertionError, match="must acquire"):
            call()


def test_a_waiter_that_was_killed_is_skipped() -> None:
    condition = fiber.Condition()
    woken: list[str] = []
    pid = fork_that(lambda: condition.acquire() and condition.wait())
    wait_until(lambda: condition._waiters.waiters() == 1, PATIENCE)
    with condition:  # it has let go of it
        pass
    kill(pid)
    thread = waiter(condition, woken, "living")
    with condition:
        condition.notify()
    thread.join(PATIENCE)
    assert woken == ["living"]


def test_a_waiter_that_died_elsewhere_is_skipped(hosts: Hosts) -> None:
    condition = fiber.Condition()
    woken: list[str] = []
    there = Far(hosts)(condition)
    place = there._waiters.enter()
    assert condition._waiters.waiters() == 1
    place.close()
    wait_until(lambda: condition._waiters.waiters() == 0, PATIENCE)
    thread = waiter(condition, woken, "living")
    with condition:
        condition.notify()
    thread.join(PATIENCE)
    assert woken == ["living"]


def test_a_remote_notify_wakes_without_the_doorbell(
    hosts: Hosts, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hosted, "_LOOK", 0.01)
    condition = fiber.Condition()
    woken: list[str] = []
    thread = waiter(Far(hosts)(condition), woken, "far")
    # The notifier dies just before it rings.
    monkeypatch.setattr(condition._waiters, "_ring", lambda: None)
    with condition:
        condition.notify()
    thread.join(PATIENCE)
    assert woken == ["far"]


def test_a_notify_rings_the_doorbell_only_for_a_waiter_elsewhere(
    hosts: Hosts, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hosted, "_LOOK", 2 * PATIENCE)  # the hub does not look by itself
    condition = fiber.Condition()
    woken: list[str] = []
    rings: list[list[str]] = []

    def ring() -> None:
        rings.append(list(woken))
        hosts["a"].doorbell.ring()

    assert isinstance(condition._waiters, WaitList)
    condition._waiters._ring = ring
    for name, there in (("near", condition), ("far", Far(hosts)(condition))):
        thread = waiter(there, woken, name)
        with condition:
            condition.notify()
        thread.join(PATIENCE)
    assert woken == ["near", "far"]
    assert rings == [["near"]]


def test_ctrl_c_in_a_wait_leaves_no_waiter(
    brought: Callable[[Any], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def strike(*_: Any) -> None:
        raise KeyboardInterrupt

    there = brought(fiber.Condition())
    monkeypatch.setattr(type(there._waiters), "sleep", strike)
    with there, pytest.raises(KeyboardInterrupt):
        there.wait()
    assert not there._waiters.waiters()


# Barriers


def test_a_barrier_lets_all_go_at_once(brought: Callable[[Any], Any]) -> None:
    acted: list[Any] = []
    there = brought(fiber.Barrier(3))
    there._action = lambda: acted.append(there.n_waiting)
    numbers: list[int] = []
    threads = [background(lambda: numbers.append(there.wait(PATIENCE))) for _ in range(3)]
    for thread in threads:
        thread.join(PATIENCE)
    assert sorted(numbers) == [0, 1, 2]
    assert acted == [3]


@pytest.mark.slow
def test_a_barrier_is_used_again_from_several_hosts(hosts: Hosts) -> None:
    here = fiber.Barrier(2)
    there = Far(hosts)(here)
    thread = background(lambda: [there.wait(PATIENCE) for _ in range(20)])
    for _ in range(20):
        assert here.wait(PATIENCE) in (0, 1)
    thread.join(PATIENCE)
    assert not here.broken
    assert here.parties == there.parties == 2


def test_a_timeout_breaks_it_until_it_is_reset(brought: Callable[[Any], Any]) -> None:
    there = brought(fiber.Barrier(2))
    with pytest.raises(threading.BrokenBarrierError, match="did not come"):
        there.wait(0.01)
    assert there.broken
    with pytest.raises(threading.BrokenBarrierError):
        there.wait()
    there.reset()
    assert not there.broken
    assert there.n_waiting == 0


def test_a_waiter_killed_before_it_was_counted_takes_no_place() -> None:
    barrier = fiber.Barrier(2)

    def wait_to_come_in() -> None:
        with barrier._cond:
            barrier._cond.wait()

    first = background(barrier.wait, PATIENCE)
    wait_until(lambda: barrier.n_waiting == 1, PATIENCE)
    pid = fork_that(wait_to_come_in)
    wait_until(lambda: barrier._cond._waiters.waiters() == 2, PATIENCE)
    with barrier._cond:  # it has let go of it
        pass
    kill(pid)
    with barrier._cond:
        assert barrier._bury()
    assert barrier.n_waiting == 1
    barrier.wait(PATIENCE)
    first.join(PATIENCE)
    assert barrier.n_waiting == 0


def test_a_barrier_without_parties_is_refused() -> None:
    with pytest.raises(ValueError, match="0"):
        fiber.Barrier(0)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(synchronize, "RECHECK", 0.05)


@pytest.mark.usefixtures("quick")
def test_a_member_killed_while_it_waits_breaks_the_barrier() -> None:
    barrier = fiber.Barrier(3)
    pid = fork_that(barrier.wait)
    wait_until(lambda: barrier.n_waiting == 1, PATIENCE)
    with barrier._cond:  # it has let go of it
        pass
    kill(pid)
    with pytest.raises(threading.BrokenBarrierError, match="a process that took part has died"):
        barrier.wait(PATIENCE)
    assert barrier.n_waiting == 0


@pytest.mark.usefixtures("quick")
def test_a_member_killed_between_two_waits_breaks_the_barrier() -> None:
    barrier = fiber.Barrier(2)

    def wait_and_stop() -> None:
        barrier.wait(PATIENCE)
        os.kill(os.getpid(), signal.SIGSTOP)

    pid = fork_that(wait_and_stop)
    barrier.wait(PATIENCE)
    os.waitpid(pid, os.WUNTRACED)  # it has stopped, and waits no more
    kill(pid)
    with pytest.raises(threading.BrokenBarrierError, match="a process that took part has died"):
        barrier.wait(PATIENCE)


@pytest.mark.usefixtures("quick")
def test_a_member_that_dies_elsewhere_breaks_the_barrier(hosts: Hosts) -> None:
    barrier = fiber.Barrier(2)
    there = Far(hosts)(barrier)
    there._members.enter().close()
    with pytest.raises(threading.BrokenBarrierError, match="a process that took part has died"):
        barrier.wait(PATIENCE)


@pytest.mark.usefixtures("quick")
@pytest.mark.filterwarnings("ignore:.* ended while it held a lock:RuntimeWarning")
def test_after_a_reset_one_killed_with_the_lock_is_not_counted() -> None:
    reader, writer = os.pipe()
    parent = os.getpid()

    def act() -> None:
        if os.getpid() != parent:
            os.write(writer, b"!")
            signal.pause()

    barrier = fiber.Barrier(2, act)
    outcomes: list[Any] = []

    def wait() -> None:
        try:
            outcomes.append(barrier.wait(PATIENCE))
        except threading.BrokenBarrierError:
            outcomes.append("broken")

    first = background(wait)
    wait_until(lambda: barrier.n_waiting == 1, PATIENCE)
    pid = fork_that(barrier.wait)
    assert os.read(reader, 1) == b"!"
    kill(pid)
    first.join(PATIENCE)
    assert outcomes == ["broken"]
    barrier.reset()
    assert barrier.n_waiting == 0
    threads = [background(wait) for _ in range(2)]
    for thread in threads:
        thread.join(PATIENCE)
    assert sorted(outcomes[1:]) == [0, 1]
    os.close(reader)
    os.close(writer)
