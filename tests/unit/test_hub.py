"""The hub among processes of one host: who gets in, who gets what, and for how long."""

from __future__ import annotations

import os
import pickle
import socket
import stat
import threading
from functools import partial
from pathlib import Path
from typing import Any, cast

import pytest

import fiber
from census import wait_until
from fiber._hub import client, handles, protocol
from fiber._hub.client import HubStream, NoHub, ObjectUnreachable
from fiber._hub.handles import collecting_grants
from fiber._hub.protocol import NO_SECRET, SECRET, HubAddress, Op
from fiber._wire import packet
from fiber.connection import Connection
from fiber.queues import JoinableQueue, Queue, SimpleQueue
from hosts import Hosts, objects_kept
from patience import PATIENCE


def inode(connection: Connection) -> int:
    return os.fstat(connection.fileno()).st_ino


# Grants


def test_a_handle_leads_to_the_very_same_pipe(hosts: Hosts) -> None:
    with hosts.at("a"):
        here, there = fiber.Pipe()
        again = pickle.loads(pickle.dumps(there))
        assert inode(again) == inode(there)
        here.send("hello")
        assert again.recv() == "hello"


def test_a_handle_works_once(hosts: Hosts) -> None:
    with hosts.at("a") as hub:
        _, end = fiber.Pipe()
        data = pickle.dumps(end)
        assert objects_kept(hub) == 1
        pickle.loads(data)
        assert objects_kept(hub) == 0
        with pytest.raises(ObjectUnreachable, match="used once already"):
            pickle.loads(data)


def test_collected_handles_work_until_released(hosts: Hosts) -> None:
    with hosts.at("a") as hub:
        _, end = fiber.Pipe()
        with collecting_grants() as collected:
            data = pickle.dumps([end, end])
        assert collected
        for _ in range(3):
            assert len(pickle.loads(data)) == 2
        collected.release()
        collected.release()
        assert not collected
        assert objects_kept(hub) == 0
        with pytest.raises(ObjectUnreachable):
            pickle.loads(data)


def test_collected_grants_end_with_the_set(hosts: Hosts) -> None:
    with hosts.at("a") as hub:
        _, end = fiber.Pipe()
        with collecting_grants() as collected:
            pickle.dumps(end)
        assert objects_kept(hub) == 1
        del collected
        assert wait_until(lambda: objects_kept(hub) == 0, PATIENCE)


def test_grants_of_a_failed_pickling_are_released(hosts: Hosts) -> None:
    with hosts.at("a") as hub:
        _, end = fiber.Pipe()
        with pytest.raises(TypeError, match="pickle"), collecting_grants() as collected:
            pickle.dumps([end, threading.Lock()])
        assert not collected
        assert objects_kept(hub) == 0


def test_an_empty_collection_releases_no_grants(hosts: Hosts) -> None:
    with hosts.at("a"), collecting_grants() as collected:
        pickle.dumps([1, 2, 3])
    assert not collected


def test_a_pickling_that_was_interrupted_before_its_block_is_forgotten(hosts: Hosts) -> None:
    handles.Pickling(reusable=True).__enter__()
    with hosts.at("a") as hub:
        one, other = fiber.Pipe()
        data = pickle.dumps(other)
        other.close()
        pickle.loads(data).close()
        assert objects_kept(hub) == 0, "the handle worked once"
        one.close()


def test_a_pickling_that_failed_leaves_no_grant(hosts: Hosts) -> None:
    with hosts.at("a") as hub:
        one, other = fiber.Pipe()
        kept = pickle.dumps(one)
        with pytest.raises(Exception, match="pickle"), handles.Pickling():
            pickle.dumps([other, threading.Lock()])
        assert objects_kept(hub) == 1
        pickle.loads(kept)


