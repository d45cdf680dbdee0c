"""Managers on one host: what their proxies can do, how long objects live, who may come in."""

from __future__ import annotations

import gc
import multiprocessing.managers
import pickle
import re
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable
from multiprocessing import AuthenticationError
from pathlib import Path
from typing import Any

import pytest

import fiber
from census import wait_until
from fiber import queues
from fiber._managers.client import session
from fiber._runtime.state import runtime
from fiber.managers import AcquirerProxy, BaseManager, RemoteError, SyncManager
from fiber.process import current_process
from fiber.resources import Resources, resources_of
from patience import PATIENCE


def background(function: Any, *args: Any) -> threading.Thread:
    thread = threading.Thread(target=function, args=args, daemon=True)
    thread.start()
    return thread


def call(function: Any, *args: Any) -> None:
    """Call it in a process of its own."""
    process = fiber.Process(target=function, args=args)
    process.start()
    process.join(PATIENCE)
    assert process.exitcode == 0


def acquired_elsewhere(lock: Any) -> list[bool]:
    got: list[bool] = []

    def acquire_and_release() -> None:
        got.append(lock.acquire(False))
        if got[0]:
            lock.release()

    background(acquire_and_release).join(PATIENCE)
    return got


# What there is


def test_every_type_of_multiprocessing_is_there_with_its_proxy() -> None:
    theirs: Any = multiprocessing.managers.SyncManager
    for typeid, (_, exposed, typeids, proxytype) in theirs._registry.items():
        assert SyncManager._registry[typeid][1:] == (exposed, typeids, proxytype)
        assert hasattr(SyncManager, typeid) == hasattr(theirs, typeid)


def test_proxies_are_multiprocessings(manager: Any) -> None:
    assert type(manager.dict()) is multiprocessing.managers.DictProxy
    assert type(manager.list()) is multiprocessing.managers.ListProxy
    assert isinstance(manager.Lock(), multiprocessing.managers.BaseProxy)


def test_an_element_of_a_proxy_can_be_a_proxy(manager: Any) -> None:
    objects = manager._number_of_objects()
    outer = manager.list([manager.dict(a=1), manager.list()])
    outer[0]["b"] = 2
    outer[1].append(outer[0])
    assert outer[1][0]["b"] == 2
    assert [type(part).__name__ for part in outer] == ["DictProxy", "ListProxy"]
    assert manager._number_of_objects() == objects + 3
    del outer
    gc.collect()  # of multiprocessing's own frames
    assert wait_until(lambda: manager._number_of_objects() == objects, PATIENCE)


def put(queue: Any, item: Any) -> None:
    queue.put(item)


def double(shared: Any, key: str) -> int:
    shared[key] *= 2
    value: int = shared[key]
    return value


def test_proxies_go_where_anything_goes(manager: Any) -> None:
    shared, queue = manager.dict(a=1), manager.Queue()
    call(put, queue, shared)
    assert queue.get()["a"] == 1
    with fiber.Pool(1) as pool:
        assert pool.apply(double, (shared, "a")) == 2
        assert pool.map(len, [shared, manager.list("abc")]) == [1, 3]
    local: queues.SimpleQueue[Any] = fiber.SimpleQueue()
    local.put(shared)
    assert local.get()["a"] == 2


class Counter:
    def __init__(self, start: int = 0) -> None:
        self.value = start

    def step(self, by: int = 1) -> int:
        self.value += by
        return self.value

    def twin(self) -> Counter:
        return Counter(self.value)

    def fail(self) -> None:
        raise KeyError("on purpose")

    def lock(self) -> Any:
        return threading.Lock()

    def process(self) -> str:
        return current_process().name


def step(counter: Any) -> None:
    counter.step()


class CounterManager(BaseManager):
    Counter: Callable[..., Any]
    pass


CounterManager.register("Counter", Counter, method_to_typeid={"twin": "Twin"})
CounterManager.register("Twin", create_method=False)


def test_objects_of_ones_own() -> None:
    with CounterManager() as manager:
        counter = manager.Counter(40)
        assert counter.step(by=2) == 42
        twin = counter.twin()
        assert (twin.step(), counter.step(0)) == (43, 42)
        assert counter.process() == manager._process.name
        call(step, twin)
        assert twin.step(0) == 44


def test_an_error_comes_as_it_is_and_says_where_it_was(manager: Any) -> None:
    with pytest.raises(KeyError, match="b") as caught:
        manager.dict(a=1)["b"]
    assert "Traceback" in str(caught.value.__cause__)


def test_an_argument_that_cannot_be_pickled_is_only_an_error_of_the_call() -> None:
    with CounterManager() as manager:
        counter = manager.Counter()
        with pytest.raises(RemoteError, match=r"cannot pickle '_thread.lock' object"):
            counter.lock()
        with pytest.raises(fiber.UnpicklableError, match=r"arguments of step\(\)"):
            counter.step(threading.Lock())
        with pytest.raises(RemoteError, match="no_such_method"):
            counter._callmethod("no_such_method")
        assert counter.step() == 1


