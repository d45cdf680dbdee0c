"""Objects of another host: what can be done with them.

Host ``a`` has the objects; this process is on host ``b``.
"""

from __future__ import annotations

import os
import pickle
import threading
from typing import Any

import numpy as np
import pytest

import fiber
from census import wait_until
from fiber._hub.client import HubStream, ObjectUnreachable
from fiber._hub.handles import collecting_grants
from fiber._hub.local import LocalChannel, LocalCounter
from fiber._hub.pipelined import PipelinedSender
from fiber._hub.remote import RemoteCounter
from fiber._hub.streams import WINDOW
from fiber._transport.channels import wait_readable
from fiber._wire import packet
from fiber.connection import Connection, wait
from fiber.errors import ConnectionClosed
from hosts import Far, Hosts, Wire, background, objects_kept
from patience import PATIENCE

# Channels


def test_an_unconfirmed_message_keeps_its_place(far_pipe: tuple[Connection, Connection]) -> None:
    here, there = far_pipe
    there.send("first")
    there.send("second")
    there.send(np.zeros(3 * WINDOW, np.uint8))
    sender = background(there.send, "last")
    assert [here.recv() for _ in range(2)] == ["first", "second"]
    assert here.recv().nbytes == 3 * WINDOW
    assert here.recv() == "last"
    sender.join()


def send_for_ever(there: Connection) -> None:
    while True:
        there.send("nobody reads it")


def test_a_send_after_the_end_of_the_other_side_fails(
    far_pipe: tuple[Connection, Connection],
) -> None:
    here, there = far_pipe
    there.send("read")
    assert here.recv() == "read"
    here.close()
    with pytest.raises(BrokenPipeError):
        send_for_ever(there)
    with pytest.raises(BrokenPipeError):
        there.send("nor this")


def test_the_first_send_tells_that_nobody_is_there(
    far_pipe: tuple[Connection, Connection],
) -> None:
    here, there = far_pipe
    here.close()
    with pytest.raises(BrokenPipeError):
        there.send("nobody reads it")


def test_an_interrupted_send_loses_no_message(
    far_pipe: tuple[Connection, Connection], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*arguments: Any) -> None:
        transmit(*arguments)
        raise KeyboardInterrupt

    here, there = far_pipe
    transmit = PipelinedSender._transmit
    with monkeypatch.context() as ctrl_c:
        ctrl_c.setattr(PipelinedSender, "_transmit", interrupted)
        with pytest.raises(KeyboardInterrupt):
            there.send(1)
    there.send(2)
    assert [here.recv() for _ in range(2)] == [1, 2]


def exchange_on_thread(there: Connection, payload: bytes, results: list[Any]) -> threading.Thread:
    """Begin an exchange, whose message or error goes to ``results``."""

    def exchange() -> None:
        try:
            results.append(there._channel.exchange(payload).tobytes())  # type: ignore[union-attr]
        except (OSError, EOFError) as error:
            results.append(type(error))

    return background(exchange)


def test_an_exchange_is_one_request(
    far_pipe: tuple[Connection, Connection], wires: tuple[Wire, Wire]
) -> None:
    here, there = far_pipe
    assert not there.poll()  # from here on the stream is open
    up, down = wires
    before = up.frames, down.frames
    results: list[Any] = []
    thread = exchange_on_thread(there, b"question", results)
    assert here.recv_bytes() == b"question"
    here.send_bytes(b"answer")
    thread.join(PATIENCE)
    assert results == [b"answer"]
    assert (up.frames - before[0], down.frames - before[1]) == (1, 1)


def test_an_exchange_waits_for_room_and_for_the_answer(
    far_pipe: tuple[Connection, Connection],
) -> None:
    here, there = far_pipe
    payload = bytes(30_000)
    results: list[Any] = []
    # Together they are more than the socket has room for.
    threads = [exchange_on_thread(there, payload, results) for _ in range(50)]
    for _ in threads:
        assert here.recv_bytes() == payload
    answers = [b"%d" % number for number in range(len(threads))]
    for answer in answers:
        here.send_bytes(answer)
    for thread in threads:
        thread.join(PATIENCE)
    assert sorted(results) == sorted(answers)


