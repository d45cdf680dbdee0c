"""Channels in one direction: which reader gets a message, and what a death leaves behind."""

from __future__ import annotations

import contextlib
import itertools
import os
import select
import signal
import threading
from collections.abc import Callable
from typing import Any

import pytest

import fiber
import fiber.connection
from census import wait_until
from fiber._hub import one_way, queue_delivery
from fiber._hub.hosted import HostedReceiver
from fiber._hub.local import LocalChannel
from fiber._hub.one_way import AMBIGUOUS, ReceivingEnd
from fiber._hub.queue_delivery import Dealer
from fiber._transport import channels
from fiber._wire import packet
from fiber.errors import ConnectionClosed
from hosts import Far, background
from patience import PATIENCE
from processes.one_way_ends import MORE_THAN_A_SOCKET, Ends, drain, filled, numbers, overflow


def is_readable(channel: ReceivingEnd) -> bool:
    """Return whether ``select`` and its like find the channel readable."""
    poller = select.poll()
    poller.register(channel.fileno(), select.POLLIN)
    return bool(poller.poll(0))


def test_a_pair_makes_each_socket_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    class Counted(channels.BorrowedSocket):
        def __init__(self, owner: Any) -> None:
            made.append(owner)
            super().__init__(owner)

    monkeypatch.setattr(channels, "BorrowedSocket", Counted)
    for end in one_way.pair():
        end.close()
    assert len(made) == 2