# How long objects live


def use_later(shared: Any, begun: Any, go_on: Any) -> None:
    begun.set()
    go_on.wait()
    shared["used"] = True
    go_on.clear()
    assert shared["used"]


def test_an_object_lives_as_long_as_any_process_has_a_proxy(manager: Any) -> None:
    objects = manager._number_of_objects()
    shared, begun, go_on = manager.dict(), fiber.Event(), fiber.Event()
    child = fiber.Process(target=use_later, args=(shared, begun, go_on))
    child.start()
    assert begun.wait(PATIENCE)
    del shared
    assert manager._number_of_objects() == objects + 1
    go_on.set()
    child.join(PATIENCE)
    assert child.exitcode == 0
    assert wait_until(lambda: manager._number_of_objects() == objects, PATIENCE)


def test_objects_in_a_result_live_until_the_caller_has_them(manager: Any) -> None:
    outer = manager.list([manager.dict(a=1)])
    for _ in range(50):
        part = outer.pop()
        assert part["a"] == 1
        outer.append(part)
        del part


# Locks


def test_an_rlock_is_its_threads(manager: Any) -> None:
    lock = manager.RLock()
    with lock, lock:
        got: list[bool] = []
        other = background(lambda: got.append(lock.acquire(False)))
        other.join(PATIENCE)
        assert got == [False]
    assert lock.acquire(False)
    lock.release()


def acquire(lock: Any) -> None:
    lock.acquire()


def test_another_process_may_release_a_lock(manager: Any) -> None:
    lock = manager.Lock()
    call(acquire, lock)
    lock.release()
    assert lock.acquire(False)
    assert not lock.acquire(False)


def test_a_condition_has_the_lock_of_a_proxy(manager: Any) -> None:
    lock = manager.RLock()
    condition = manager.Condition(lock)
    with condition:
        assert acquired_elsewhere(lock) == [False]
    assert acquired_elsewhere(lock) == [True]


@pytest.mark.parametrize("kind", ["Lock", "RLock", "BoundedSemaphore"])
def test_a_release_too_many_is_the_error_of_threading(manager: Any, kind: str) -> None:
    lock = getattr(manager, kind)()
    with pytest.raises(ValueError if kind == "BoundedSemaphore" else RuntimeError):
        lock.release()
    with lock:
        pass


def test_waiting_without_the_lock_is_the_error_of_threading(manager: Any) -> None:
    with pytest.raises(RuntimeError, match="must acquire"):
        manager.Condition().wait()


def test_minus_one_is_no_timeout(manager: Any) -> None:
    lock, asked = manager.Lock(), threading.Event()
    lock.acquire()
    got: list[bool] = []

    def wait() -> None:
        asked.set()
        got.append(lock.acquire(True, -1))

    waiter = background(wait)
    assert asked.wait(PATIENCE)
    lock.release()
    waiter.join(PATIENCE)
    assert got == [True]


def test_waiters_take_no_threads_of_the_manager(manager: Any) -> None:
    lock, tasks = manager.Lock(), Path(f"/proc/{manager._process.pid}/task")
    lock.acquire()
    before = len(list(tasks.iterdir()))
    waiters = [background(pass_through, lock) for _ in range(20)]
    lock.release()
    for waiter in waiters:
        waiter.join(PATIENCE)
    assert len(list(tasks.iterdir())) == before


def pass_through(lock: Any) -> None:
    with lock:
        pass


class LockManager(BaseManager):
    Lock: Callable[[], Any]
    Plain: Callable[[], Any]
    pass


LockManager.register("Lock", threading.Lock, AcquirerProxy)
LockManager.register("Plain", threading.Lock)


def test_a_registered_lock_of_threading_is_fibers() -> None:
    with LockManager() as manager:
        lock, plain = manager.Lock(), manager.Plain()
        call(acquire, lock)
        call(acquire, plain)
        with pytest.warns(RuntimeWarning, match="ended while it held"):
            assert lock.acquire()
        assert plain.locked()
    manager._process.close()


def test_the_locks_of_a_manager_with_an_address_are_those_of_threading() -> None:
    with SyncManager(("127.0.0.1", 0)) as manager:
        with manager.RLock() as acquired:
            assert acquired
        with pytest.raises(RuntimeError):
            manager.Lock().release()
        condition = manager.Condition()
        with condition:
            assert not condition.wait(0)
    manager._process.close()


def test_a_lock_goes_with_its_last_proxy(manager: Any) -> None:
    before = len(session(manager.address)._locks)
    lock = manager.Lock()
    same = pickle.loads(pickle.dumps(lock))
    del lock
    assert same.acquire(False)
    assert len(session(manager.address)._locks) == before + 1
    del same
    assert len(session(manager.address)._locks) == before


