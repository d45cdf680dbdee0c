"""Interrupted calls of managers: what they wait for goes to others, and the proxy stays usable."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

import fiber
from fiber._managers.client import CallChannel
from fiber.managers import SyncManager
from patience import PATIENCE
from processes.test_managers import acquired_elsewhere, background


def test_an_item_whose_waiter_gave_up_goes_to_the_next(
    manager: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue = manager.Queue()
    with monkeypatch.context() as patch:
        patch.setattr(CallChannel, "answer", interrupt)
        with pytest.raises(KeyboardInterrupt):
            queue.get()
    queue.put("kept")
    assert queue.get(True, PATIENCE) == "kept"


def interrupt(_channel: CallChannel) -> None:
    raise KeyboardInterrupt


def test_an_item_of_an_interrupted_call_goes_to_the_next(
    manager: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt_late(channel: CallChannel) -> None:
        channel._channel.poll(PATIENCE)
        raise KeyboardInterrupt

    queue = manager.Queue()
    queue.put(1)
    queue.put(2)
    with monkeypatch.context() as patch:
        patch.setattr(CallChannel, "answer", interrupt_late)
        with pytest.raises(KeyboardInterrupt):
            queue.get()
    assert [queue.get(), queue.get()] == [1, 2]


def test_no_call_waits_behind_a_call_that_was_interrupted_twice(
    manager: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue, sizes = manager.Queue(), []

    def interrupt_twice() -> None:
        with monkeypatch.context() as patch:
            patch.setattr(CallChannel, "answer", interrupt)
            patch.setattr(CallChannel, "take_back", interrupt)
            with pytest.raises(KeyboardInterrupt):
                queue.get()
        sizes.append(queue.qsize())

    background(interrupt_twice).join(PATIENCE)
    assert sizes == [0]


def test_an_interruption_does_not_undo_an_earlier_call(
    manager: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue = manager.Queue()
    queue.put(1)
    assert queue.get() == 1
    with monkeypatch.context() as patch:
        patch.setattr(CallChannel, "answer", interrupt)
        with pytest.raises(KeyboardInterrupt):
            queue.qsize()
    assert queue.empty()


class Slow:
    def wait_for(self, event: Any) -> None:
        event.wait(PATIENCE)


class SlowManager(SyncManager):
    Slow: Callable[[], Any]
    pass


SlowManager.register("Slow", Slow)


class TooLong(Exception):
    pass


@contextmanager
def struck(error: type[BaseException]) -> Iterator[None]:
    """A signal's handler raises it, once this thread waits for an answer."""

    def strike(*_: object) -> None:
        raise error

    before = signal.signal(signal.SIGALRM, strike)
    signal.setitimer(signal.ITIMER_REAL, 0.2)
    try:
        with pytest.raises(error):
            yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("kind", ["RLock", "Condition"])
def test_a_lock_is_kept_after_another_call_was_interrupted(kind: str) -> None:
    with SlowManager() as manager:
        lock, slow, go_on = getattr(manager, kind)(), manager.Slow(), fiber.Event()
        with struck(KeyboardInterrupt), lock:
            try:
                slow.wait_for(go_on)
            finally:
                assert acquired_elsewhere(lock) == [False]
        assert acquired_elsewhere(lock) == [True]
        go_on.set()
    manager._process.close()


def test_an_interrupted_wait_acquires_the_condition_again(manager: Any) -> None:
    condition = manager.Condition()
    with condition:
        with struck(TooLong):
            condition.wait()
        assert acquired_elsewhere(condition) == [False]
    assert acquired_elsewhere(condition) == [True]


def test_any_exception_of_a_signals_handler_ends_a_call_alone(manager: Any) -> None:
    queue, other, lock = manager.Queue(), manager.dict(), manager.Lock()
    with struck(TooLong):
        queue.get()
    other["a"] = 1
    queue.put("kept")
    assert queue.get(True, PATIENCE) == "kept"
    lock.acquire()
    with struck(TooLong):
        lock.acquire()
    lock.release()
    assert lock.acquire(True, PATIENCE)