def test_an_object_keeps_its_descriptors_when_it_is_shared_again(hosts: Hosts) -> None:
    with hosts.at("a") as hub, collecting_grants() as collected:
        queue: Queue[int] = fiber.Queue()
        assert hub.address  # its socket takes one
        before = len(os.listdir("/proc/self/fd"))
        for _ in range(50):
            pickle.dumps(queue)
        assert objects_kept(hub) == 3
        # One for the count of items, and for each end one for the socket and one for the backlog.
        assert len(os.listdir("/proc/self/fd")) == before + 5
        collected.release()


def test_the_other_end_sees_the_end_once_no_grant_is_left(hosts: Hosts) -> None:
    with hosts.at("a"):
        here, there = fiber.Pipe()
        with collecting_grants() as collected:
            pickle.dumps(there)
        there.close()
        assert not here.poll(0)
        collected.release()
        assert here.poll(PATIENCE)
        with pytest.raises(EOFError):
            here.recv()


def test_everything_shared_travels(hosts: Hosts) -> None:
    with hosts.at("a"):
        queue: Queue[int] = fiber.Queue(7)
        joinable: JoinableQueue[int] = fiber.JoinableQueue()
        simple: SimpleQueue[int] = fiber.SimpleQueue()
        event, semaphore, bounded = fiber.Event(), fiber.Semaphore(3), fiber.BoundedSemaphore(2)
        things = [queue, joinable, simple, event, semaphore, bounded]
        copies: list[Any] = pickle.loads(pickle.dumps(things))
        for thing in (queue, joinable, simple):
            thing.put(1)
        event.set()
        semaphore.acquire()
        assert [copy.get() for copy in copies[:3]] == [1, 1, 1]
        copies[1].task_done()
        joinable.join()
        assert copies[0].qsize() == 0
        assert copies[3].is_set()
        assert copies[4].get_value() == 2
        assert repr(copies[5]) == "<BoundedSemaphore(value=2, maxvalue=2)>"


def test_without_a_hub_the_error_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_local_hub", "_address", "_starter"):
        monkeypatch.setattr(client, name, None)
    queue: SimpleQueue[int] = fiber.SimpleQueue()
    for shared in (fiber.Pipe()[1], queue):
        with pytest.raises(NoHub, match=r"queue, lock or other .* Start a process or pool first"):
            pickle.dumps(shared)


def test_a_program_without_a_hub_makes_one(hosts: Hosts, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "_local_hub", None)
    monkeypatch.setattr(client, "_address", None)
    monkeypatch.setattr(client, "_starter", lambda: client.set_local_hub(hosts["a"]))
    _, end = fiber.Pipe()
    pickle.loads(pickle.dumps(end))


# The socket


def test_the_socket_is_private_and_goes_with_the_hub(hosts: Hosts) -> None:
    hub = hosts["a"]
    unopened = hub.directory
    address = hub.address.path
    assert unopened is None
    assert hub.directory is not None
    assert hub.address == hub.address
    assert stat.S_IMODE(os.stat(hub.directory).st_mode) == 0o700
    assert address.startswith(hub.directory)
    hosts.on_loop(hub.close)
    directory = hub.directory
    assert wait_until(lambda: not os.path.exists(directory), PATIENCE)


def test_a_path_that_is_too_long_names_the_setting(tmp_path: Path, hosts: Hosts) -> None:
    from fiber._hub.hub import Hub

    deep = tmp_path / ("d" * 100)
    deep.mkdir()
    hub = Hub(hosts.loop, "a", str(deep))
    with pytest.raises(OSError, match="FIBER_RUNTIME_DIRECTORY"):
        _ = hub.address
    assert list(deep.iterdir()) == []
    hosts.on_loop(hub.close)


def test_the_key_is_not_shown(hosts: Hosts) -> None:
    own = hosts["a"].address
    assert own.key.hex() not in repr(own)
    assert repr(own.key) not in repr(own)


