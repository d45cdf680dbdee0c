"""Shared memory of several hosts: hubs on one loop, and what their links carry."""

from __future__ import annotations

import gc
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import fiber
from census import wait_until
from fiber._hub.client import ObjectUnreachable
from fiber._hub.heap import Block
from fiber._hub.protocol import NO_SECRET, Origin
from fiber._hub.replicas import Replicas
from fiber._wire.messages import MemoryMessage, ProtocolError
from hosts import Far, Hosts, Wire, objects_kept
from patience import PATIENCE


@pytest.fixture
def star(hosts: Hosts) -> Hosts:
    """A master and two agents."""
    hosts.link("one", "master", only=False)
    hosts.link("two", "master", only=False)
    return hosts


class Pipe:
    """From one host to another."""

    def __init__(self, hosts: Hosts, sender: str, receiver: str) -> None:
        self._hosts, self._sender, self._receiver = hosts, sender, receiver
        with hosts.at(receiver):
            self._reader, writer = fiber.Pipe(duplex=False)
            data = pickle.dumps(writer)
        with hosts.at(sender):
            self._writer = pickle.loads(data)

    def send(self, thing: Any) -> Any:
        """Send it from here to there: what arrives."""
        with self._hosts.at(self._sender):
            self._writer.send(thing)
        with self._hosts.at(self._receiver):
            return self._reader.recv()


def buffer_of(array: Any) -> Any:
    return array._wrapper


def memory_of(array: Any) -> Block:
    block: Block = buffer_of(array)._block
    return block


def kept(hosts: Hosts, name: str) -> Callable[[], bool]:
    return lambda: objects_kept(hosts[name]) == 0 and not hosts[name].replicas._replicas


# Writes


def test_a_write_is_seen_by_every_process_that_learns_of_it(
    hosts: Hosts, wires: tuple[Wire, Wire]
) -> None:
    there, back = Pipe(hosts, "a", "b"), Pipe(hosts, "b", "a")
    with hosts.at("a"):
        array = fiber.RawArray("i", [1, 2, 3])
    other = there.send(array)
    assert list(other) == [1, 2, 3]
    for number in range(5):
        array[0] = number
        assert there.send(number) == other[0]
        other[2] = -number
        assert back.send(-number) == array[2]


@pytest.mark.parametrize("home", ["master", "one", "two"])
def test_news_passes_a_third_host(star: Hosts, home: str) -> None:
    hosts = ("master", "one", "two")
    with star.at(home):
        made = fiber.RawArray("i", 3)
    arrays = {home: made}
    for host in hosts:
        if host != home:
            arrays[host] = Pipe(star, home, host).send(made)
    round_trip = [Pipe(star, *pair) for pair in zip(hosts, (*hosts[1:], hosts[0]), strict=True)]
    for number in range(1, 4):
        for index, pipe in enumerate(round_trip):
            arrays[hosts[index]][index] = number
            pipe.send(None)
        assert list(arrays["master"]) == [number] * 3
    round_trip[0].send(None)
    assert list(arrays["one"]) == [3] * 3


def test_a_link_that_stands_still_keeps_the_order(hosts: Hosts, wires: tuple[Wire, Wire]) -> None:
    down = wires[1]
    there = Pipe(hosts, "a", "b")
    with hosts.at("a"):
        array = fiber.RawArray("i", 1)
    other = there.send(array)
    hosts.on_loop(down.hold)
    array[0] = 5
    hosts.on_loop(down.let_go)
    assert there.send("changed") == "changed"
    assert other[0] == 5


def test_processes_of_a_host_have_the_same_memory(far: Far, hosts: Hosts) -> None:
    array = fiber.RawArray("i", 3)
    one, other = far(array), far(array)
    assert memory_of(one).identity == memory_of(other).identity != memory_of(array).identity
    with hosts.child_at("b"):
        assert memory_of(far(array)).identity == memory_of(one).identity


def test_a_block_that_returns_home_is_the_original_memory(far: Far, hosts: Hosts) -> None:
    with hosts.at("a"):
        array = fiber.RawArray("i", 3)
    data = pickle.dumps(far(array))
    with hosts.at("a"):
        assert memory_of(pickle.loads(data)).identity == memory_of(array).identity


# Kept objects


