"""Messages to another host that their sender does not wait for."""

from __future__ import annotations

import errno
import gc
import itertools
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from typing import Any

import pytest

import fiber
from census import wait_until
from fiber import _unconfirmed
from fiber._hub import client, pipelined, remote
from fiber._hub.hosted import HostedChannel
from fiber._hub.one_way import SendingEnd
from fiber._hub.protocol import HEAD, ONE, Op
from fiber._hub.remote import RemoteChannel
from fiber._unconfirmed import flush_all, unconfirmed
from fiber.connection import Connection
from hosts import Far, Hosts, Wire, background, objects_kept
from patience import PATIENCE
from unit.interrupting import CALLS, is_interrupted

Pipe = tuple[Connection, Connection]


@pytest.fixture(autouse=True)
def child(hosts: Hosts, far: Far) -> Iterator[None]:
    """Make this process a child of host b, which sends without waiting."""
    with hosts.child_at("b"):
        yield


@pytest.fixture
def open_pipe(child: None, far_pipe: Pipe) -> Pipe:
    """A pipe by which the first message has gone, the only one that its sender waits for."""
    here, there = far_pipe
    there.send("first")
    assert here.recv() == "first"
    return far_pipe


def channel_of(connection: Connection) -> RemoteChannel:
    channel = connection._channel
    assert isinstance(channel, RemoteChannel)
    return channel


def test_a_sender_goes_on_while_messages_are_on_their_way(
    open_pipe: Pipe, wires: tuple[Wire, Wire]
) -> None:
    here, there = open_pipe
    up, _ = wires
    up.hold()
    for number in range(10):
        there.send(number)
    assert not here.poll()
    up.let_go()
    assert [here.recv() for _ in range(10)] == list(range(10))


@pytest.fixture
def one_way(child: None, far: Far) -> Iterator[Pipe]:
    here, writer = fiber.Pipe(duplex=False)
    there = far(writer)
    writer.close()
    there.send("first")
    assert here.recv() == "first"
    yield here, there
    here.close()
    there.close()


@pytest.mark.parametrize("size", [1, 30_000])
def test_a_sender_waits_when_the_channel_takes_nothing(one_way: Pipe, size: int) -> None:
    here, there = one_way
    untaken = channel_of(there)._pipelined[0]._untaken
    waiting = []

    def send() -> None:
        for number in range(5000):
            there.send((number, bytes(size)))
            waiting.append(sum(untaken.values()))

    sender = background(send)
    assert wait_until(lambda: sum(untaken.values()) > pipelined.CREDIT - size - 2000, PATIENCE)
    assert len(waiting) < 5000
    for number in range(5000):
        assert here.recv()[0] == number
    sender.join(PATIENCE)
    assert max(waiting) < pipelined.CREDIT + size + 2 * pipelined.OVERHEAD


@pytest.mark.parametrize("size", [1, 3000, 30_000])
def test_a_pipe_has_room_for_all_messages_of_a_killed_process(open_pipe: Pipe, size: int) -> None:
    here, there = open_pipe
    sender = channel_of(there)._pipelined[0]
    sent = []

    def send() -> None:
        with suppress(OSError):  # the process is killed
            for number in itertools.count():
                there.send((number, bytes(size)))
                sent.append(number)

    thread = background(send)
    assert wait_until(
        lambda: is_full(sender),
        PATIENCE,
    )
    kill(there)
    thread.join(PATIENCE)
    received = []
    with suppress(EOFError):
        while True:
            received.append(here.recv()[0])
    assert received[: len(sent)] == sent


def fill(there: Connection) -> list[int]:
    """Send until a message waits in the hub for room; return the numbers that were sent."""
    sender = channel_of(there)._pipelined[0]
    for number in itertools.count():
        there.send(bytes([number]) * 30_000)
        sender.flush()
        if sender._untaken:
            return list(range(number + 1))
    raise AssertionError


def overfill(there: Connection) -> None:
    """Send more than a pipe has room for, as several processes may."""
    stream = channel_of(there)._open()
    for number in range(1, 61):
        stream.send_request(HEAD.pack(Op.SEND, number), [memoryview(bytes(30_000))])
    while stream.receive().number < 60:
        pass


