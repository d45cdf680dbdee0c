"""Background thread that runs functions in turn, and that no caller has to wait for."""

from __future__ import annotations

import gc
import sys
import threading
import weakref
from collections.abc import Iterator
from typing import Any, NoReturn

import pytest

from fiber._runtime.threads import BackgroundThread
from patience import PATIENCE


@pytest.fixture
def thread() -> Iterator[BackgroundThread]:
    thread = BackgroundThread("test-background")
    yield thread
    thread.stop()
    thread.join()


def names() -> list[str]:
    return [thread.name for thread in threading.enumerate()]


def test_background_work_runs_in_order_on_one_daemon_thread(thread: BackgroundThread) -> None:
    seen: list[tuple[int, threading.Thread]] = []
    for n in range(100):
        assert thread.submit(lambda n: seen.append((n, threading.current_thread())), n)
    thread.stop()
    thread.join()
    assert [n for n, _ in seen] == list(range(100))
    (where,) = {where for _, where in seen}
    assert (where.name, where.daemon) == ("test-background", True)


def test_the_thread_starts_when_it_is_needed(thread: BackgroundThread) -> None:
    assert "test-background" not in names()
    thread.submit(abs, -1)
    assert "test-background" in names()


def test_a_thread_that_the_system_has_no_room_for_is_started_when_there_is(
    thread: BackgroundThread, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(thread: threading.Thread) -> NoReturn:
        raise RuntimeError("can't start new thread")

    seen: list[int] = []
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        for n in range(2):
            with pytest.raises(RuntimeError, match="can't start new thread"):
                thread.submit(seen.append, n)
    thread.submit(seen.append, 2)
    thread.stop()
    thread.join()
    assert seen == [2]


def test_an_unused_background_thread_ends_at_once() -> None:
    thread = BackgroundThread("test-background")
    thread.stop()
    thread.join()


def test_after_stop_submitted_work_is_done_and_new_work_refused() -> None:
    thread = BackgroundThread("test-background")
    gate = threading.Event()
    seen: list[int] = []
    thread.submit(gate.wait, PATIENCE)
    thread.submit(seen.append, 1)
    thread.stop()
    thread.stop()
    assert not thread.submit(seen.append, 2)
    gate.set()
    thread.join()
    assert seen == [1]


@pytest.mark.parametrize("needed", [True, False])
def test_the_callback_of_the_end_runs_last(needed: bool) -> None:
    thread = BackgroundThread("test-background")
    seen: list[int] = []
    if needed:
        thread.submit(seen.append, 1)
    thread.stop(then=lambda: seen.append(2))
    thread.join()
    assert seen == [1, 2] if needed else [2]


@pytest.mark.parametrize("kind", [ValueError, SystemExit, KeyboardInterrupt])
def test_an_exception_is_shown_and_does_not_stop_the_thread(
    thread: BackgroundThread, monkeypatch: pytest.MonkeyPatch, kind: type[BaseException]
) -> None:
    shown: list[Any] = []
    monkeypatch.setattr(sys, "excepthook", lambda *info: shown.append(info[0]))
    seen: list[int] = []

    def fail() -> NoReturn:
        raise kind

    thread.submit(fail)
    thread.submit(seen.append, 1)
    thread.stop()
    thread.join()
    assert (shown, seen) == ([kind], [1])


def test_background_work_may_stop_and_join_its_thread(thread: BackgroundThread) -> None:
    done = threading.Event()

    def end() -> None:
        thread.stop()
        thread.join()
        done.set()

    thread.submit(end)
    assert done.wait(PATIENCE)


def test_a_background_thread_keeps_no_reference_to_finished_work(thread: BackgroundThread) -> None:
    class Held:
        def use(self) -> None:
            pass

    done = threading.Event()
    gc.disable()
    try:
        held = Held()
        gone = weakref.ref(held, lambda _: done.set())
        thread.submit(held.use)
        del held
        assert done.wait(PATIENCE)
        assert gone() is None
    finally:
        gc.enable()
