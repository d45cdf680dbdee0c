"""AsyncManager: calls that return at once, with a handle for the result."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

import fiber
from census import wait_until
from fiber import queues
from fiber.managers import AsyncBaseProxy, AsyncManager, AsyncProxyResult, RemoteError
from patience import PATIENCE

ALL = 100
MEETING = threading.Barrier(ALL)
"""Barrier of all objects in the manager's process."""


class Desk:
    """Object whose calls wait for a signal to go on."""

    def __init__(self, start: int = 0) -> None:
        self.value = start
        self.calls: list[int] = []
        self._open = threading.Event()

    def add(self, number: int) -> int:
        self.calls.append(number)
        self.value += number
        return self.value

    def fail(self) -> None:
        raise KeyError("on purpose")

    def lock(self) -> Any:
        return threading.Lock()

    def wait(self) -> str:
        self._open.wait()
        return "waited"

    def meet(self) -> int:
        MEETING.wait()
        return self.value

    def open(self) -> None:
        self._open.set()

    def fill(self, size: int) -> bytes:
        return bytes(size)

    def twin(self) -> Desk:
        return Desk(self.value)

    def seen(self) -> list[int]:
        return self.calls


class DeskManager(AsyncManager):
    pass


DeskManager.register("Desk", Desk, method_to_typeid={"twin": "Twin"})
DeskManager.register("Twin", create_method=False)


@pytest.fixture
def manager() -> Iterator[Any]:
    with DeskManager() as manager:
        yield manager
    manager._process.close()  # pytest holds the manager


def test_each_result_is_that_of_its_call(manager: Any) -> None:
    desk = manager.Desk()
    results = [desk.add(1) for _ in range(200)]
    assert isinstance(results[0], AsyncProxyResult)
    assert results[150].get(PATIENCE) == 151
    assert [result.get() for result in reversed(results)] == list(range(200, 0, -1))
    assert results[0].get() == 1, "as often as one likes"


def test_each_thread_gets_the_results_of_its_calls(manager: Any) -> None:
    desk = manager.Desk()

    def ask(size: int) -> set[int]:
        results = [desk.fill(size) for _ in range(200)]
        return {len(result.get(PATIENCE)) for result in results}

    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(ask, range(1, 5))) == [{1}, {2}, {3}, {4}]


