"""Objects of another host: what can be done with them.

Host ``a`` has the objects; this process is on host ``b``.
"""

from __future__ import annotations

import os
import pickle
import select
from multiprocessing.connection import wait
from queue import Empty, Full
from typing import Any

import numpy as np
import pytest

import fiber
from census import wait_until
from fiber._hub.client import HubStream, ObjectUnreachable
from fiber._hub.handles import collecting_grants
from fiber._hub.local import LocalChannel, LocalCounter
from fiber._hub.remote import RemoteChannel, RemoteCounter
from fiber._hub.streams import WINDOW
from fiber.connection import Connection
from fiber.errors import ConnectionClosed
from hosts import Far, Hosts, background, objects_kept
from patience import PATIENCE

# Channels


def test_messages_go_both_ways(far_pipe: tuple[Connection, Connection]) -> None:
    here, there = far_pipe
    assert isinstance(there._channel, RemoteChannel)
    there.send({"to": ["home"]})
    assert here.recv() == {"to": ["home"]}
    here.send("away")
    assert there.recv() == "away"
    there.send_bytes(b"")
    assert here.recv_bytes() == b""
    here.send_bytes(b"")
    assert there.recv_bytes() == b""


def test_boundaries_are_kept(far_pipe: tuple[Connection, Connection]) -> None:
    here, there = far_pipe
    sizes = [0, 1, 70_000, 5, 131_071, 131_072, 131_073, 3]
    for size in sizes:
        there.send_bytes(bytes(size))
        assert here.recv_bytes() == bytes(size)
    sender = background(lambda: [here.send_bytes(bytes(size)) for size in sizes])
    assert [len(there.recv_bytes()) for _ in sizes] == sizes
    sender.join()


def test_large_messages_and_arrays_pass(far_pipe: tuple[Connection, Connection]) -> None:
    here, there = far_pipe
    item = {"text": "x" * 5_000_000, "arrays": [np.arange(500_000), np.zeros(0), np.ones(9_000)]}
    for source, sink in ((here, there), (there, here)):
        sender = background(source.send, item)
        got = sink.recv()
        sender.join()
        assert got["text"] == item["text"]
        for array, copy in zip(item["arrays"], got["arrays"], strict=True):
            assert (array == copy).all()
            assert copy.flags.writeable


def test_an_unconfirmed_message_keeps_its_place(far_pipe: tuple[Connection, Connection]) -> None:
    here, there = far_pipe
    there.send("first")
    there._send_unconfirmed("second")
    there._send_unconfirmed(np.zeros(3 * WINDOW, np.uint8))
    sender = background(there.send, "last")
    assert [here.recv() for _ in range(2)] == ["first", "second"]
    assert here.recv().nbytes == 3 * WINDOW
    assert here.recv() == "last"
    sender.join()


def test_the_next_send_reports_the_loss_of_an_unconfirmed_message(
    far_pipe: tuple[Connection, Connection],
) -> None:
    here, there = far_pipe
    here.close()
    for _ in range(2):
        there._send_unconfirmed("nobody reads it")
        with pytest.raises(BrokenPipeError):
            there._send_unconfirmed("nor this")


def test_an_interrupted_confirmation_is_not_waited_for_again(
    far_pipe: tuple[Connection, Connection], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*arguments: Any) -> None:
        reply(*arguments)
        raise KeyboardInterrupt

    here, there = far_pipe
    reply = HubStream._reply
    there._send_unconfirmed(1)
    with monkeypatch.context() as ctrl_c:
        ctrl_c.setattr(HubStream, "_reply", interrupted)
        with pytest.raises(KeyboardInterrupt):
            there._send_unconfirmed(2)
    there._send_unconfirmed(3)
    there.send(4)
    assert [here.recv() for _ in range(3)] == [1, 3, 4]


def test_poll_of_a_remote_connection_reports_a_message(
    far_pipe: tuple[Connection, Connection],
) -> None:
    here, there = far_pipe
    assert not there.poll()
    assert not there.poll(0.01)
    assert not there.poll(-1)
    here.send(1)
    assert there.poll()
    assert there.poll(None)
    assert there.recv() == 1
    assert not there.poll()
    here.close()
    assert there.poll()
    with pytest.raises(EOFError):
        there.recv()


