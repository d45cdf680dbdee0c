"""SimpleQueuePush deals items round robin, to live readers."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest

import fiber
from faults import targets
from fiber.errors import ConnectionClosed
from fiber.queues import SimpleQueue, SimpleQueuePush
from patience import PATIENCE

pytestmark = pytest.mark.usefixtures("backend")


class Reader:
    """Process that reads when asked."""

    def __init__(self, queue: SimpleQueuePush[Any]) -> None:
        self._orders, theirs = fiber.Pipe()
        self.process = fiber.Process(target=targets.read_as_told, args=(queue, theirs))
        self.process.start()
        theirs.close()
        assert self.ask("empty") is True  # it is a reader now

    def ask(self, method: str) -> Any:
        self._orders.send(method)
        return self._orders.recv()

    def end(self) -> None:
        self.process.kill()
        self.process.join(PATIENCE)
        self.process.close()
        self._orders.close()


@pytest.fixture
def queue() -> Iterator[SimpleQueuePush[Any]]:
    queue: SimpleQueuePush[Any] = SimpleQueuePush()
    yield queue
    queue.close()
    for thread in threading.enumerate():
        if thread.name == "fiber-dealer":
            thread.join(PATIENCE)


@pytest.fixture
def readers(queue: SimpleQueuePush[Any]) -> Iterator[list[Reader]]:
    readers = [Reader(queue) for _ in range(3)]
    yield readers
    for reader in readers:
        reader.end()


def test_each_gets_the_next(queue: SimpleQueuePush[Any], readers: list[Reader]) -> None:
    for item in range(9):
        queue.put(item)
    for place, reader in enumerate(readers):
        assert [reader.ask("get") for _ in range(3)] == [place, place + 3, place + 6]
        assert reader.ask("empty") is True


def test_a_dealt_item_is_not_waited_for(queue: SimpleQueuePush[Any], readers: list[Reader]) -> None:
    large = bytes(2_000_000)
    queue.put(large)
    queue.put("small")
    assert readers[1].ask("get") == "small"
    assert readers[0].ask("get") == large


def test_items_wait_for_the_first_reader(queue: SimpleQueuePush[Any]) -> None:
    queue.put(1)
    queue.put(2)
    sent: SimpleQueue[int] = fiber.SimpleQueue()
    reader = fiber.Process(target=targets.read_one, args=(queue, sent))
    reader.start()
    assert sent.get() == 1
    reader.join(PATIENCE)
    reader.close()


def test_the_others_go_on_without_a_dead_one(
    queue: SimpleQueuePush[Any], readers: list[Reader]
) -> None:
    dead = readers.pop(1)
    dead.end()
    for item in range(20):
        queue.put(item)
    got = [reader.ask("get") for _ in range(5) for reader in readers]
    assert got == sorted(got)
    assert len(got) == len(set(got))


def test_a_reader_that_does_not_read_is_skipped(
    queue: SimpleQueuePush[Any], readers: list[Reader]
) -> None:
    idle, *_ = readers
    item = bytes(50_000)
    for _ in range(60):  # far more than a third fits into the idle one's socket
        queue.put(item)
        for reader in readers:
            while reader is not idle and not reader.ask("empty"):
                assert reader.ask("get") == item


def test_the_maker_can_read_too_and_a_thread_is_no_second_reader(
    queue: SimpleQueuePush[Any],
) -> None:
    for item in range(4):
        queue.put(item)
    got: list[Any] = []
    threads = [threading.Thread(target=lambda: got.append(queue.get())) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    assert sorted(got) == [0, 1, 2, 3]


def test_without_the_process_that_deals_there_is_an_error() -> None:
    ours, theirs = fiber.Pipe()
    maker = fiber.Process(target=targets.make_a_push_queue, args=(theirs,))
    maker.start()
    theirs.close()
    joined, other = ours.recv(), None
    ours.send("another")
    other = ours.recv()
    assert joined.get() == 1
    maker.kill()
    maker.join(PATIENCE)
    for queue in (joined, other):
        with pytest.raises(ConnectionClosed):
            queue.get()
        queue.close()
    ours.close()
    maker.close()
