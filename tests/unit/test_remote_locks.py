"""Locks and semaphores of another host."""

from __future__ import annotations

import gc
import pickle
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Any
from weakref import WeakValueDictionary

import pytest

import fiber
from census import wait_until
from fiber._hub import hosted, shared_blocks
from fiber._hub.client import HubStream, ObjectUnreachable
from fiber._hub.protocol import Op, Status
from fiber._hub.shared_blocks import RemoteSemaphore
from fiber.synchronize import Abandoned
from hosts import Far, Hosts, Wire, background, objects_kept
from patience import PATIENCE

MAKERS = {
    "Lock": fiber.Lock,
    "RLock": fiber.RLock,
    "Semaphore": fiber.Semaphore,
    "BoundedSemaphore": fiber.BoundedSemaphore,
}


@pytest.fixture
def hosts(all_caught: None) -> Iterator[Hosts]:
    """Locks are made on host a; this process is on host b."""
    hosts = Hosts()
    hosts.link("b", "a")
    with hosts.at("b"):
        yield hosts
    hosts.close()


@pytest.fixture
def far(hosts: Hosts) -> Far:
    return Far(hosts)


@pytest.fixture(params=list(MAKERS.values()), ids=list(MAKERS))
def here(request: pytest.FixtureRequest, hosts: Hosts) -> Any:
    with hosts.at("a"):
        return request.param()


def on_thread(action: Callable[[], Any]) -> Any:
    results: list[Any] = []
    background(lambda: results.append(action())).join(PATIENCE)
    return results[0]


def test_a_lock_of_two_hosts_has_one_holder_at_a_time(here: Any, far: Far) -> None:
    there = far(here)
    assert isinstance(there._semlock, RemoteSemaphore)
    with there as acquired:
        assert acquired is True
        assert not here.acquire(False)
        assert not on_thread(lambda: there.acquire(timeout=0.01))
        assert not on_thread(lambda: there.acquire(False))
    with here:
        assert not there.acquire(False)
        assert not there.acquire(timeout=-1)
    assert there.acquire(False)


def test_a_waiter_elsewhere_gets_the_lock(here: Any, far: Far) -> None:
    there = far(here)
    got: list[Any] = []

    def take() -> None:
        got.append(there.acquire())
        there.release()

    with here:
        waiters = [background(take) for _ in "ab"]
    for waiter in waiters:
        waiter.join(PATIENCE)
    assert got == [True, True]
    assert here.acquire(timeout=PATIENCE)


def test_a_release_rings_the_doorbell_for_a_waiter_elsewhere(
    here: Any, far: Far, hosts: Hosts, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hosted, "SLICE", 2 * PATIENCE)  # the hub does not look by itself
    there = far(here)
    assert here.acquire()
    waiter = background(lambda: (there.acquire(), there.release()))
    assert wait_until(lambda: bool(hosts["a"].doorbell._listeners), PATIENCE)
    with hosts.at("a"):
        here.release()
    waiter.join(PATIENCE)
    assert not waiter.is_alive()


def test_an_rlock_of_another_host_is_its_threads(far: Far) -> None:
    lock = fiber.RLock()
    there, again = far(lock), far(lock)
    assert there._semlock is again._semlock
    with there, again:
        assert repr(there) == "<RLock(MainProcess, 2)>"
        assert on_thread(lambda: repr(there)) == "<RLock(SomeOtherThread, nonzero)>"
        assert not on_thread(lambda: there.acquire(False))
        assert "SomeOther" in repr(lock)
    assert repr(there) == "<RLock(None, 0)>"
    with pytest.raises(AssertionError, match="not owned by thread"):
        there.release()


def test_a_semaphore_carries_signals_between_hosts(far: Far) -> None:
    here = fiber.Semaphore(0)
    there = far(here)
    there.release()
    assert here.acquire(timeout=PATIENCE)
    here.release()
    assert there.acquire(timeout=PATIENCE)
    assert there.get_value() == 0


def test_signals_that_are_consumed_elsewhere_keep_no_stream(far: Far) -> None:
    here = fiber.Semaphore(0)
    there = far(here)
    for _ in range(50):
        here.release()
        assert there.acquire(timeout=PATIENCE)
    assert len(there._semlock._streams) == 1


def test_a_remote_lock_can_be_pickled_again(here: Any, far: Far, hosts: Hosts) -> None:
    there = far(here)
    data, home = pickle.dumps(there), pickle.dumps(there)
    again = pickle.loads(data)
    with hosts.at("a"):
        assert pickle.loads(home)._semlock is here._semlock
    with again:
        assert not here.acquire(False)