def test_replicas_are_dropped_on_all_hosts_after_the_last_use(star: Hosts) -> None:
    with star.at("one"):
        array = fiber.RawArray("i", [5])
    there = Pipe(star, "one", "two")
    other = there.send(array)
    assert star["master"].replicas._replicas
    other[0] = 6
    del other
    gc.collect()
    assert wait_until(lambda: array[0] == 6, PATIENCE), "the last write went astray"
    for host in ("master", "one", "two"):
        assert wait_until(lambda host=host: not star[host].replicas._replicas, PATIENCE)  # type: ignore[misc]
    assert list(there.send(array)) == [6]


def test_a_replica_stays_usable_after_its_home_is_lost(
    hosts: Hosts, wires: tuple[Wire, Wire]
) -> None:
    there = Pipe(hosts, "a", "b")
    with hosts.at("a"):
        array, late = fiber.RawArray("i", [7]), pickle.dumps(fiber.RawArray("i", 1))
    other = there.send(array)
    hosts.on_loop(hosts["b"].unlink, "a", "it was unplugged")
    with hosts.at("b"):
        with pytest.raises(ObjectUnreachable, match="'a' cannot be reached"):
            pickle.loads(late)
        with pytest.raises(ObjectUnreachable, match="unplugged"):
            pickle.dumps(other)
    other[0] += 1
    assert other[0] == 8


def test_the_loss_of_a_link_ends_the_wait_for_a_replica(hosts: Hosts) -> None:
    up, _ = hosts.link("b", "a")
    with hosts.at("a"):
        data = pickle.dumps(fiber.RawArray("i", 1))
    hosts.on_loop(up.hold)
    with hosts.at("b"):
        hosts.loop.call_later(0.05, hosts["b"].unlink, "a", "it was unplugged")
        with pytest.raises(ObjectUnreachable, match=r"'a' cannot be reached|unplugged"):
            pickle.loads(data)


# Refusals


class Asker:
    """A ``Joiner`` that notes the answer."""

    reason = ""

    def joined(self, block: Block) -> None:
        raise AssertionError("it was let in")

    def refused(self, reason: str) -> None:
        self.reason = reason

    def is_refused(self) -> bool:
        return bool(self.reason)


@pytest.fixture
def replicas(hosts: Hosts) -> Iterator[Replicas]:
    with hosts.at("a") as hub:
        yield hub.replicas


@pytest.mark.parametrize(("home", "reason"), [("a", "is gone"), ("c", "'c' cannot be reached")])
def test_a_process_without_the_right_gets_the_reason(
    replicas: Replicas, home: str, reason: str
) -> None:
    asker = Asker()
    origin = Origin(home, NO_SECRET, 8, NO_SECRET, NO_SECRET)
    replicas.join(origin, asker, asker)
    assert reason in asker.reason
    assert not replicas._replicas


def test_objects_of_others_cannot_be_used_without_their_secrets(far: Far, hosts: Hosts) -> None:
    with hosts.at("a"):
        array = fiber.RawArray("i", 3)
    other = far(array)
    for name in ("a", "b"):
        replicas, asker = hosts[name].replicas, Asker()
        (replica,) = replicas._replicas.values()
        wrong = Origin("a", NO_SECRET, replica.block.size, NO_SECRET, NO_SECRET)
        hosts.on_loop(replicas.join, wrong, asker, asker)
        assert wait_until(asker.is_refused, PATIENCE)
        assert "is gone" in asker.reason
    assert list(other) == [0, 0, 0]


def test_a_block_is_had_as_a_whole_or_not_at_all(replicas: Replicas, hosts: Hosts) -> None:
    block = memory_of(fiber.RawArray("i", 4))
    home, extent = buffer_of_handle(block)
    for identity, size in ((home.identity, 1 << 20), (NO_SECRET, extent.size)):
        asker = Asker()
        replicas.join(Origin("a", identity, size, NO_SECRET, home.grant), 1, asker)
        assert "no such block" in asker.reason


def buffer_of_handle(block: Block) -> Any:
    from fiber._hub.handles import handle_for_block
    from fiber._hub.protocol import ObjectKind

    return handle_for_block(ObjectKind.MEMORY, block)


@pytest.mark.parametrize("payload", [b"", b"\0", b"\x09", b"\x01short", b"\x01" + b"\xff" * 80])
def test_malformed_frames_end_the_link(replicas: Replicas, payload: bytes) -> None:
    link = replicas.link("x", lambda frame: None, dialer=True)
    with pytest.raises(ProtocolError, match="malformed"):
        link.on_frame(MemoryMessage(1, payload))