def test_a_pipe_in_one_direction_stays_so_on_another_host(far: Far) -> None:
    reader, writer = fiber.Pipe(duplex=False)
    far_writer = far(writer)
    with pytest.raises(OSError, match="write-only"):
        far_writer.recv()
    far_writer.send(1)
    assert reader.recv() == 1


def test_the_end_comes_when_the_far_holder_closes(far_pipe: tuple[Connection, Connection]) -> None:
    here, there = far_pipe
    there.send("last words")
    there.close()
    assert here.recv() == "last words"
    with pytest.raises(EOFError):
        here.recv()
    with pytest.raises(OSError, match="handle is closed"):
        there.recv()


def test_sending_without_a_receiver_fails(far_pipe: tuple[Connection, Connection]) -> None:
    here, there = far_pipe
    here.close()
    with pytest.raises(BrokenPipeError):
        there.send(1)


def test_a_blocked_receiver_gets_the_end(far_pipe: tuple[Connection, Connection]) -> None:
    here, there = far_pipe
    ends: list[type[BaseException]] = []

    def receive() -> None:
        try:
            there.recv()
        except EOFError as error:
            ends.append(type(error))

    thread = background(receive)
    here.close()
    thread.join(PATIENCE)
    assert ends == [ConnectionClosed]


def test_a_full_pipe_makes_the_sender_wait(far_pipe: tuple[Connection, Connection]) -> None:
    here, there = far_pipe
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


def test_wait_is_right_before_and_after_receiving(far_pipe: tuple[Connection, Connection]) -> None:
    here, there = far_pipe
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


def test_wait_mixes_near_and_far(far: Far) -> None:
    pipes = [fiber.Pipe() for _ in range(4)]
    readers = [far(reader) if n % 2 else reader for n, (reader, _) in enumerate(pipes)]
    for number, (_, writer) in enumerate(pipes):
        writer.send(number)
    got = set()
    while len(got) < 4:
        got |= {reader.recv() for reader in wait(readers, PATIENCE)}
    assert got == {0, 1, 2, 3}
    for reader in readers:
        reader.close()


def test_a_kept_descriptor_stays_right(far_pipe: tuple[Connection, Connection]) -> None:
    here, there = far_pipe
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


def test_an_event_and_a_semaphore_from_afar(far: Far) -> None:
    event, semaphore = fiber.Event(), fiber.BoundedSemaphore(1)
    far_event, far_semaphore = far([event, semaphore])
    assert not far_event.wait(0.01)
    waiting = background(far_event.wait, PATIENCE)
    event.set()
    waiting.join(PATIENCE)
    assert far_event.is_set()
    far_event.clear()
    assert not event.is_set()
    with far_semaphore:
        assert not semaphore.acquire(False)
    with pytest.raises(ValueError, match="too many times"):
        far_semaphore.release()


# Queues


def test_a_queue_from_afar(far: Far) -> None:
    queue: Any = fiber.Queue(3)
    remote: Any = far(queue)
    for number in range(3):
        remote.put(number)
    assert remote.full()
    assert remote.qsize() == queue.qsize() == 3
    with pytest.raises(Full):
        remote.put(3, timeout=0.01)
    with pytest.raises(Full):
        remote.put_nowait(3)
    assert queue.get(timeout=PATIENCE) == 0
    assert [remote.get(), remote.get(timeout=PATIENCE)] == [1, 2]
    assert remote.empty()
    with pytest.raises(Empty):
        remote.get(timeout=0.01)
    with pytest.raises(Empty):
        remote.get_nowait()
    queue.put("home")
    assert wait([remote._reader], PATIENCE) == [remote._reader]
    assert remote.get_nowait() == "home"
    remote.put("away")
    remote.close()
    remote.join_thread()
    assert queue.get(timeout=PATIENCE) == "away"


def test_a_joinable_queue_from_afar(far: Far) -> None:
    queue: Any = fiber.JoinableQueue()
    remote: Any = far(queue)
    queue.put(1)
    joiners = [background(queue.join), background(remote.join)]
    assert remote.get() == 1
    assert all(joiner.is_alive() for joiner in joiners)
    remote.task_done()
    for joiner in joiners:
        joiner.join(PATIENCE)
    with pytest.raises(ValueError, match="too many times"):
        remote.task_done()
    remote.close()