class Bomb:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize(
    "greeting",
    [
        b"\0",
        b"nonsense",
        b"\1\xff",
        b"\2" + bytes(20),
        packet.PLAIN + protocol.hello(bytes(32)),
        packet.PLAIN + protocol.hello(bytes(32))[:-1],
        packet.PLAIN + SECRET.pack(Op.FETCH, 1, NO_SECRET),
    ],
)
def test_a_stranger_is_shown_out(hosts: Hosts, greeting: bytes) -> None:
    hub = hosts["a"]
    with hosts.at("a"):
        _, end = fiber.Pipe()
        pickle.dumps(end)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stranger:
        stranger.settimeout(PATIENCE)
        stranger.connect(hub.address.path)
        stranger.send(greeting)
        try:
            packet.send(stranger, SECRET.pack(Op.FETCH, 1, NO_SECRET))
        except OSError:
            pass  # it was shown out already
        said = []
        try:
            while part := stranger.recv(4096):
                said.append(part)
        except ConnectionResetError:
            pass
        assert all(part[1] == protocol.Status.GONE for part in said)
    assert objects_kept(hub) == 1


def test_bytes_of_a_stranger_are_not_unpickled(hosts: Hosts, tmp_path: Path) -> None:
    hub = hosts["a"]
    mark = tmp_path / "unpickled"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stranger:
        stranger.connect(hub.address.path)
        packet.send(stranger, pickle.dumps(Bomb(mark)))
        assert stranger.recv(4096)[1] == protocol.Status.GONE
    assert not mark.exists()


def test_a_wrong_key_is_refused_with_a_reason(hosts: Hosts) -> None:
    own = hosts["a"].address
    with hosts.child_at("a"):
        stream = HubStream(HubAddress("a", own.path, bytes(32)))
        with pytest.raises(ObjectUnreachable, match="another program"):
            stream.ask(Op.FETCH, NO_SECRET, form=SECRET)
        stream.close()


def test_another_version_is_refused_by_name(hosts: Hosts) -> None:
    own = hosts["a"].address
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as other:
        other.connect(own.path)
        packet.send(other, protocol.HELLO.pack(Op.HELLO, 0, protocol.VERSION + 1, own.key))
        assert b"install the same fiberpool" in other.recv(4096)


def test_a_hub_that_is_gone_is_named(hosts: Hosts) -> None:
    with hosts.child_at("a") as hub:
        _, end = fiber.Pipe()
        data = pickle.dumps(end)
        hosts.on_loop(hub.close)
        assert hub.directory is not None
        directory = hub.directory
        assert wait_until(lambda: not os.path.exists(directory), PATIENCE)
        with pytest.raises(ObjectUnreachable, match="host 'a'"):
            pickle.loads(data)


def test_a_hub_without_descriptors_lets_callers_wait(
    hosts: Hosts, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = hosts["a"]
    own = hub.address
    listening = hub._opened[0][1]
    assert listening is not None
    real: socket.socket = listening
    refusals: list[int] = []

    class Exhausted:
        def accept(self) -> Any:
            refusals.append(1)
            if len(refusals) <= 2:
                raise OSError(24, "Too many open files")
            return real.accept()

        def fileno(self) -> int:
            return real.fileno()

    accept = partial(hub._accept_socket, cast(socket.socket, Exhausted()))
    monkeypatch.setitem(hosts.loop._readers, real.fileno(), accept)
    with hosts.child_at("a"):
        _, end = fiber.Pipe()
        pickle.loads(pickle.dumps(end))
    assert len(refusals) >= 3
    assert own == hub.address


# Children


def test_a_child_takes_back_its_collected_grants(hosts: Hosts) -> None:
    with hosts.child_at("a") as hub:
        _, end = fiber.Pipe()
        with collecting_grants() as collected:
            data = pickle.dumps(end)
        pickle.loads(data)
        assert objects_kept(hub) == 1
        collected.release()
        assert wait_until(lambda: objects_kept(hub) == 0, PATIENCE)


def test_a_child_takes_back_grants_of_a_failed_pickling(hosts: Hosts) -> None:
    with hosts.child_at("a") as hub:
        _, end = fiber.Pipe()
        with pytest.raises(Exception, match="pickle"), handles.Pickling():
            pickle.dumps([end, threading.Lock()])
        assert wait_until(lambda: objects_kept(hub) == 0, PATIENCE)
