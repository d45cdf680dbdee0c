"""Managers whose process, clients or proxies' owners are killed: an error or going on, no hang."""

from __future__ import annotations

import os
import signal
import threading
import warnings
from collections.abc import Iterator
from threading import BrokenBarrierError
from typing import Any

import pytest

import fiber
from faults import targets
from faults.program import wait_for
from faults.raising import AsyncModelManager, ModelManager, make_model
from fiber.errors import ConnectionClosed
from fiber.managers import RemoteError
from fiber.pool import MaybeEncodingError
from fiber.synchronize import Abandoned
from patience import PATIENCE

pytestmark = pytest.mark.usefixtures("backend")


@pytest.fixture
def manager() -> Iterator[Any]:
    with fiber.Manager() as manager:
        yield manager
    manager._process.close()  # pytest holds the manager


@pytest.fixture
def victim(manager: Any) -> Iterator[Any]:
    """Yield a process that obeys commands, to be killed."""
    orders = manager.Queue()
    process = fiber.Process(target=targets.obey, args=(orders,))
    process.start()
    yield lambda method, *args: tell(orders, process, method, *args)
    process.kill()
    process.join(PATIENCE)
    process.close()


def tell(orders: Any, process: Any, method: str, *args: Any) -> Any:
    """Have the process do something, or have it killed."""
    if method == "die":
        process.kill()
        process.join(PATIENCE)
        return process.name
    orders.put((method, args))
    return None


# Calls that raise an exception which ends a thread


ENDS = (SystemExit, KeyboardInterrupt, GeneratorExit)


@pytest.mark.parametrize("kind", ENDS)
def test_an_exception_that_would_end_a_thread_is_its_callers_error(
    kind: type[BaseException],
) -> None:
    with ModelManager() as manager:
        model = manager.Model()  # type: ignore[attr-defined]
        with pytest.raises(kind, match="no display") as caught:
            model.end_by(kind)
        assert "in end_by" in str(caught.value.__cause__)
        with pytest.raises(RemoteError, match="while it is pickled"):
            model.unpicklable(kind)
        with pytest.raises(RemoteError, match="in the making"):
            manager.Model(kind)  # type: ignore[attr-defined]
        assert model.double(2) == 4


@pytest.mark.parametrize("kind", ENDS)
def test_calls_behind_it_are_made(kind: type[BaseException]) -> None:
    with AsyncModelManager() as manager:
        model = manager.Model()  # type: ignore[attr-defined]
        before, ended, after = model.double(1), model.end_by(kind), model.double(2)
        assert (before.get(PATIENCE), after.get(PATIENCE)) == (2, 4)
        with pytest.raises(kind, match="no display"):
            ended.get(PATIENCE)


def test_a_proxy_that_a_task_alone_had_says_why_it_is_gone() -> None:
    with ModelManager() as manager, fiber.Pool(1) as pool:
        result = pool.apply_async(make_model, (manager.address,))
        result.wait(PATIENCE)
        wait_for(lambda: manager._number_of_objects() == 0)  # type: ignore[attr-defined]
        with pytest.raises(MaybeEncodingError, match="gone: it went with its last proxy"):
            result.get(PATIENCE)


# The manager's process


def test_the_death_of_a_manager_is_an_error_that_names_it_and_the_reason(manager: Any) -> None:
    shared, name = manager.dict(a=1), manager._process.name
    manager._process.kill()
    manager._process.join(PATIENCE)
    with pytest.raises(ConnectionClosed, match=rf"manager '{name}'.*gone \(.*SIGKILL"):
        shared["a"]
    with pytest.raises(ConnectionClosed, match=rf"manager '{name}'.*gone \(.*SIGKILL"):
        manager.list()
    with pytest.raises(ConnectionClosed, match=name):
        len(shared)


def test_a_caller_that_waits_gets_the_error(manager: Any) -> None:
    queue, errors = manager.Queue(), []

    def wait() -> None:
        try:
            queue.get()
        except ConnectionClosed as error:
            errors.append(error)

    waiters = [threading.Thread(target=wait) for _ in range(3)]
    for waiter in waiters:
        waiter.start()
    wait_for(lambda: manager._debug_info().count("refcount") == 1)
    manager._process.kill()
    for waiter in waiters:
        waiter.join(PATIENCE)
    assert len(errors) == 3


def test_a_process_that_did_not_start_it_gets_the_error_too(manager: Any) -> None:
    ours, theirs = fiber.Pipe()
    child = fiber.Process(target=targets.touch_until_it_fails, args=(manager.list(), theirs))
    child.start()
    theirs.close()
    assert ours.recv() == "touched"
    manager._process.kill()
    told = ours.recv()
    assert told.startswith("ConnectionClosed")
    assert repr(manager._process.name) in told
    child.join(PATIENCE)
    assert child.exitcode == 0
    child.close()
    ours.close()


