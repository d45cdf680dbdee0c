"""Queues: multiprocessing's semantics, and what multiprocessing's own queues do not survive."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import nullcontext
from multiprocessing.connection import wait
from queue import Empty, Full
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import fiber
from census import wait_until
from fiber import queues
from fiber._hub import local, one_way, queue_delivery
from fiber._hub.queue_delivery import Feeder, ItemCount
from fiber._sync.semaphore import Abandoned
from fiber._wire import packet
from patience import PATIENCE
from processes.test_loopback import running
from unit.interrupting import INSTRUCTIONS, is_interrupted

MORE_THAN_FITS = 10_000
"""Items that neither a socket nor its backlog holds."""


def start(target: Callable[..., Any], *args: Any) -> fiber.Process:
    process = fiber.Process(target=target, args=args, daemon=True)
    process.start()
    return process


class Unpicklable:
    def __reduce__(self) -> Any:
        raise AttributeError("it has no parts")


# In one process


def test_size_is_right_as_soon_as_put_returns() -> None:
    queue: queues.Queue[Any] = fiber.Queue()
    assert queue.qsize() == 0
    assert queue.empty()
    queue.put(1)
    assert queue.qsize() == 1
    assert not queue.empty()
    queue.get()
    assert queue.qsize() == 0
    assert queue.empty()


def test_a_place_that_is_given_back_twice_is_removed() -> None:
    """Interrupt a put after its item has left."""
    queue: queues.Queue[int] = fiber.Queue(2)
    queue.put(1)
    queue._slots.give_back()
    assert queue.get() == 1
    queue.put(1)
    queue.put(2)
    with pytest.raises(Full):
        queue.put_nowait(3)
    assert [queue.get(), queue.get()] == [1, 2]


def test_an_interrupted_get_frees_the_place_of_its_item() -> None:
    queue: Any = fiber.Queue(1)
    modules = (queues, queue_delivery, local, one_way, packet)
    files = {str(module.__file__) for module in modules}
    for stop in itertools.count():
        queue.put(1)
        interrupted = is_interrupted(queue.get, stop, files, steps=INSTRUCTIONS)
        free = queue._slots._free.value()
        assert free == int(queue.empty()), f"interrupted at step {stop}"
        if not free:
            queue.get()
        if not interrupted:
            break


@pytest.mark.parametrize("maxsize", [0, -1])
def test_without_a_positive_maxsize_it_is_never_full(maxsize: int) -> None:
    queue: queues.Queue[int] = fiber.Queue(maxsize)
    for number in range(MORE_THAN_FITS):
        queue.put(number, block=False)
    assert not queue.full()
    assert queue.qsize() == MORE_THAN_FITS


@pytest.mark.parametrize("kind", [fiber.Queue, fiber.JoinableQueue])
def test_a_closed_queue_refuses(kind: Callable[[], queues.Queue[int]]) -> None:
    queue = kind()
    with pytest.raises(AssertionError, match="not closed"):
        queue.join_thread()
    queue.close()
    queue.close()
    queue.join_thread()
    with pytest.raises(ValueError, match="is closed"):
        queue.put(1)
    with pytest.raises(ValueError, match="is closed"):
        queue.get()


def test_more_than_the_socket_holds_waits_in_order() -> None:
    queue: queues.Queue[Any] = fiber.Queue()
    for number in range(MORE_THAN_FITS):
        queue.put(number)
    assert [queue.get() for _ in range(MORE_THAN_FITS)] == list(range(MORE_THAN_FITS))
    queue.put("last")  # by the short way again
    assert queue.get() == "last"
    assert queue.qsize() == 0


def test_threads_keep_their_own_order() -> None:
    queue: Any = fiber.Queue()

    def put_all(name: int) -> None:
        for number in range(1000):
            queue.put((name, number))

    threads = [threading.Thread(target=put_all, args=(name,)) for name in range(4)]
    for thread in threads:
        thread.start()
    items = [queue.get(timeout=PATIENCE) for _ in range(4000)]
    for thread in threads:
        thread.join()
    for name in range(4):
        assert [number for who, number in items if who == name] == list(range(1000))


def test_an_item_arrives_as_it_was_when_it_was_put() -> None:
    queue: Any = fiber.Queue()
    array = np.arange(100_000)
    items = 400  # most of them have to wait: each takes a descriptor on its way
    for number in range(items):
        array[0] = number
        queue.put(array)
    array[:] = -1
    for number in range(items):
        got = queue.get()
        assert got[0] == number
        assert got[-1] == 99_999


def test_an_item_that_does_not_pickle_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    queue: Any = fiber.Queue(1)
    queue.put(Unpicklable())
    assert "it has no parts" in capsys.readouterr().err
    queue.put("next", block=False)
    assert queue.qsize() == 1
    assert queue.get() == "next"


def test_the_unpicklable_part_of_an_item_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    queue: Any = fiber.Queue()
    queue.put({"a": threading.Lock()})
    assert "the item cannot be pickled (at ['a'])" in capsys.readouterr().err


def test_the_hook_for_errors_can_be_overridden() -> None:
    reported = []

    class Watched(queues.Queue[Unpicklable]):
        @staticmethod
        def _on_queue_feeder_error(e: Exception, obj: Any) -> None:
            reported.append((e, obj))

    queue = Watched(ctx=fiber.get_context())
    item = Unpicklable()
    queue.put(item)
    ((error, obj),) = reported
    assert isinstance(error, AttributeError)
    assert obj is item


def test_a_hook_that_raises_does_not_stop_the_feeder(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[Any] = []
    monkeypatch.setattr(sys, "excepthook", lambda kind, error, trace: shown.append(error.args))
    posted: list[bytes] = []
    failures = [OSError("no memory")]

    def post(payload: bytes, buffers: list[memoryview]) -> None:
        if failures:
            raise failures.pop()
        posted.append(payload)

    def hook(error: Exception, obj: Any) -> None:
        sys.exit("the hook")

    queue: Any = fiber.Queue()
    outbox: Any = SimpleNamespace(can_try_send=False, post=post)
    feeder = Feeder(queue, outbox, ItemCount(), on_error=hook, close=lambda: None)
    feeder.put(b"1", [])
    feeder.put(b"2", [])
    feeder.close()
    feeder.join()
    assert posted == [b"2"]
    assert shown == [("the hook",)]


def test_a_waiting_put_goes_on_when_there_is_room() -> None:
    queue: Any = fiber.Queue(1)
    queue.put(1)
    thread = threading.Thread(target=queue.put, args=(2,))
    thread.start()
    assert queue.get() == 1
    thread.join(PATIENCE)
    assert queue.get() == 2


def test_the_reading_end_can_be_waited_for() -> None:
    queue: Any = fiber.Queue()
    assert wait([queue._reader], timeout=0) == []
    queue.put(1)
    assert wait([queue._reader], timeout=PATIENCE) == [queue._reader]


def test_classes_take_item_types() -> None:
    for kind in (queues.Queue, queues.JoinableQueue, queues.SimpleQueue):
        assert kind[int].__origin__ is kind


def test_join_thread_does_not_wait_for_items_without_a_reader() -> None:
    queue: queues.Queue[Any] = fiber.Queue()
    for _ in range(MORE_THAN_FITS):
        queue.put(b"x" * 100)
    queue.close()
    queue.join_thread()


def test_a_forgotten_queue_leaves_no_thread() -> None:
    before = threading.active_count()
    queue: queues.Queue[Any] = fiber.Queue()
    for _ in range(MORE_THAN_FITS):
        queue.put(1)
    assert threading.active_count() > before
    del queue
    assert wait_until(lambda: threading.active_count() == before, PATIENCE)


# Among processes


def put_all(queue: Any, first: int, count: int) -> None:
    for number in range(first, first + count):
        queue.put(number)


def get_all(queue: Any, answers: Any) -> None:
    for item in iter(queue.get, None):
        answers.put((os.getpid(), item))


def test_items_of_a_process_that_has_ended_arrive() -> None:
    queue: Any = fiber.Queue()
    process = start(put_all, queue, 0, MORE_THAN_FITS)
    assert [queue.get(timeout=PATIENCE) for _ in range(MORE_THAN_FITS)] == [*range(MORE_THAN_FITS)]
    process.join(PATIENCE)
    assert process.exitcode == 0


def put_and_leave(queue: Any, cancel: bool) -> None:
    if cancel:
        queue.cancel_join_thread()
    put_all(queue, 0, MORE_THAN_FITS)


def test_a_process_may_leave_its_items_behind() -> None:
    queue: Any = fiber.Queue()
    process = start(put_and_leave, queue, True)
    process.join(PATIENCE)
    assert process.exitcode == 0


def test_a_process_that_may_not_waits_until_they_are_read() -> None:
    queue: Any = fiber.Queue()
    process = start(put_and_leave, queue, False)
    process.join(0.3)
    assert process.exitcode is None
    for _ in range(MORE_THAN_FITS):
        queue.get(timeout=PATIENCE)
    process.join(PATIENCE)
    assert process.exitcode == 0


@pytest.mark.slow
def test_many_processes_put_and_get_at_once() -> None:
    items: queues.Queue[Any] = fiber.Queue(100)
    answers: queues.Queue[tuple[int, int]] = fiber.Queue()
    getters = [start(get_all, items, answers) for _ in range(2)]
    putters = [start(put_all, items, 5000 * n, 5000) for n in range(2)]
    got = [answers.get(timeout=PATIENCE) for _ in range(10_000)]
    for _ in getters:
        items.put(None)
    for process in (*getters, *putters):
        process.join(PATIENCE)
    assert sorted(item for _, item in got) == list(range(10_000))
    for putter in range(2):  # each getter sees each putter's items in order
        for pid in {pid for pid, _ in got}:
            own = [item for who, item in got if who == pid and item // 5000 == putter]
            assert own == sorted(own)


def send_back(inbox: Any, outbox: Any) -> None:
    for item in iter(inbox.get, None):
        outbox.put(item)


def test_large_items_pass() -> None:
    there: queues.Queue[Any] = fiber.Queue()
    back: queues.Queue[Any] = fiber.Queue()
    process = start(send_back, there, back)
    item = {"text": "x" * 3_000_000, "array": np.arange(500_000)}
    for _ in range(3):
        there.put(item)
    for _ in range(3):
        got = back.get(timeout=PATIENCE)
        assert got["text"] == item["text"]
        assert (got["array"] == item["array"]).all()
    there.put(None)
    process.join(PATIENCE)


def announce_and_get(queue: Any, ready: Any) -> None:
    ready.set()
    queue.get()


def test_a_reader_killed_while_it_waits_takes_no_item() -> None:
    queue: queues.Queue[Any] = fiber.Queue(1)
    ready = fiber.Event()
    for _ in range(3):
        process = start(announce_and_get, queue, ready)
        assert ready.wait(PATIENCE)
        ready.clear()
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join(PATIENCE)
    queue.put("still here", timeout=PATIENCE)
    assert queue.get(timeout=PATIENCE) == "still here"
    assert queue.empty()


def get_and_report(queue: Any, taken: Any) -> None:
    while True:
        taken.send(queue.get())


class _Deadly:
    """Table that kills the process that looks into it."""

    def __getitem__(self, _kind: int) -> int:
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError


def _die_with_an_item(queue: queues.Queue[str]) -> None:
    packet._UNITS = _Deadly()  # type: ignore[assignment]  # between the item and its slot
    queue.get()


def test_the_slot_of_a_reader_that_dies_with_its_item_becomes_free() -> None:
    queue: queues.Queue[str] = fiber.Queue(1)
    reader = start(_die_with_an_item, queue)
    queue.put("lost")
    reader.join()
    assert reader.exitcode == -signal.SIGKILL
    queue.put("kept", timeout=PATIENCE)
    assert queue.get() == "kept"
    assert queue.qsize() == 0


def _die_with_the_lock(queue: Any) -> None:
    queue._slots._claims._lock.acquire()
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("backend", [nullcontext, running], ids=["local", "loopback"])
def test_a_process_that_dies_with_the_lock_of_the_slots_causes_no_warning(backend: Any) -> None:
    with backend():
        queue: Any = fiber.Queue(1)
        process = start(_die_with_the_lock, queue)
        process.join()
        assert process.exitcode == -signal.SIGKILL
        lock = queue._slots._claims._lock
        assert not isinstance(lock.acquire(timeout=PATIENCE), Abandoned)
        lock.release()
        queue.put("kept")
        assert queue.get() == "kept"


@pytest.mark.slow
def test_readers_killed_anywhere_take_at_most_the_item_they_hold() -> None:
    queue: Any = fiber.Queue()
    total, killed = 2000, 10
    reported = []
    numbers = iter(range(total))
    for _ in range(killed):
        # New items for each reader: the one before may have taken all others until it was killed.
        for number in itertools.islice(numbers, total // killed):
            queue.put(number)
        reports, taken = fiber.Pipe(duplex=False)
        process = start(get_and_report, queue, taken)
        taken.close()
        reported.append(reports.recv())
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        try:
            while True:
                reported.append(reports.recv())
        except EOFError:
            reports.close()
    while True:
        try:
            reported.append(queue.get(timeout=0.5))
        except Empty:
            break
    assert len(set(reported)) == len(reported)
    assert total - killed <= len(reported) <= total


def in_a_fork(queue: Any) -> None:
    queue.put("from the fork")
    queue.close()
    queue.join_thread()


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_a_process_forked_by_multiprocessing_shares_the_queue() -> None:
    queue: Any = fiber.Queue()
    for _ in range(MORE_THAN_FITS):  # a feeder thread runs, which the fork does not inherit
        queue.put("from here")
    process = multiprocessing.get_context("fork").Process(target=in_a_fork, args=(queue,))
    process.start()
    got = [queue.get(timeout=PATIENCE) for _ in range(MORE_THAN_FITS + 1)]
    process.join(PATIENCE)
    assert process.exitcode == 0
    assert got.count("from the fork") == 1


# JoinableQueue


def work_off(queue: Any) -> None:
    for _ in iter(queue.get, None):
        queue.task_done()
    queue.task_done()


def test_join_waits_until_all_is_done() -> None:
    queue: Any = fiber.JoinableQueue()
    workers = [start(work_off, queue) for _ in range(3)]
    for number in range(200):
        queue.put(number)
    queue.join()
    assert queue.empty()
    for _ in workers:
        queue.put(None)
    queue.join()
    for worker in workers:
        worker.join(PATIENCE)


def test_join_of_a_queue_without_work_returns() -> None:
    fiber.JoinableQueue().join()


def test_every_joiner_is_woken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(queues, "RECHECK", 1000.0)
    queue: Any = fiber.JoinableQueue()
    for _ in range(100):
        queue.put(1)
        joiners = [threading.Thread(target=queue.join) for _ in range(4)]
        for thread in joiners:
            thread.start()
        queue.get()
        queue.task_done()
        for thread in joiners:
            thread.join(PATIENCE)
            assert not thread.is_alive()


def test_join_ends_although_the_last_worker_died_before_it_could_say(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(queues, "RECHECK", 0.01)
    queue: Any = fiber.JoinableQueue()
    queue.put(1)
    joiner = threading.Thread(target=queue.join)
    joiner.start()
    queue._unfinished.take(0)
    joiner.join(PATIENCE)
    assert not joiner.is_alive()


def test_an_unpicklable_item_does_not_count_as_an_unfinished_task(
    capsys: pytest.CaptureFixture[str],
) -> None:
    queue: Any = fiber.JoinableQueue()
    queue.put(Unpicklable())
    queue.join()
    assert "it has no parts" in capsys.readouterr().err


# SimpleQueue


def test_a_simple_queue() -> None:
    queue: queues.SimpleQueue[Any] = fiber.SimpleQueue()
    assert queue.empty()
    queue.put([1])
    assert not queue.empty()
    assert queue.get() == [1]
    with pytest.raises(AttributeError, match="it has no parts"):
        queue.put(Unpicklable())
    queue.close()
    queue.close()
    assert queue._reader.closed
    assert queue._writer.closed
    with pytest.raises(OSError, match="closed"):
        queue.put(1)


def test_a_simple_queue_among_processes() -> None:
    there: queues.SimpleQueue[Any] = fiber.SimpleQueue()
    back: queues.SimpleQueue[Any] = fiber.SimpleQueue()
    process = start(send_back, there, back)
    for item in (1, "x" * 2_000_000):
        there.put(item)
        assert back.get() == item
    there.put(None)
    process.join(PATIENCE)