def test_a_receiver_sleeps_in_the_kernel_until_a_message_comes(
    ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    receiver, sender = ends
    waits = []
    receive = packet.receive

    def receive_what_comes(*args: Any, wait: bool, **options: Any) -> packet.Message:
        waits.append(wait)
        if len(waits) > 1:
            sender.send(b"1")
        return receive(*args, wait=wait, **options)

    monkeypatch.setattr(packet, "receive", receive_what_comes)
    assert receiver.try_recv() is None
    assert receiver.recv().tobytes() == b"1"
    assert waits == [False, True]


def test_a_poll_sleeps_as_long_as_it_may(ends: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    receiver, _ = ends
    naps: list[float] = []

    def readable_in_the_end(_: int, timeout: float) -> bool:
        naps.append(timeout)
        return len(naps) == 3

    monkeypatch.setattr(one_way, "wait_readable", readable_in_the_end)
    for timeout in (None, 10 * one_way.LOOK_AGAIN):
        naps.clear()
        assert receiver.poll(timeout)
        assert naps == [one_way.LOOK_AGAIN] * 3
    for timeout in (0, -1):
        naps.clear()
        assert not receiver.poll(timeout)
        assert naps == [0]


# Received messages


def test_the_descriptor_is_readable_as_long_as_there_is_something(ends: Ends) -> None:
    receiver, sender = ends
    overflow(sender)
    for number in range(MORE_THAN_A_SOCKET):
        assert is_readable(receiver)
        assert receiver.poll(0)
        assert receiver.recv().tobytes() == b"%d" % number
    assert not is_readable(receiver)
    assert not receiver.poll(0)
    assert receiver.try_recv() is None


def test_once_it_is_empty_the_next_message_goes_through_the_socket(ends: Ends) -> None:
    receiver, sender = ends
    for _ in range(3):
        overflow(sender)
        assert drain(receiver) == numbers(MORE_THAN_A_SOCKET)
        assert not sender.backlog
        sender.send(b"direct")
        assert not sender.backlog
        assert receiver.recv().tobytes() == b"direct"


def test_a_message_that_was_sent_a_moment_too_late_keeps_its_place(ends: Ends) -> None:
    receiver, sender = ends
    overflow(sender)
    first = receiver.recv().tobytes()
    # A sender that had found no backlog, and whose next message goes into it.
    late = LocalChannel(sender.owner)
    assert late.try_send(b"late")
    sender.backlog.words[AMBIGUOUS] = True
    assert sender.try_send(b"later")
    taken = [first, *drain(receiver)]
    assert sorted(taken) == sorted([*numbers(MORE_THAN_A_SOCKET), b"late", b"later"])
    assert [item for item in taken if item.isdigit()] == numbers(MORE_THAN_A_SOCKET)
    assert taken.index(b"late") < taken.index(b"later")
    assert not is_readable(receiver)


def test_every_receiver_that_sleeps_is_woken(ends: Ends) -> None:
    receiver, sender = ends
    got: list[bytes] = []

    def receive() -> None:
        got.append(receiver.recv().tobytes())

    overflow(sender)
    # All bytes in the socket, without the backlog: a receiver that wakes up finds these.
    while (message := _received(receiver)) is not None:
        message.release()
    sleepers = [background(receive) for _ in range(5)]
    for sleeper in sleepers:
        sleeper.join(PATIENCE)
    assert len(set(got)) == 5
    assert is_readable(receiver)


def _received(receiver: ReceivingEnd) -> packet.Message | None:
    """The next message of the socket alone; the wake-up packet stays there."""
    if receiver._peek() == bytes([packet.WAKE_UP]):
        return None
    return packet.receive(receiver.sock)


def test_a_receiver_that_dies_with_the_wake_up_keeps_no_message(ends: Ends) -> None:
    receiver, sender = ends
    overflow(sender)
    taken = []
    while (message := _received(receiver)) is not None:
        taken.append(message.tobytes())
    with pytest.raises(packet.WakeUp):
        packet.receive(receiver.sock)
    assert not is_readable(receiver)
    assert receiver.poll(0)  # it looks at the backlog
    assert sender.try_send(b"next")
    assert is_readable(receiver)  # and a sender mends the rest
    assert [*taken, *drain(receiver)] == [*numbers(MORE_THAN_A_SOCKET), b"next"]


def test_a_receiver_that_slept_before_it_was_lost_wakes_all_the_same(ends: Ends) -> None:
    receiver, sender = ends
    answers: list[bytes] = []
    sleeper = background(lambda: answers.append(receiver.recv().tobytes()))
    sender.backlog.put(memoryview(b"unannounced"))
    sleeper.join(PATIENCE)
    assert answers == [b"unannounced"]


@pytest.mark.parametrize("sleep", ["recv", "poll", "wait"])
def test_a_reader_of_another_host_finds_an_unannounced_message(
    sleep: str, far: Far, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, writer = fiber.Pipe(duplex=False)
    there: Any = far(reader)
    sender: Any = writer._channel
    answers: list[object] = []
    ways: dict[str, Callable[[], object]] = {
        "recv": there.recv_bytes,
        "poll": lambda: there.poll(None) and there.recv_bytes(),
        "wait": lambda: fiber.connection.wait([there]) and there.recv_bytes(),
    }
    asleep = threading.Event()
    watch = HostedReceiver._watch

    def watched(hosted: HostedReceiver) -> None:
        watch(hosted)
        if hosted._is_awaited():
            asleep.set()

    monkeypatch.setattr(HostedReceiver, "_watch", watched)
    sleeper = background(lambda: answers.append(ways[sleep]()))
    assert asleep.wait(PATIENCE)
    sender.backlog.put(memoryview(b"unannounced"))
    sleeper.join(PATIENCE)
    assert answers == [b"unannounced"]
    with reader, writer, there:
        pass


def test_the_dealer_of_a_queue_finds_an_unannounced_item() -> None:
    inbox, outbox = one_way.pair()
    arrivals, door = LocalChannel.pair()
    Dealer(inbox, arrivals).start()
    reader = queue_delivery.become_reader(door)
    outbox.send(b"first")
    assert reader.recv().tobytes() == b"first"  # it sleeps before it looks again
    outbox.backlog.put(memoryview(b"unannounced"))
    assert reader.poll(PATIENCE)
    assert reader.recv().tobytes() == b"unannounced"
    for channel in (reader, outbox, door):
        channel.close()


def test_the_end_comes_after_the_backlog(ends: Ends) -> None:
    receiver, sender = ends
    overflow(sender)
    sender.close()
    for number in range(MORE_THAN_A_SOCKET):
        assert receiver.recv().tobytes() == b"%d" % number
    with pytest.raises(ConnectionClosed):
        receiver.recv()


# Conditions that a sender waits for


def test_a_full_channel_makes_its_sender_wait_and_then_go_on(ends: Ends) -> None:
    receiver, sender = ends
    count = filled(lambda: sender.try_send(b"x" * 40))

    def send_more() -> None:
        for _ in range(count):
            sender.send(b"y" * 40)

    more = background(send_more)
    got = [receiver.recv().tobytes() for _ in range(2 * count)]
    more.join(PATIENCE)
    assert got == [b"x" * 40] * count + [b"y" * 40] * count


@pytest.mark.parametrize("size", [64_000, 66_000, 300_000])
def test_a_message_too_large_for_the_backlog_waits_for_its_turn(size: int, ends: Ends) -> None:
    receiver, sender = ends
    overflow(sender)
    large = background(sender.send, bytes(size))
    got = [receiver.recv().tobytes() for _ in range(MORE_THAN_A_SOCKET + 1)]
    large.join(PATIENCE)
    assert got == [*numbers(MORE_THAN_A_SOCKET), bytes(size)]


def test_waiting_senders_get_the_loss_of_all_receivers(ends: Ends) -> None:
    receiver, sender = ends
    filled(lambda: sender.try_send(b"x" * 40))
    errors: list[BaseException] = []

    def send() -> None:
        try:
            sender.send(b"one more")
        except BrokenPipeError as error:
            errors.append(error)

    sleeper = background(send)
    receiver.close()
    sleeper.join(PATIENCE)
    assert len(errors) == 1


def test_a_sender_with_a_backlog_gets_it_at_once(ends: Ends) -> None:
    receiver, sender = ends
    overflow(sender)
    receiver.close()
    with pytest.raises(BrokenPipeError):
        sender.send(b"one more")


# Processes


def put_numbers(queue: Any, who: int, count: int) -> None:
    for number in range(count):
        queue.put((who, number, b"x" * (number % 7 * 100)))


def take_until_none(queue: Any, answers: Any) -> None:
    answers.send([item[:2] for item in iter(queue.get, None)])


def test_many_processes_put_and_get_more_than_there_is_room_for() -> None:
    queue: Any = fiber.SimpleQueue()
    count = 3000
    writers = [fiber.Process(target=put_numbers, args=(queue, who, count)) for who in range(3)]
    pipes = [fiber.Pipe(duplex=False) for _ in range(3)]
    readers = [fiber.Process(target=take_until_none, args=(queue, pipe[1])) for pipe in pipes]
    for process in (*writers, *readers):
        process.start()
    for writer in writers:
        writer.join(60)
    for _ in readers:
        queue.put(None)
    taken = [answers.recv() for answers, _ in pipes]
    for items in taken:
        for who in range(3):
            assert [n for w, n in items if w == who] == sorted(n for w, n in items if w == who)
    assert sorted(itertools.chain(*taken)) == [(who, n) for who in range(3) for n in range(count)]
    for process in readers:
        process.join(60)
    assert queue.empty()


def put_for_ever(queue: Any, ready: Any) -> None:
    ready.send(None)
    number = 0
    while True:
        queue.put(number)
        number += 1


@pytest.mark.slow
def test_a_writer_killed_anywhere_stops_no_other() -> None:
    queue: Any = fiber.SimpleQueue()
    for _ in range(10):
        told, ready = fiber.Pipe(duplex=False)
        process = fiber.Process(target=put_for_ever, args=(queue, ready))
        process.start()
        told.recv()
        wait_until(lambda: bool(queue._reader._channel.backlog), PATIENCE)
        for _ in range(500):
            queue.get()
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join(PATIENCE)
        while not queue.empty():
            assert isinstance(queue.get(), int)
        queue.put("mine")
        assert queue.get() == "mine"


def get_and_report(queue: Any, taken: Any) -> None:
    while True:
        taken.send(queue.get())


@pytest.mark.slow
def test_readers_killed_anywhere_take_at_most_the_item_they_hold() -> None:
    queue: Any = fiber.SimpleQueue()
    killed, round_ = 8, 400
    reported = []
    for start in range(0, killed * round_, round_):
        for number in range(start, start + round_):  # a quick reader may take all that is there
            queue.put(number)
        reports, taken = fiber.Pipe(duplex=False)
        process = fiber.Process(target=get_and_report, args=(queue, taken))
        process.start()
        taken.close()
        reported += [reports.recv() for _ in range(200)]
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join(PATIENCE)
        with contextlib.suppress(EOFError):
            while True:
                reported.append(reports.recv())
    while not queue.empty():
        reported.append(queue.get())
    assert len(set(reported)) == len(reported)
    assert killed * round_ - killed <= len(reported) <= killed * round_


def hold_the_backlog(queue: Any) -> None:
    queue._writer._channel.backlog.run(lambda: os.kill(os.getpid(), signal.SIGKILL))


def test_a_process_killed_within_the_backlog_leaves_it_to_others() -> None:
    queue: Any = fiber.SimpleQueue()
    process = fiber.Process(target=hold_the_backlog, args=(queue,))
    process.start()
    process.join(60)
    for number in range(MORE_THAN_A_SOCKET):
        queue.put(number)
    assert [queue.get() for _ in range(MORE_THAN_A_SOCKET)] == list(range(MORE_THAN_A_SOCKET))


def test_threads_keep_their_own_order() -> None:
    receiver, sender = one_way.pair()

    def send_all(who: int) -> None:
        for number in range(2000):
            sender.send(b"%d %d" % (who, number))

    writers = [threading.Thread(target=send_all, args=(who,)) for who in range(4)]
    for writer in writers:
        writer.start()
    taken = [receiver.recv().tobytes().split() for _ in range(4 * 2000)]
    for writer in writers:
        writer.join(PATIENCE)
    for who in range(4):
        assert [int(n) for w, n in taken if int(w) == who] == list(range(2000))
