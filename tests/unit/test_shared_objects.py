"""Pipes, queues, semaphores and events behave the same on their own host and on another.

Where there are two hosts, this process is on one of them, and the objects are on the other.
"""

from __future__ import annotations

import select
import threading
from collections.abc import Callable, Iterator
from queue import Empty, Full
from typing import Any

import numpy as np
import pytest

import fiber
from census import wait_until
from fiber._hub.remote import RemoteChannel
from fiber.connection import Connection, wait
from fiber.errors import ConnectionClosed
from hosts import Far, background
from patience import PATIENCE

Bring = Callable[[Any], Any]


@pytest.fixture(params=["one host", "two hosts"])
def brought(request: pytest.FixtureRequest, far: Far) -> Bring:
    """Function that returns an object as another process of the one host or of two has it."""
    return far if request.param == "two hosts" else lambda thing: thing


@pytest.fixture
def ends(brought: Bring) -> Iterator[tuple[Connection, Connection]]:
    here, there = fiber.Pipe()
    moved = brought(there)
    assert isinstance(moved._channel, RemoteChannel) == (moved is not there)
    if moved is not there:
        there.close()
    with here, moved:
        yield here, moved


# Pipes


def test_messages_go_both_ways(ends: tuple[Connection, Connection]) -> None:
    here, there = ends
    there.send({"to": ["home"]})
    assert here.recv() == {"to": ["home"]}
    here.send(None)
    assert there.recv() is None
    there.send_bytes(b"")
    assert here.recv_bytes() == b""
    here.send_bytes(b"")
    assert there.recv_bytes() == b""


def send_zeros(connection: Connection, sizes: list[int]) -> None:
    for size in sizes:
        connection.send_bytes(bytes(size))


def test_boundaries_are_kept(ends: tuple[Connection, Connection]) -> None:
    sizes = [0, 1, 70_000, 5, 131_071, 131_072, 131_073, 3]
    for source, sink in (ends, ends[::-1]):
        sender = background(send_zeros, source, sizes)
        assert [sink.recv_bytes() for _ in sizes] == [bytes(size) for size in sizes]
        sender.join()


def test_large_messages_and_arrays_pass(ends: tuple[Connection, Connection]) -> None:
    item = {"text": "x" * 5_000_000, "arrays": [np.arange(500_000), np.zeros(0), np.ones(9_000)]}
    for source, sink in (ends, ends[::-1]):
        sender = background(source.send, item)
        got = sink.recv()
        sender.join()
        assert got["text"] == item["text"]
        for array, copy in zip(item["arrays"], got["arrays"], strict=True):
            assert (array == copy).all()
            assert copy.flags.writeable


def test_poll(ends: tuple[Connection, Connection]) -> None:
    here, there = ends
    assert not there.poll()
    assert not there.poll(0.01)
    assert not there.poll(-1)
    later = threading.Timer(0.01, here.send, [1])
    later.start()
    assert there.poll(None)
    assert there.poll()
    assert there.recv() == 1
    later.join()
    assert not there.poll()


def test_a_simplex_pipe_has_a_direction(brought: Bring) -> None:
    reader, writer = map(brought, fiber.Pipe(duplex=False))
    assert (reader.readable, reader.writable) == (True, False)
    assert (writer.readable, writer.writable) == (False, True)
    writer.send(1)
    assert reader.recv() == 1
    with pytest.raises(OSError, match="connection is read-only"):
        reader.send(1)
    with pytest.raises(OSError, match="connection is read-only"):
        reader.send_bytes(b"x")
    for receive in (writer.recv, writer.recv_bytes, writer.poll):
        with pytest.raises(OSError, match="connection is write-only"):
            receive()


@pytest.mark.parametrize("closing", [0, 1])
def test_closing_reports_the_end_after_the_last_message(
    ends: tuple[Connection, Connection], closing: int
) -> None:
    one, other = ends[closing], ends[1 - closing]
    one.send("last")
    one.close()
    assert other.poll()
    assert other.recv() == "last"
    assert other.poll(PATIENCE)
    with pytest.raises(EOFError) as caught:
        other.recv()
    assert type(caught.value) is ConnectionClosed
    with pytest.raises(BrokenPipeError):
        other.send(1)
    with pytest.raises(OSError, match="handle is closed"):
        one.recv()


def test_a_blocked_receiver_gets_the_end(ends: tuple[Connection, Connection]) -> None:
    here, there = ends
    raised: list[type[BaseException]] = []

    def receive() -> None:
        try:
            there.recv()
        except EOFError as error:
            raised.append(type(error))

    thread = background(receive)
    here.close()
    thread.join(PATIENCE)
    assert raised == [ConnectionClosed]


def test_a_full_pipe_makes_the_sender_wait(ends: tuple[Connection, Connection]) -> None:
    here, there = ends
    sent: list[int] = []

    def send_all() -> None:
        for number in range(2000):
            there.send(number)
            sent.append(number)

    thread = background(send_all)
    # The pipe's buffer takes some hundreds.
    assert wait_until(lambda: bool(sent), PATIENCE)
    assert [here.recv() for _ in range(2000)] == list(range(2000))
    thread.join(PATIENCE)
    assert len(sent) == 2000


