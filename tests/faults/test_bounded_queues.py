"""Queues whose processes are killed: items stay, and the places of a bounded queue come back."""

from __future__ import annotations

import contextlib
import threading
from queue import Empty, Full
from typing import Any

import pytest

import fiber
from census import wait_until
from faults import targets
from patience import PATIENCE

pytestmark = pytest.mark.usefixtures("backend")

SIZE = 8


def room(queue: Any) -> int:
    """Return how many items an empty queue takes."""
    for count in range(SIZE + 1):
        try:
            queue.put(count, timeout=PATIENCE if count < SIZE else 0)
        except Full:
            return count
    return SIZE + 1


def room_left_by_one(queue: Any) -> int:
    """Return how many places are free while an empty queue has one item."""
    queue.put("one")
    free: int = queue._slots._free.value()
    assert queue.get() == "one"
    return free


def kill(process: fiber.Process) -> None:
    process.kill()
    process.join(PATIENCE)
    process.close()


def test_a_killed_reader_takes_only_the_item_that_it_has() -> None:
    queue: Any = fiber.Queue()
    ours, theirs = fiber.Pipe()
    for number in range(20):
        queue.put(number)
    reader = fiber.Process(target=targets.get_one_and_block, args=(queue, theirs))
    reader.start()
    assert ours.recv() == 0
    kill(reader)
    assert [queue.get(timeout=PATIENCE) for _ in range(19)] == list(range(1, 20))
    for end in (ours, theirs, queue):
        end.close()
    queue.join_thread()


def test_a_process_killed_while_it_pickles_has_no_place() -> None:
    queue: Any = fiber.Queue(1)
    here, there = fiber.Pipe()
    process = fiber.Process(target=targets.put_what_never_pickles, args=(queue, there))
    process.start()
    assert here.recv() == "pickling"
    kill(process)
    queue.put("mine", timeout=PATIENCE)
    assert queue.get() == "mine"


def test_places_of_items_that_were_not_sent_come_back() -> None:
    queue: Any = fiber.Queue(SIZE)
    here, there = fiber.Pipe()
    for _ in range(2):
        process = fiber.Process(target=targets.put_bulky_items, args=(queue, SIZE, there))
        process.start()
        assert here.recv() == "put"
        kill(process)
        drained = threading.Thread(target=lambda: [*iter(queue.get, "mine")])
        drained.start()
        queue.put("mine", timeout=PATIENCE)
        drained.join(PATIENCE)
        assert SIZE <= room(queue) <= SIZE + 1  # an item may have been under way
        assert queue.full()
        while not queue.empty():
            queue.get()
        wait_until(lambda: room_left_by_one(queue) == SIZE - 1, PATIENCE)


def test_an_item_that_a_full_queue_refuses_keeps_no_pipe_open() -> None:
    queue: Any = fiber.Queue(1)
    queue.put("first")
    receiver, sender = fiber.Pipe(duplex=False)
    with pytest.raises(Full):
        queue.put(sender, timeout=0.01)
    sender.close()
    assert receiver.poll(PATIENCE)
    with pytest.raises(EOFError):
        receiver.recv()
    assert queue.get() == "first"
    with contextlib.suppress(Empty):
        pytest.fail(f"there is {queue.get(timeout=0.01)!r}")
