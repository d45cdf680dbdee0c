"""Room of pipes and queues for unread messages, and the patience of the sender of a queue."""

from __future__ import annotations

import multiprocessing
import os
import pickle
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

import fiber
import fiber.connection
from fiber._hub import one_way
from hosts import Far, background
from patience import PATIENCE
from processes.one_way_ends import MORE_THAN_A_SOCKET, Ends, drain, filled, numbers, overflow

SIZES = (0, 1, 40, 100, 1000, 10_000, 60_000)


def held_by_multiprocessing(size: int, *, duplex: bool) -> int:
    reader, writer = multiprocessing.Pipe(duplex)
    os.set_blocking(writer.fileno(), False)

    def send() -> bool:
        try:
            writer.send("x" * size)
        except BlockingIOError:
            return False
        return True

    with reader, writer:
        return filled(send)


def held_by_fiber(size: int, *, duplex: bool) -> int:
    if duplex:
        one, other = fiber.Pipe()
        channel = pickle.loads(pickle.dumps(one._channel))
    else:
        other, one = fiber.Pipe(duplex=False)
        channel = one._channel
    message = pickle.dumps("x" * size)
    with one, other:
        count = filled(lambda: channel.try_send(message))
        channel.close()
    return count


@pytest.mark.parametrize("duplex", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_a_pipe_holds_as_much_as_multiprocessings(size: int, duplex: bool) -> None:
    assert held_by_fiber(size, duplex=duplex) >= held_by_multiprocessing(size, duplex=duplex)


@pytest.mark.parametrize("size", [1, 40, 1000])
def test_a_simple_queue_of_another_host_holds_as_much_as_multiprocessings(
    size: int, far: Far
) -> None:
    count = held_by_multiprocessing(size, duplex=False)
    here: Any = fiber.SimpleQueue()
    there = far(here)
    item = "x" * size
    sender = background(lambda: [there.put(item) for _ in range(count)])
    sender.join(60)
    assert not sender.is_alive()
    assert [there.get() for _ in range(count)] == [item] * count


def here(queue: Any) -> Any:
    """Return another holder of a queue in this process."""
    return pickle.loads(pickle.dumps(queue))


@pytest.mark.parametrize("make", [fiber.Queue, fiber.JoinableQueue, lambda: fiber.Queue(30_000)])
@pytest.mark.parametrize("elsewhere", [False, True], ids=["here", "there"])
@pytest.mark.parametrize("size", [1, 40, 1000])
def test_a_process_that_put_as_much_as_multiprocessings_queue_holds_can_end(
    size: int, elsewhere: bool, make: Callable[[], Any], far: Far
) -> None:
    count = held_by_multiprocessing(size, duplex=False)
    queue = make()
    holder: Any = far(queue) if elsewhere else here(queue)
    for _ in range(count):
        holder.put("x" * size)
    holder.close()
    ended = background(holder.join_thread)
    ended.join(PATIENCE)
    assert not ended.is_alive()
    assert [queue.get() for _ in range(count)] == ["x" * size] * count


def test_a_bounded_queue_gives_back_the_place_of_each_item_of_its_backlog() -> None:
    queue: Any = fiber.Queue(MORE_THAN_A_SOCKET)
    putter = here(queue)
    for number in range(MORE_THAN_A_SOCKET):
        putter.put(number)
    putter.close()
    putter.join_thread()
    assert queue.full()
    assert [queue.get() for _ in range(MORE_THAN_A_SOCKET)] == [*range(MORE_THAN_A_SOCKET)]
    assert queue._slots._free.value() == MORE_THAN_A_SOCKET
    assert queue.empty()


# ``post``, by which a queue sends


class Clock:
    """Time for a sender.  It goes on by what the sender sleeps, and ``naps`` has those times."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        self.naps: list[float] = []
        self.at_a_nap: Callable[[], object] = lambda: None
        time = SimpleNamespace(monotonic=lambda: self.now, sleep=self.nap)
        monkeypatch.setattr(one_way, "time", time)
        monkeypatch.setattr(one_way, "wait_until", lambda _fd, _events, seconds: self.nap(seconds))

    def nap(self, seconds: float) -> None:
        self.naps.append(seconds)
        self.now += seconds
        self.at_a_nap()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def in_the_backlog(ends: Ends) -> int:
    """Return the number of bytes that the backlog has ever had."""
    return int(ends[0].backlog.words[one_way.TAIL])


def test_a_message_goes_through_the_socket_if_receivers_soon_make_room(
    ends: Ends, clock: Clock
) -> None:
    receiver, sender = ends
    held = filled(lambda: sender.try_send_directly(b"first"))
    clock.at_a_nap = receiver.recv
    sender.post(b"last")
    assert clock.naps == pytest.approx([one_way.PATIENCE])
    assert drain(receiver) == [b"first"] * (held - 1) + [b"last"]
    assert not in_the_backlog(ends)


def test_a_message_goes_through_the_socket_if_receivers_soon_empty_the_backlog(
    ends: Ends, clock: Clock
) -> None:
    receiver, sender = ends
    overflow(sender)
    before, taken = in_the_backlog(ends), []
    clock.at_a_nap = lambda: taken.extend(drain(receiver))
    sender.post(b"last")
    assert len(clock.naps) == 1
    assert taken == numbers(MORE_THAN_A_SOCKET)
    assert drain(receiver) == [b"last"]
    assert in_the_backlog(ends) == before


def test_a_slow_receiver_makes_a_sender_wait_once_in_a_while(ends: Ends, clock: Clock) -> None:
    receiver, sender = ends
    overflow(sender)
    clock.at_a_nap = receiver.recv
    sender.post(b"waits")
    assert sum(clock.naps) == pytest.approx(one_way.PATIENCE)
    clock.naps.clear()
    for _ in range(100):
        sender.post(b"does not wait")
    assert not clock.naps
    clock.now += one_way.HURRY
    sender.post(b"waits again")
    assert sum(clock.naps) == pytest.approx(one_way.PATIENCE)
    assert drain(receiver)[-102:] == [b"waits", *[b"does not wait"] * 100, b"waits again"]


def test_small_and_large_messages_share_the_room(ends: Ends) -> None:
    receiver, sender = ends
    overflow(sender)
    assert sender.try_send(bytes(20_000))
    assert sender.try_send(b"last")
    taken = drain(receiver)
    assert taken == [*numbers(MORE_THAN_A_SOCKET), bytes(20_000), b"last"]