def is_full(sender: pipelined.PipelinedSender) -> bool:
    """Return whether a message waits because there is no room in the channel."""
    waits = bool(sender._untaken) and not sender._unconfirmed()
    return waits and not (sender._has_room and sender._has_credit(0))


def kill(there: Connection) -> None:
    """End its streams as the death of its process would."""
    for stream in channel_of(there)._streams:
        stream.close()
    there.close()


def test_messages_that_wait_for_room_outlive_their_killed_sender(one_way: Pipe) -> None:
    here, there = one_way
    numbers = fill(there)
    kill(there)
    assert [here.recv()[0] for _ in numbers] == numbers
    with pytest.raises(EOFError):
        here.recv()


def test_messages_that_nobody_can_read_are_dropped(one_way: Pipe, hosts: Hosts) -> None:
    here, there = one_way
    fill(there)
    kill(there)
    here.close()
    assert wait_until(lambda: objects_kept(hosts["a"]) == 0, PATIENCE)


def test_a_full_pipe_does_not_hide_that_its_other_end_was_killed(
    open_pipe: Pipe, hosts: Hosts
) -> None:
    here, there = open_pipe
    overfill(there)
    kill(there)
    assert wait_until(lambda: objects_kept(hosts["a"]) == 0, PATIENCE)
    with pytest.raises(BrokenPipeError):
        here.send("nobody reads it")
    assert here.recv_bytes() == bytes(30_000)


def test_a_closed_pipe_has_taken_all_messages(open_pipe: Pipe, wires: tuple[Wire, Wire]) -> None:
    here, there = open_pipe
    up, _ = wires
    up.hold()
    for number in range(10):
        there.send(number)
    closer = background(there.close)
    assert wait_until(lambda: there.closed, PATIENCE)
    assert not here.poll(0)
    up.let_go()
    closer.join(PATIENCE)
    assert [here.recv() for _ in range(10) if here.poll(0)] == list(range(10))


def test_to_close_does_not_wait_for_a_send_that_waits(open_pipe: Pipe) -> None:
    _, there = open_pipe
    errors: list[Exception] = []

    def send() -> None:
        try:
            while True:
                there.send(bytes(30_000))
        except OSError as error:
            errors.append(error)

    sender = channel_of(there)._pipelined[0]
    thread = background(send)
    assert wait_until(
        lambda: is_full(sender),
        PATIENCE,
    )
    there.close()
    thread.join(PATIENCE)
    assert len(errors) == 1


def send_for_ever(there: Connection) -> None:
    while True:
        there.send(bytes(30_000))