def test_a_lock_can_still_be_released(manager: Any) -> None:
    lock, other = manager.Lock(), manager.Lock()
    lock.acquire()
    manager._process.kill()
    manager._process.join(PATIENCE)
    lock.release()
    with pytest.raises(ConnectionClosed, match=manager._process.name):
        other.acquire()


# A client


def test_an_object_with_only_dead_users_is_released(manager: Any, victim: Any) -> None:
    made = manager.Queue()
    objects = manager._number_of_objects()
    victim("make", manager.address, made)
    # Not list(): the IndexError that ends it is a cycle with the proxy on some Pythons.
    assert made.get(True, PATIENCE)[:] == ["made"]
    assert manager._number_of_objects() == objects + 1
    victim("die")
    wait_for(lambda: manager._number_of_objects() == objects)


@pytest.mark.parametrize("kind", ["Lock", "RLock", "Semaphore", "BoundedSemaphore", "Condition"])
def test_a_lock_of_a_dead_process_is_released(manager: Any, victim: Any, kind: str) -> None:
    lock, done = getattr(manager, kind)(), manager.Event()
    victim("acquire", lock, done)
    assert done.wait(PATIENCE)
    assert not lock.acquire(False)
    name = victim("die")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on another host the hub warns
        acquired = lock.acquire(True, PATIENCE)
    assert isinstance(acquired, Abandoned)
    assert acquired.holder.startswith(name)
    lock.release()
    assert lock.acquire(True, PATIENCE) is True, "it is said once"


@pytest.mark.filterwarnings("ignore:.*ended while it held:RuntimeWarning")
def test_another_process_releases_the_lock_of_a_process_that_ended_or_waits_for_it(
    manager: Any,
) -> None:
    released, waited_for = manager.Lock(), manager.Lock()
    holder = fiber.Process(target=targets.acquire_each, args=(released, waited_for))
    holder.start()
    holder.join(PATIENCE)
    assert holder.exitcode == 0
    holder.close()
    released.release()
    assert released.acquire(False)
    assert waited_for.acquire(timeout=PATIENCE)


@pytest.mark.parametrize("kind", ["Lock", "RLock"])
def test_a_dead_waiter_gets_no_lock(manager: Any, victim: Any, kind: str) -> None:
    lock, begun = getattr(manager, kind)(), manager.Event()
    lock.acquire()
    victim("queue_up", lock, begun)
    assert begun.wait(PATIENCE)
    victim("die")
    lock.release()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the process may have had the lock for a moment
        assert lock.acquire(True, PATIENCE)


def test_a_dead_waiter_takes_no_item(manager: Any, victim: Any) -> None:
    queue, done = manager.Queue(), manager.Event()
    victim("get", queue, done)
    assert done.wait(PATIENCE)
    victim("die")
    queue.put("kept")
    assert queue.get(True, PATIENCE) == "kept"


def test_a_barrier_whose_member_died_is_broken(manager: Any, victim: Any) -> None:
    barrier = manager.Barrier(2)
    victim("wait", barrier)
    wait_for(lambda: barrier.n_waiting == 1)
    victim("die")
    wait_for(lambda: barrier.broken)
    with pytest.raises(BrokenBarrierError):
        barrier.wait(PATIENCE)


def test_a_notification_is_not_a_dead_waiters(manager: Any, victim: Any) -> None:
    condition, begun = manager.Condition(), manager.Event()
    victim("wait_notified", condition, begun)
    assert begun.wait(PATIENCE)
    told: list[bool] = []

    def wait() -> None:
        with condition:
            begun.clear()
            told.append(condition.wait(PATIENCE))

    waiter = threading.Thread(target=wait)
    waiter.start()
    wait_for(lambda: not begun.is_set())
    victim("die")
    with condition:  # both wait now
        condition.notify()
    waiter.join(PATIENCE)
    assert told == [True]


def test_a_proxy_outlives_the_process_that_made_its_object(manager: Any, victim: Any) -> None:
    proxies = manager.Queue()
    victim("make", manager.address, proxies)
    made = proxies.get(True, PATIENCE)
    victim("die")
    made.append("more")
    assert list(made) == ["made", "more"]


def test_a_stopped_manager_does_not_delay_the_release_of_proxies(manager: Any) -> None:
    proxies = [manager.list() for _ in range(3)]
    os.kill(manager._process.pid, signal.SIGSTOP)
    try:
        proxies.clear()
    finally:
        os.kill(manager._process.pid, signal.SIGCONT)
    wait_for(lambda: manager._number_of_objects() == 0)