def acquire_and_die(lock: Any) -> None:
    import os

    lock.acquire()
    os._exit(3)


def test_a_warning_turned_into_an_error_releases_the_lock(manager: Any) -> None:
    lock = manager.Lock()
    child = fiber.Process(target=acquire_and_die, args=(lock,))
    child.start()
    child.join(PATIENCE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(RuntimeWarning, match=rf"{child.name} .*ended while it held a lock"):
            lock.acquire(True, PATIENCE)
    assert lock.acquire(False)


# From elsewhere


def test_connect_without_an_address_is_refused() -> None:
    with pytest.raises(ValueError, match="needs the address"):
        BaseManager().connect()


def test_a_process_connects_by_the_address(manager: Any) -> None:
    shared = manager.dict()
    call(connect_and_make, manager.address, shared)
    assert shared["made"] == [1, 2]


def connect_and_make(address: Any, shared: Any) -> None:
    manager = SyncManager(address)
    manager.connect()
    shared["made"] = list(manager.list([1, 2]))


def test_an_address_does_not_show_the_key(manager: Any) -> None:
    who = r"manager 'SyncManager-\d+' \(pid \d+ on host 'local'\)"
    assert re.fullmatch(f"<address of {who}>", repr(manager.address))


PROGRAM = """\
import sys
from MODULE.managers import BaseManager

class Counters(BaseManager):
    pass

Counters.register("Counter")
manager = Counters(("127.0.0.1", int(sys.argv[1])), authkey=sys.argv[2].encode())
manager.connect()
print(manager.Counter(7).step())
"""


@pytest.mark.slow
@pytest.mark.parametrize("module", ["fiber", "multiprocessing"])
def test_another_program_connects_by_address_and_key(module: str, tmp_path: Path) -> None:
    script = tmp_path / "program.py"
    script.write_text(PROGRAM.replace("MODULE", module))
    with CounterManager(("127.0.0.1", 0), authkey=b"open sesame") as manager:
        assert isinstance(manager.address, tuple)
        port = str(manager.address[1])
        command = [sys.executable, str(script), port]
        done = subprocess.run([*command, "open sesame"], capture_output=True)
        assert done.stdout == b"8\n"
        refused = subprocess.run([*command, "sesame open"], capture_output=True)
        assert AuthenticationError.__name__.encode() in refused.stderr
        assert refused.stdout == b""


def test_a_server_can_run_in_the_program_itself() -> None:
    server: Any = CounterManager().get_server()
    background(server.accepter)
    manager = CounterManager(server.address)
    manager.connect()
    assert manager.Counter(1).step() == 2
    server.listener.close()


# Its own lifetime


def fail() -> None:
    raise ValueError("on purpose")


def test_an_initializer_that_raises_is_an_error_of_start(capfd: pytest.CaptureFixture[str]) -> None:
    manager = SyncManager()
    with pytest.raises(EOFError, match=r"SyncManager-.*is gone"):
        manager.start(fail)
    assert "ValueError: on purpose" in capfd.readouterr().err
    with pytest.raises(TypeError, match="callable"):
        manager.start(3)  # type: ignore[arg-type]


def test_a_manager_cannot_be_started_twice_or_after_its_end() -> None:
    manager = SyncManager(shutdown_timeout=PATIENCE)
    manager.start()
    shared = manager.dict()
    with pytest.raises(fiber.ProcessError, match="Already started"):
        manager.start()
    manager.shutdown()
    manager.shutdown()
    assert manager._process.exitcode == 0
    with pytest.raises(fiber.ProcessError, match="has shut down"):
        manager.start()
    with pytest.raises(fiber.ConnectionClosed, match=r"manager 'SyncManager-.* is gone"):
        shared["a"] = 1


def test_a_manager_that_is_collected_on_the_loop_thread_ends_too() -> None:
    manager = SyncManager(shutdown_timeout=PATIENCE)
    manager.start()
    process = manager._process
    runtime().loop.call_soon(manager.shutdown)
    process.join(PATIENCE)
    assert process.exitcode == 0


def test_the_process_of_a_manager_has_the_resources_of_its_class_and_callables() -> None:
    @fiber.meta(memory=512)
    class Manager(BaseManager):
        Large: Callable[[int], Any]

    Manager.register("Small", fiber.meta(cpu=1)(make_counter))
    Manager.register("Large", fiber.meta(cpu=4, memory=100)(make_counter))
    assert Manager.__name__ == "Manager"
    assert resources_of(BaseManager) == Resources()
    assert Manager(pool="warm")._wishes() == Resources(cpu=4, memory=512, pool="warm")
    with Manager() as manager:
        assert manager.Large(1).step() == 2


def make_counter(start: int) -> Counter:
    return Counter(start)