def test_to_close_does_not_wait_for_a_message_that_was_given_up(
    open_pipe: Pipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, there = open_pipe
    sender = channel_of(there)._pipelined[0]
    wait = sender._wait

    def wait_or_interrupt(seconds: float) -> None:
        if is_full(sender):
            raise KeyboardInterrupt
        wait(seconds)

    monkeypatch.setattr(sender, "_wait", wait_or_interrupt)
    with pytest.raises(KeyboardInterrupt):
        send_for_ever(there)
    monkeypatch.undo()
    there.close()
    assert not sender._untaken


def test_a_large_message_has_arrived_when_send_returns(open_pipe: Pipe) -> None:
    here, there = open_pipe
    there.send(bytes(pipelined.LARGE + 1))
    assert not unconfirmed
    assert here.recv() == bytes(pipelined.LARGE + 1)


def test_threads_that_send_together_keep_their_order(open_pipe: Pipe) -> None:
    here, there = open_pipe

    def send(thread: int) -> None:
        for number in range(200):
            there.send((thread, number))

    threads = [background(send, thread) for thread in range(4)]
    received = [here.recv() for _ in range(800)]
    for thread in threads:
        thread.join(PATIENCE)
    for index in range(4):
        assert [n for t, n in received if t == index] == list(range(200))


def test_an_interrupted_send_sends_once_or_not_at_all(open_pipe: Pipe) -> None:
    here, there = open_pipe
    files = {str(module.__file__) for module in (pipelined, client, remote, _unconfirmed)}
    for stop in itertools.count():
        interrupted = is_interrupted(partial(there.send, stop), stop, files, steps=CALLS)
        flush_all()
        there.send("next")
        received = here.recv()
        if received != "next":
            assert received == stop
            assert here.recv() == "next"
        if not interrupted:
            return


@pytest.mark.parametrize("kind", ["open_pipe", "one_way"])
@pytest.mark.parametrize("size", [1, 30_000])
def test_a_handler_on_top_of_a_send_may_send_and_flush(
    kind: str, size: int, far: Far, request: pytest.FixtureRequest
) -> None:
    here, there = request.getfixturevalue(kind)
    read, other = fiber.Pipe(duplex=False)
    elsewhere = far(other)
    elsewhere.send("first")
    files = {str(module.__file__) for module in (pipelined, client, remote, _unconfirmed)}

    def act() -> None:
        elsewhere.send("handler's")
        there.send(("handler's", bytes(size)))
        flush_all()

    def send() -> None:
        for number in range(3):
            there.send((number, bytes(size)))

    received: list[Any] = []

    def receive() -> None:
        with suppress(EOFError):
            while True:
                received.append(here.recv()[0])

    reader, other_reader = background(receive), background(drain, read)
    for stop in itertools.count():
        before = len(received)
        interrupted = is_interrupted(send, stop, files, steps=CALLS, by=act)
        flush_all()
        count = 3 + interrupted
        assert wait_until(lambda: len(received) == before + count, PATIENCE)  # noqa: B023
        assert [name for name in received[before:] if name != "handler's"] == [0, 1, 2]
        if not interrupted:
            break
    for end in (there, elsewhere, other):
        end.close()
    for thread in (reader, other_reader):
        thread.join(PATIENCE)


def drain(read: Connection) -> None:
    """Read until the end."""
    with suppress(EOFError):
        while True:
            read.recv()


def test_small_messages_of_other_threads_do_not_keep_a_large_one_waiting(one_way: Pipe) -> None:
    here, there = one_way
    has_sent = threading.Event()

    def send_small() -> None:
        while not has_sent.is_set():
            there.send(b"small")

    senders = [background(send_small) for _ in range(2)]
    reader = background(drain, here)
    for _ in range(10):
        there.send(bytes(pipelined.LARGE + 1))
    has_sent.set()
    for sender in senders:
        sender.join(PATIENCE)
    there.close()
    reader.join(PATIENCE)


def test_a_program_with_a_hub_of_its_own_waits_for_each_message(
    open_pipe: Pipe, hosts: Hosts
) -> None:
    here, there = open_pipe
    with hosts.at("b"):
        for number in range(10):
            there.send(number)
            assert here.poll(0)
            assert here.recv() == number


def test_an_unreachable_host_ends_the_wait(
    open_pipe: Pipe, wires: tuple[Wire, Wire], hosts: Hosts
) -> None:
    _, there = open_pipe
    up, _ = wires
    up.hold()
    there.send("lost")
    waiter = background(flush_all)
    hosts.on_loop(hosts["b"].unlink, "a", "agent a was lost: no heartbeat")
    waiter.join(PATIENCE)
    assert not unconfirmed
    with pytest.raises(BrokenPipeError, match="no heartbeat"):
        there.send("nor this")


def test_the_messages_of_an_ended_process_are_read_before_its_end_is_told(
    open_pipe: Pipe, wires: tuple[Wire, Wire], hosts: Hosts
) -> None:
    here, there = open_pipe
    loop_stands, has_ended, are_read = (threading.Event() for _ in range(3))

    def read() -> None:
        loop_stands.set()
        assert has_ended.wait(PATIENCE)
        hosts["b"].read_from_ended()
        are_read.set()

    assert not there.poll()  # by a stream that stays open
    hosts.on_loop(read)
    assert loop_stands.wait(PATIENCE)
    up, _ = wires
    before = up.frames
    for number in range(20):
        there.send(number)
    channel = channel_of(there)
    new = channel._open()  # the hub has not accepted it yet
    new.send_request(HEAD.pack(Op.SEND, 1), [memoryview(b"last")])
    new.close()
    channel._pipelined[0]._stream.close()
    assert up.frames == before
    has_ended.set()
    assert are_read.wait(PATIENCE)
    # Two streams end, and one begins and attaches to the channel.
    assert up.frames - before == 20 + 1 + 2 + 3
    assert {here.recv_bytes() for _ in range(21)} >= {b"last"}


@pytest.mark.parametrize("kind", ["open_pipe", "one_way"])
def test_lost_replies_give_no_credit(
    kind: str, request: pytest.FixtureRequest, hosts: Hosts
) -> None:
    here, there = request.getfixturevalue(kind)
    sender = channel_of(there)._pipelined[0]
    sent = []

    def send() -> None:
        for number in range(1000):
            there.send((number, bytes(3000)))
            sent.append(number)

    thread = background(send)
    for _ in range(5):
        assert wait_until(lambda: is_full(sender), PATIENCE)
        sender._has_lost_replies = True
        assert wait_until(lambda: not (sender._has_lost_replies or sender._syncs), PATIENCE)
    (shared,) = hosts["a"].registry._objects.values()
    assert isinstance(shared.hosted, HostedChannel)
    assert len(shared.hosted._senders) <= pipelined.CREDIT / 3000
    for number in range(1000):
        assert here.recv()[0] == number
    thread.join(PATIENCE)


def test_a_message_that_the_hub_cannot_send_is_its_senders_error_alone(
    child: None, far: Far, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, writer = fiber.Pipe(duplex=False)
    there, other = far(writer), far(writer)
    there.send("first")
    other.send("first")
    send_now = SendingEnd._send_now

    def send_unless_large(end: SendingEnd, payload: bytes, buffers: Any) -> bool | None:
        if len(payload) > 1000:
            raise OSError(errno.EMFILE, "no descriptor is free")
        return send_now(end, payload, buffers)

    monkeypatch.setattr(SendingEnd, "_send_now", send_unless_large)
    there.send(bytes(2000))
    other.send("second")
    flush_all()
    assert [here.recv() for _ in range(3)] == ["first", "first", "second"]
    with pytest.raises(BrokenPipeError, match="no descriptor is free"):
        there.send("nor this")
    other.send("third")
    assert here.recv() == "third"
    for end in (here, writer, there, other):
        end.close()


def test_a_message_to_something_else_than_a_channel_is_refused(far: Far, hosts: Hosts) -> None:
    lock = far(fiber.Lock())
    stream = lock._semlock._open()
    stream.send_request(HEAD.pack(Op.SEND, 1), [memoryview(b"message")])
    with pytest.raises(client.ObjectUnreachable, match="not attached to a channel"):
        stream.receive()
    del lock, stream
    gc.collect()
    assert wait_until(lambda: objects_kept(hosts["a"]) == 0, PATIENCE)


def test_the_loop_thread_does_not_wait_for_credit(one_way: Pipe, hosts: Hosts) -> None:
    here, there = one_way
    numbers = fill(there)
    sender = channel_of(there)._pipelined[0]
    while sender._has_credit(0):
        there.send(bytes(30_000))
        numbers.append(0)
    errors: list[Exception] = []

    def send() -> None:
        try:
            there.send("from the loop")
        except RuntimeError as error:
            errors.append(error)

    with hosts.at("b"):
        hosts.on_loop(send)
        assert wait_until(lambda: bool(errors), PATIENCE)
    assert [here.recv()[0] for _ in numbers] == numbers


class Exhausted:
    """Listener of a process that has no free descriptor, for the next two calls."""

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self._calls = 0
        self.fileno = listener.fileno

    def accept(self) -> Any:
        self._calls += 1
        if self._calls <= 2:
            raise OSError(errno.EMFILE, "no descriptor is free")
        return self._listener.accept()


def test_a_hub_without_free_descriptors_listens_again_once(
    open_pipe: Pipe, hosts: Hosts, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = hosts["b"]
    _, listener = hub._opened[0]
    assert listener is not None
    again: list[object] = []
    monkeypatch.setattr(hub, "_listen_again", again.append)
    exhausted: Any = Exhausted(listener)
    for _ in range(2):  # as two children may end in the same moment
        hosts.on_loop(hub._accept_socket, exhausted)
    assert wait_until(lambda: bool(again), PATIENCE)
    monkeypatch.undo()
    hosts.on_loop(hub._listen_again, exhausted)
    _, there = open_pipe
    stream = channel_of(there)._open()  # it waits until the hub listens
    stream.send_request(ONE.pack(Op.SYNC, 1, 0))
    assert stream.receive().number == 1
    assert again == [exhausted]