def test_the_hub_drops_an_object_without_users(far: Far, hosts: Hosts) -> None:
    lock = fiber.Lock()
    there = far(lock)
    assert objects_kept(hosts["a"]) == 1
    del there
    gc.collect()
    assert wait_until(lambda: objects_kept(hosts["a"]) == 0, PATIENCE)


# What goes wrong


def die_holding(there: Any) -> None:
    """Close the lock's descriptor, as the kernel does when its process dies."""
    there._semlock._holding[0].close()


def acquired_after_death(there: Any, here: Any) -> Any:
    die_holding(there)
    return here.acquire(timeout=PATIENCE)


@pytest.mark.filterwarnings("ignore:MainProcess:RuntimeWarning")
def test_a_dead_holder_elsewhere_gives_it_back(here: Any, far: Far) -> None:
    there = far(here)
    assert there.acquire()
    die_holding(there)
    acquired = here.acquire(timeout=PATIENCE)
    assert isinstance(acquired, Abandoned)
    assert acquired.holder.startswith("MainProcess (pid ")
    assert acquired.holder.endswith(" on b)")
    here.release()
    assert here.acquire() is True


def test_the_warning_names_the_process_that_died_elsewhere(far: Far, hosts: Hosts) -> None:
    here = fiber.Lock()
    there = far(here)
    assert there.acquire()
    with pytest.warns(RuntimeWarning, match=r"MainProcess \(pid \d+ on b\) ended while it held"):
        assert acquired_after_death(there, here)


@pytest.mark.filterwarnings("ignore:MainProcess:RuntimeWarning")
def test_waiters_elsewhere_learn_of_a_death(
    here: Any, far: Far, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = far(here)
    monkeypatch.setattr(shared_blocks, "_semaphores", WeakValueDictionary())
    other = far(here)  # in another process
    assert one.acquire()
    die_holding(one)
    acquired = on_thread(lambda: other.acquire(timeout=PATIENCE))
    assert isinstance(acquired, Abandoned)
    assert "on b" in acquired.holder


def test_ctrl_c_within_acquire_leaves_it_to_others(
    here: Any, far: Far, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = far(here)
    ask = HubStream.ask

    def strike(stream: HubStream, *args: Any, **options: Any) -> Any:
        monkeypatch.undo()
        assert ask(stream, *args, **options).status is Status.OK
        raise KeyboardInterrupt

    monkeypatch.setattr(HubStream, "ask", strike)
    with pytest.raises(KeyboardInterrupt):
        there.acquire()
    assert here.acquire(timeout=PATIENCE) is True
    here.release()
    assert there.acquire(timeout=PATIENCE)


def test_a_link_that_ends_is_an_error_and_gives_it_back(here: Any, far: Far, hosts: Hosts) -> None:
    there = far(here)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        assert there.acquire()
        hosts.on_loop(hosts["a"].unlink, "b", "it was cut")
        hosts.on_loop(hosts["b"].unlink, "a", "it was cut")
        assert here.acquire(timeout=PATIENCE)
    with pytest.raises(ObjectUnreachable, match="it was cut"):
        there.release()


def test_a_remote_lock_waits_while_its_link_is_cut(here: Any) -> None:
    hosts = Hosts()
    wires: tuple[Wire, Wire] = hosts.link("b", "a")
    try:
        with hosts.at("b"):
            there = Far(hosts)(here)
            assert there.acquire()
            there.release()
            for wire in wires:
                hosts.on_loop(wire.hold)
            acquired = threading.Event()

            def acquire() -> None:
                there.acquire()
                acquired.set()

            waiting = background(acquire)
            assert not acquired.wait(0.05)
            for wire in wires:
                hosts.on_loop(wire.let_go)
            assert acquired.wait(PATIENCE)
            waiting.join(PATIENCE)
            assert not here.acquire(False)
    finally:
        hosts.close()


@pytest.mark.parametrize("operation", [Op.ACQUIRE, Op.RETURN_TOKEN, Op.TOKENS])
def test_a_stream_for_something_else_is_refused(operation: Op, far: Far) -> None:
    reader, writer = fiber.Pipe(duplex=False)
    there = far(reader)
    with (
        there._channel.stream() as stream,
        pytest.raises(ObjectUnreachable, match="not attached to a lock"),
    ):
        stream.ask(operation, buffers=[memoryview(b"me")])
    for end in (there, reader, writer):
        end.close()