def test_a_call_that_is_interrupted_as_it_is_sent_shifts_no_other(
    manager: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = manager.Desk()
    assert desk.add(1).get(PATIENCE) == 1

    def interrupted(*_: Any) -> bool:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(type(desk._calls._channel), "try_send", interrupted)
        with pytest.raises(KeyboardInterrupt):
            desk.add(100)
    results = [desk.add(1) for _ in range(3)]
    assert [result.get(PATIENCE) for result in results] == [2, 3, 4]


def test_calls_of_one_proxy_wait_for_each_other_and_others_do_not(manager: Any) -> None:
    desk = manager.Desk()
    other = AsyncBaseProxy.__reduce__(desk)
    waiting, behind = desk.wait(), desk.add(1)
    with pytest.raises(fiber.TimeoutError, match=r"within 0\.01 s"):
        behind.get(0.01)
    assert not waiting.ready()
    with pytest.raises(ValueError, match="not ready"):
        waiting.successful()
    make, arguments = other
    make(*arguments).open().get(PATIENCE)
    assert (waiting.get(PATIENCE), behind.get(PATIENCE)) == ("waited", 1)


def test_a_hundred_objects_work_side_by_side(manager: Any) -> None:
    desks = [manager.Desk(number) for number in range(ALL)]
    for _ in range(2):
        results = [desk.meet() for desk in desks]  # none returns before all are called
        assert [result.get(PATIENCE) for result in results] == list(range(ALL))


def test_errors_are_raised_where_the_result_is_asked_for(manager: Any) -> None:
    desk = manager.Desk()
    failed, refused, went = desk.fail(), desk.lock(), desk.add(1)
    raised = []
    for _ in range(2):
        with pytest.raises(KeyError, match="on purpose") as caught:
            failed.get(PATIENCE)
        assert "in fail" in str(caught.value.__cause__)
        raised.append(caught.value)
    assert raised[0] is not raised[1]
    with pytest.raises(RemoteError, match="cannot pickle"):
        refused.get(PATIENCE)
    assert went.get(PATIENCE) == 1
    assert not failed.successful()
    assert went.successful()
    with pytest.raises(AttributeError, match="has no method 'subtract'"):
        desk.subtract(1)
    with pytest.raises(fiber.UnpicklableError, match=r"arguments of add\(\)"):
        desk.add(threading.Lock())
    assert desk.add(1).get(PATIENCE) == 2


def test_a_result_can_be_a_proxy(manager: Any) -> None:
    desk = manager.Desk(5)
    objects = manager._number_of_objects()
    twin = desk.twin().get(PATIENCE)
    assert isinstance(twin, AsyncBaseProxy)
    assert twin.add(1).get(PATIENCE) == 6
    assert desk.add(0).get(PATIENCE) == 5
    desk.twin()  # its result is unwanted
    assert desk.add(0).get(PATIENCE) == 5
    del twin
    assert wait_until(lambda: manager._number_of_objects() == objects, PATIENCE)


def test_unread_results_block_no_caller(manager: Any) -> None:
    desk = manager.Desk()
    for _ in range(300):
        desk.fill(10_000)
    assert desk.add(3).get(PATIENCE) == 3
    kept = [desk.fill(10_000) for _ in range(300)]
    assert len(kept[-1].get(PATIENCE)) == 10_000


def test_calls_made_before_the_proxy_went_are_carried_out(manager: Any) -> None:
    desk = manager.Desk()
    make, arguments = desk.__reduce__()
    other = make(*arguments)
    for number in range(50):
        desk.add(number)
    del desk
    assert wait_until(lambda: other.seen().get(PATIENCE) == list(range(50)), PATIENCE)


def test_threads_share_a_proxy(manager: Any) -> None:
    desk = manager.Desk()
    got: list[int] = []

    def work() -> None:
        got.extend(desk.add(1).get(PATIENCE) for _ in range(100))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    assert sorted(got) == list(range(1, 401))


def test_a_thread_is_woken_if_another_reads_its_result(manager: Any) -> None:
    desk = manager.Desk()
    make, arguments = desk.__reduce__()
    first, second = desk.wait(), desk.add(1)
    got: list[Any] = []
    threads = [
        threading.Thread(target=lambda result=result: got.append(result.get(PATIENCE)))
        for result in (second, first)
    ]
    for thread in threads:
        thread.start()
    make(*arguments).open()
    for thread in threads:
        thread.join(PATIENCE)
    assert sorted(map(str, got)) == ["1", "waited"]


def add_in_a_child(desk: Any, results: Any) -> None:
    results.put(desk.add(10).get(PATIENCE))


def test_proxies_go_to_other_processes(manager: Any) -> None:
    desk: Any = manager.Desk()
    results: queues.SimpleQueue[int] = fiber.SimpleQueue()
    child = fiber.Process(target=add_in_a_child, args=(desk, results))
    child.start()
    assert results.get() == 10
    child.join(PATIENCE)
    assert child.exitcode == 0
    assert desk.add(1).get(PATIENCE) == 11


def test_the_managers_death_is_every_results_error(manager: Any) -> None:
    desk = manager.Desk()
    waiting, behind = desk.wait(), desk.add(1)
    manager._process.kill()
    for result in (waiting, behind, desk.add(1)):
        with pytest.raises(fiber.ConnectionClosed, match="manager 'DeskManager-"):
            result.get(PATIENCE)


@pytest.mark.slow
def test_an_interruption_loses_no_other_result(
    manager: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = manager.Desk()
    first, second = desk.add(1), desk.add(1)
    channel = desk._calls._channel

    class Interrupted:
        def __getattr__(self, name: str) -> Any:
            return getattr(channel, name)

        def recv_object(self) -> None:
            channel.recv_object()
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(desk._calls, "_channel", Interrupted())
        with pytest.raises(KeyboardInterrupt):
            first.get(PATIENCE)
    assert second.get(PATIENCE) == 2
    with pytest.raises(InterruptedError):
        first.get(PATIENCE)


def test_an_async_manager_serves_no_other_programs() -> None:
    with pytest.raises(ValueError, match="use BaseManager"):
        DeskManager(("127.0.0.1", 0))  # type: ignore[arg-type]  # an address is refused
    with pytest.raises(ValueError, match="use BaseManager"):
        DeskManager(serializer="xmlrpclib")


def test_a_fork_has_a_separate_connection(manager: Any) -> None:
    desk = manager.Desk()
    assert desk.add(1).get(PATIENCE) == 1
    pid = os.fork()
    if not pid:
        try:
            os._exit(desk.add(1).get(PATIENCE))
        finally:
            os._exit(99)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 2
    assert desk.add(1).get(PATIENCE) == 3