@pytest.mark.parametrize("reads", [True, False])
def test_an_exchange_ends_with_the_other_end(
    far_pipe: tuple[Connection, Connection], reads: bool
) -> None:
    here, there = far_pipe
    results: list[Any] = []
    if reads:
        thread = exchange_on_thread(there, b"question", results)
        assert here.recv_bytes() == b"question"
        here.close()
    else:
        here.close()
        thread = exchange_on_thread(there, b"question", results)
    thread.join(PATIENCE)
    assert results == [ConnectionClosed if reads else BrokenPipeError]


def test_an_interrupted_exchange_loses_no_message(
    far_pipe: tuple[Connection, Connection], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(stream: HubStream, *_: Any) -> None:
        assert wait_readable(stream.fileno(), PATIENCE)
        raise KeyboardInterrupt

    here, there = far_pipe
    channel = there._channel
    assert channel is not None
    here.send_bytes(b"1")
    with monkeypatch.context() as ctrl_c:
        ctrl_c.setattr(HubStream, "_reply", interrupted)
        with pytest.raises(KeyboardInterrupt):
            channel.exchange(b"a")
    here.send_bytes(b"2")
    assert channel.exchange(b"b").tobytes() == b"1"
    assert channel.exchange(b"c").tobytes() == b"2"
    assert [here.recv_bytes() for _ in range(3)] == [b"a", b"b", b"c"]


def test_an_exchange_does_not_overtake_an_unconfirmed_message(
    far_pipe: tuple[Connection, Connection],
) -> None:
    here, there = far_pipe
    assert there._channel is not None
    here.send_bytes(b"answer")
    there._channel.send(b"1")
    assert there._channel.exchange(b"2").tobytes() == b"answer"
    assert [here.recv_bytes() for _ in range(2)] == [b"1", b"2"]


def test_large_exchanges_keep_their_order(
    far_pipe: tuple[Connection, Connection],
) -> None:
    here, there = far_pipe
    there.send("before")
    got: list[Any] = []

    def exchange() -> None:
        for _ in range(2):
            got.append(packet.loads(there._exchange(np.ones(3 * WINDOW, np.uint8))()).nbytes)

    exchanger = background(exchange)
    assert here.recv() == "before"
    for _ in range(2):
        assert here.recv().nbytes == 3 * WINDOW
        here.send(np.ones(2 * WINDOW, np.uint8))
    exchanger.join(PATIENCE)
    assert got == [2 * WINDOW] * 2


def test_an_exchange_that_cannot_be_pickled_sends_nothing(
    far_pipe: tuple[Connection, Connection],
) -> None:
    here, there = far_pipe
    with pytest.raises(TypeError):
        there._exchange(threading.Lock())
    assert not here.poll()
    here.send(1)
    assert there.recv() == 1


@pytest.mark.parametrize("late", [True, False], ids=["late", "lost"])
def test_an_interrupted_exchange_keeps_the_order(
    far_pipe: tuple[Connection, Connection], monkeypatch: pytest.MonkeyPatch, late: bool
) -> None:
    def interrupted(*arguments: Any) -> None:
        if not late:  # the reply is read, and lost
            reply(*arguments)
        raise KeyboardInterrupt

    here, there = far_pipe
    reply = HubStream._reply
    for number in range(2):
        here.send(number)
    with monkeypatch.context() as ctrl_c:
        ctrl_c.setattr(HubStream, "_reply", interrupted)
        with pytest.raises(KeyboardInterrupt):
            there._exchange("a")()
    assert here.recv() == "a"
    assert packet.loads(there._exchange("b")()) == (0 if late else 1)
    assert here.recv() == "b"


def test_threads_that_wait_do_not_wait_for_each_other(far: Far) -> None:
    here, there = fiber.Pipe()
    remote = far(there)
    got: list[Any] = []
    threads = [background(lambda: got.append(remote.recv())) for _ in range(3)]
    remote.send("sent while three receive")
    assert here.recv() == "sent while three receive"
    for number in range(3):
        here.send(number)
    for thread in threads:
        thread.join(PATIENCE)
    assert sorted(got) == [0, 1, 2]
    remote.close()


def test_an_object_comes_home_as_itself(hosts: Hosts, far: Far) -> None:
    _, there = fiber.Pipe()
    remote = far(there)
    data = pickle.dumps(remote)
    remote.close()
    with hosts.at("a"):
        home = pickle.loads(data)
    assert isinstance(home._channel, LocalChannel)
    assert os.fstat(home.fileno()).st_ino == os.fstat(there.fileno()).st_ino
    assert wait_until(lambda: objects_kept(hosts["a"]) == 0, PATIENCE)


def test_collected_handles_of_far_objects_outlive_them(hosts: Hosts, far: Far) -> None:
    here, there = fiber.Pipe()
    remote = far(there)
    there.close()
    with collecting_grants() as collected:
        data = pickle.dumps(remote)
    remote.close()
    for _ in range(2):
        again = pickle.loads(data)
        again.send(1)
        assert here.recv() == 1
        again.close()
    assert not here.poll()
    collected.release()
    assert here.poll(PATIENCE)
    with pytest.raises(EOFError):
        here.recv()


def test_a_forgotten_unused_handle_holds_no_object(hosts: Hosts, far: Far) -> None:
    _, there = fiber.Pipe()
    remote = far(there)
    del remote
    assert wait_until(lambda: objects_kept(hosts["a"]) == 0, PATIENCE)


def test_a_handle_used_twice_says_so(hosts: Hosts, far: Far) -> None:
    here, there = fiber.Pipe()
    with hosts.at("a"):
        data = pickle.dumps(there)
    pickle.loads(data).close()
    assert wait_until(lambda: objects_kept(hosts["a"]) == 0, PATIENCE)
    late = pickle.loads(data)
    with pytest.raises(ObjectUnreachable, match="used once already"):
        late.poll()
    with pytest.raises(BrokenPipeError, match="used once already"):
        late.send(1)
    late.close()
    here.close()


# Waiting for several


def test_wait_mixes_near_and_far(far: Far) -> None:
    pipes = [fiber.Pipe() for _ in range(4)]
    readers = [far(reader) if n % 2 else reader for n, (reader, _) in enumerate(pipes)]
    for number, (_, writer) in enumerate(pipes):
        writer.send(number)
    got: set[int] = set()
    while len(got) < 4:
        got |= {reader.recv() for reader in wait(readers, PATIENCE)}
    assert got == {0, 1, 2, 3}
    for reader in readers:
        reader.close()


def test_a_message_for_another_receiver_is_not_announced(far: Far) -> None:
    here, there = fiber.Pipe()
    remote = far(there)
    assert wait([remote], 0) == []
    here.send(1)
    assert wait([remote], PATIENCE) == [remote]
    assert there.recv() == 1
    assert wait([remote], 0) == []
    here.send(2)
    assert wait([remote], PATIENCE) == [remote]
    remote.close()


# Counters


def test_a_counter_of_another_host_works_like_a_local_one(far: Far) -> None:
    counter = LocalCounter.create(2)
    remote = far(counter)
    assert isinstance(remote, RemoteCounter)
    assert remote.value() == 2
    assert remote.take(None)
    assert remote.take(0)
    assert not remote.take(0)
    assert not remote.take(0.01)
    assert not remote.wait(0)
    remote.add(5)
    assert counter.value() == 5
    assert remote.wait(None)
    assert remote.clear() == 5
    assert remote.value() == 0
    waiting = background(remote.take, None)
    counter.add(1)
    waiting.join(PATIENCE)
    assert counter.value() == 0
    remote.close()


def test_changes_are_seen_from_afar_by_all(far: Far) -> None:
    counter = LocalCounter.create(7)
    remote = far(counter)
    assert not remote.changed(7, 0.01)
    assert remote.changed(6, 0.01)
    waiting = [background(remote.changed, 7, None) for _ in range(3)]
    counter.add(1)
    for thread in waiting:
        thread.join(PATIENCE)
        assert not thread.is_alive()
    remote.close()
