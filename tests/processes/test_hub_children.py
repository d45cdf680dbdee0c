"""Children that use objects of their own host and of another, and children that die with them."""

from __future__ import annotations

import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import fiber
from census import wait_until
from fiber._hub import client
from fiber._hub.handles import collecting_grants
from fiber._hub.protocol import HubAddress
from fiber.connection import Connection
from hosts import Far, Hosts, Wire, objects_kept
from patience import PATIENCE


def start(target: Callable[..., Any], *args: Any) -> fiber.Process:
    process = fiber.Process(target=target, args=args, daemon=True)
    process.start()
    return process


def in_a_child(own: HubAddress, commands: Connection) -> None:
    """Lends and borrows as told, in a process that reaches the hub by its socket."""
    client.set_hub_address(own)
    for command in iter(commands.recv, None):
        if command == "lend":
            here, there = fiber.Pipe()
            commands.send_bytes(pickle.dumps(there))
            there.close()
            here.send("from the child")
        elif command == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        else:
            borrowed = pickle.loads(command)
            borrowed.send(borrowed.recv() * 2)
            borrowed.close()


@pytest.fixture
def child(hosts: Hosts) -> Iterator[Connection]:
    ours, theirs = fiber.Pipe()
    process = start(in_a_child, hosts["a"].address, theirs)
    theirs.close()
    yield ours
    ours.close()
    process.kill()
    process.join()


def test_a_child_borrows(hosts: Hosts, child: Connection) -> None:
    with hosts.at("a") as hub:
        here, there = fiber.Pipe()
        child.send(pickle.dumps(there))
        there.close()
        here.send("ab")
        assert here.recv() == "abab"
        with pytest.raises(EOFError):
            here.recv()
        assert objects_kept(hub) == 0


def test_objects_that_a_child_shares_outlive_it(hosts: Hosts, child: Connection) -> None:
    with hosts.at("a"):
        child.send("lend")
        data = child.recv_bytes()
        child.send("die")
        with pytest.raises(EOFError):
            child.recv()
        borrowed = pickle.loads(data)
        assert borrowed.recv() == "from the child"
        with pytest.raises(EOFError):
            borrowed.recv()


def test_children_of_a_host_share_objects_without_the_hub(hosts: Hosts, child: Connection) -> None:
    with hosts.child_at("a"):
        child.send("lend")
        borrowed = pickle.loads(child.recv_bytes())
        assert borrowed.recv() == "from the child"


def collect_and_die(own: HubAddress, results: Connection) -> None:
    client.set_hub_address(own)
    _, there = fiber.Pipe()
    with collecting_grants() as collected:
        results.send_bytes(pickle.dumps(there))
    results.recv()
    assert collected
    os.kill(os.getpid(), signal.SIGKILL)


def test_collected_grants_of_a_dead_process_are_released(hosts: Hosts) -> None:
    hub = hosts["a"]
    ours, theirs = fiber.Pipe()
    process = start(collect_and_die, hub.address, theirs)
    theirs.close()
    data = ours.recv_bytes()
    with hosts.at("a"):
        pickle.loads(data)
        pickle.loads(data)
        assert objects_kept(hub) == 1
        ours.send("die")
        process.join(PATIENCE)
        assert wait_until(lambda: objects_kept(hub) == 0, PATIENCE)
    ours.close()


# Objects of another host


def receive_from_afar(own: HubAddress, data: bytes, report: Connection, times: int) -> None:
    client.set_hub_address(own)
    remote = pickle.loads(data)
    remote.poll(0)
    report.send("ready")
    for _ in range(times):
        report.send(remote.recv())
    report.recv()


@pytest.fixture
def lost_soul(hosts: Hosts, far: Far) -> Iterator[Callable[..., Any]]:
    """Starts a child on host b that receives from afar."""
    started: list[tuple[fiber.Process, Connection]] = []

    def begin(end: Connection, times: int = 1) -> tuple[fiber.Process, Connection]:
        with hosts.at("a"):
            data = pickle.dumps(end)
        ours, theirs = fiber.Pipe()
        arguments = (hosts["b"].address, data, theirs, times)
        process = fiber.Process(target=receive_from_afar, args=arguments, daemon=True)
        process.start()
        theirs.close()
        started.append((process, ours))
        assert ours.recv() == "ready"
        return process, ours

    yield begin
    for process, ours in started:
        ours.close()
        process.kill()
        process.join()
        process.close()


def use_queue_from_afar(own: HubAddress, data: bytes, put: bool, report: Connection) -> None:
    client.set_hub_address(own)
    queue = pickle.loads(data)
    report.send("ready")
    queue.put("lost") if put else queue.get()


@pytest.mark.parametrize("put", [True, False])
def test_a_receiver_that_dies_before_its_answer_takes_no_place(
    put: bool, hosts: Hosts, far: Far, wires: tuple[Wire, Wire]
) -> None:
    queue: Any = fiber.Queue(1)
    free = queue._slots._free
    if put:
        queue.put("first")
    with hosts.at("a"):
        data = pickle.dumps(queue)
    ours, theirs = fiber.Pipe()
    arguments = (hosts["b"].address, data, put, theirs)
    process = fiber.Process(target=use_queue_from_afar, args=arguments, daemon=True)
    process.start()
    assert ours.recv() == "ready"

    def asks() -> bool:
        kept = hosts["a"].registry._users.values()
        served = [users[0].hosted for users in list(kept)]
        return any(getattr(each, "_takers" if put else "_receivers", ()) for each in served)

    assert wait_until(asks, PATIENCE)
    _, down = wires
    done = threading.Event()

    def hold() -> None:
        down.hold()
        done.set()

    hosts.on_loop(hold)
    assert done.wait(PATIENCE)
    if put:
        assert queue.get() == "first"
    else:
        queue.put("lost")
    assert wait_until(lambda: bool(down.held), PATIENCE)  # the answer is on its way
    process.kill()
    process.join(PATIENCE)
    hosts.on_loop(down.let_go)
    assert wait_until(lambda: free.value() == 1, PATIENCE)
    assert queue.empty()
    ours.close()
    theirs.close()


def test_a_remote_receiver_killed_while_waiting_takes_no_message(
    hosts: Hosts, lost_soul: Callable[..., Any]
) -> None:
    here, there = fiber.Pipe()
    process, _ = lost_soul(there)
    os.kill(process.pid, signal.SIGKILL)
    process.join(PATIENCE)
    assert wait_until(lambda: objects_kept(hosts["a"]) == 0, PATIENCE)
    here.send("still here")
    assert there.recv() == "still here"


def test_a_far_receiver_takes_no_more_than_it_asked_for(
    lost_soul: Callable[..., Any],
) -> None:
    here, there = fiber.Pipe()
    process, report = lost_soul(there, 2)
    for number in range(5):
        here.send(number)
    assert [report.recv(), report.recv()] == [0, 1]
    os.kill(process.pid, signal.SIGKILL)
    process.join(PATIENCE)
    assert [there.recv() for _ in range(3)] == [2, 3, 4]


def test_the_end_comes_when_the_last_far_holder_is_killed(lost_soul: Callable[..., Any]) -> None:
    here, there = fiber.Pipe()
    process, _ = lost_soul(there)
    there.close()
    assert not here.poll(0)
    os.kill(process.pid, signal.SIGKILL)
    with pytest.raises(EOFError):
        here.recv()
    process.join(PATIENCE)