def test_wait_is_right_before_and_after_receiving(ends: tuple[Connection, Connection]) -> None:
    here, there = ends
    for _ in range(3):
        assert wait([there], 0) == []
        here.send(1)
        here.send(2)
        assert wait([there], 0) == [there]
        assert there.recv() == 1
        assert wait([there], 0) == [there]
        assert there.recv() == 2
    assert wait([there, here], 0) == []
    here.close()
    assert wait([there], PATIENCE) == [there]


def test_a_kept_descriptor_stays_right(ends: tuple[Connection, Connection]) -> None:
    here, there = ends
    poller = select.poll()
    poller.register(there.fileno(), select.POLLIN)
    for number in range(20):
        assert poller.poll(0) == []
        here.send(number)
        if number % 2:
            here.send(number)
            assert poller.poll(PATIENCE * 1000)
            assert there.recv() == number
        assert poller.poll(PATIENCE * 1000)
        assert there.recv() == number


# Queues


def test_a_bounded_queue(brought: Bring) -> None:
    queue: Any = fiber.Queue(2)
    there: Any = brought(queue)
    assert there.empty()
    there.put({"three": [4]})
    assert not there.full()
    there.put(None, timeout=1)
    assert there.full()
    assert there.qsize() == queue.qsize() == 2
    for options in ({"block": False}, {"timeout": 0.01}, {"timeout": -1}):
        with pytest.raises(Full):
            there.put(3, **options)
    with pytest.raises(Full):
        there.put_nowait(3)
    assert queue.get(timeout=PATIENCE) == {"three": [4]}
    there.put("two", timeout=-1)
    assert [there.get(), there.get(timeout=PATIENCE)] == [None, "two"]
    assert there.empty()
    assert there.qsize() == 0
    for options in ({"block": False}, {"timeout": 0.01}, {"timeout": -1}):
        with pytest.raises(Empty):
            there.get(**options)
    with pytest.raises(Empty):
        there.get_nowait()
    queue.put("home")
    assert wait([there._reader], PATIENCE) == [there._reader]
    assert there.get(timeout=-1) == "home"


def test_the_last_item_of_a_closed_queue_arrives(far: Far) -> None:
    queue: Any = fiber.Queue()
    there: Any = far(queue)
    there.put("away")
    there.close()
    there.join_thread()
    assert queue.get(timeout=PATIENCE) == "away"


def test_a_joinable_queue(brought: Bring) -> None:
    queue: Any = fiber.JoinableQueue()
    there: Any = brought(queue)
    queue.put(1)
    joiners = [background(queue.join), background(there.join)]
    assert there.get() == 1
    assert all(joiner.is_alive() for joiner in joiners)
    there.task_done()
    for joiner in joiners:
        joiner.join(PATIENCE)
        assert not joiner.is_alive()
    with pytest.raises(ValueError, match="too many times"):
        there.task_done()


# Semaphores and events


def test_a_semaphore_counts(brought: Bring) -> None:
    here = fiber.Semaphore(2)
    there = brought(here)
    assert there.acquire()
    assert there.get_value() == 1
    assert there.acquire()
    assert there.get_value() == here.get_value() == 0
    assert not there.acquire(False)
    assert not there.acquire(False, 100)
    assert not there.acquire(timeout=0.01)
    assert not there.acquire(timeout=-1)
    here.release()
    assert there.acquire(timeout=-1)
    for _ in range(3):
        there.release()
    assert here.acquire(timeout=PATIENCE)
    assert there.get_value() == 2
    assert repr(there) == "<Semaphore(value=2)>"
    with there as acquired:
        assert acquired
        assert there.get_value() == 1
    assert there.get_value() == 2


@pytest.mark.parametrize("make", [fiber.Lock, fiber.BoundedSemaphore])
def test_a_release_too_many_is_refused(make: Callable[[], Any], brought: Bring) -> None:
    here = make()
    there = brought(here)
    with pytest.raises(ValueError, match="too many times"):
        there.release()
    with there:
        assert not here.acquire(False)
    with pytest.raises(ValueError, match="too many times"):
        there.release()
    assert there.acquire(timeout=PATIENCE)


def test_a_bounded_semaphore_shows_its_bound(brought: Bring) -> None:
    there = brought(fiber.BoundedSemaphore(2))
    assert repr(there) == "<BoundedSemaphore(value=2, maxvalue=2)>"


def test_an_event(brought: Bring) -> None:
    event = fiber.Event()
    there = brought(event)
    assert not there.is_set()
    for timeout in (0, 0.01, -1):
        assert not there.wait(timeout)
    assert "unset" in repr(there)
    waiting = background(there.wait, PATIENCE)
    event.set()
    event.set()
    waiting.join(PATIENCE)
    assert not waiting.is_alive()
    assert there.is_set()
    assert there.wait()
    assert there.wait(0)
    assert repr(there).endswith(" set>")
    there.clear()
    there.clear()
    assert not event.is_set()
