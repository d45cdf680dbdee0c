"""Tunnels: whole messages, in order, as fast as they are taken, and an end with a reason."""

from __future__ import annotations

import itertools
import pickle
import threading
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fiber
from census import wait_until
from fiber._hub.client import ObjectUnreachable
from fiber._hub.remote import RemoteChannel
from fiber._hub.streams import WINDOW, NullHandler, TunnelFrame, Tunnels, TunnelStream
from fiber._wire import messages
from fiber._wire.messages import TunnelClose, TunnelData, TunnelOpen
from fiber._wire.packet import Message
from hosts import Hosts
from patience import PATIENCE


class Listener:
    """A handler that remembers."""

    def __init__(self) -> None:
        self.messages: list[tuple[bytes, list[bytes]]] = []
        self.room = 0
        self.ends: list[str] = []

    def on_message(self, message: Message) -> None:
        self.messages.append((bytes(message.payload), [bytes(b) for b in message.buffers]))

    def on_room(self) -> None:
        self.room += 1

    def on_closed(self, reason: str) -> None:
        self.ends.append(reason)


class Pair:
    """Both ends of a link in one thread; ``run`` carries frames until there are none."""

    def __init__(self) -> None:
        self.up: list[bytes] = []
        self.down: list[bytes] = []
        self.arrived: list[tuple[str, Any]] = []
        self.agent = Tunnels(self._sender(self.up), dialer=True, arrived=self._note)
        self.master = Tunnels(self._sender(self.down), dialer=False, arrived=self._note)

    @staticmethod
    def _sender(queue: list[bytes]) -> Any:
        def send(frame: TunnelFrame) -> None:
            queue.append(frame.encode())

        return send

    def _note(self, host: str, stream: Any) -> None:
        self.arrived.append((host, stream))

    def run(self) -> None:
        while self.up or self.down:
            for queue, side in ((self.up, self.master), (self.down, self.agent)):
                while queue:
                    side.on_frame(messages.decode(bytearray(queue.pop(0))))

    def open(self, host: str = "there") -> tuple[TunnelStream, TunnelStream, Listener]:
        ours = self.agent.open(host)
        self.run()
        theirs = self.arrived[-1][1]
        theirs.handler = listener = Listener()
        return ours, theirs, listener


def parts_of(*sizes: int) -> list[memoryview]:
    return [memoryview(bytes([n % 251]) * size) for n, size in enumerate(sizes)]


@given(
    st.lists(
        st.lists(
            st.sampled_from([0, 1, 5, WINDOW - 1, WINDOW, WINDOW + 1, 3 * WINDOW]),
            min_size=1,
            max_size=4,
        ),
        max_size=6,
    )
)
@settings(max_examples=40, deadline=None)
def test_messages_arrive_whole_and_in_order(shapes: list[list[int]]) -> None:
    pair = Pair()
    ours, _, listener = pair.open()
    sent = [parts_of(*sizes) for sizes in shapes]
    for parts in sent:
        ours.send(parts[0], parts[1:])
        pair.run()
    assert listener.messages == [
        (bytes(parts[0]), [bytes(part) for part in parts[1:]]) for parts in sent
    ]


def test_both_sides_can_open_tunnels_to_a_named_host() -> None:
    pair = Pair()
    one, other = pair.agent.open("a"), pair.master.open("b")
    pair.run()
    assert [host for host, _ in pair.arrived] == ["a", "b"]
    (_, far_one), (_, far_other) = pair.arrived
    far_one.handler, far_other.handler = listeners = Listener(), Listener()
    one.send(b"to a")
    other.send(b"to b")
    pair.run()
    assert [listener.messages for listener in listeners] == [[(b"to a", [])], [(b"to b", [])]]


def test_no_more_than_the_window_is_under_way() -> None:
    pair = Pair()
    ours, theirs, listener = pair.open()
    ours.handler = sender = Listener()
    theirs.pause()
    size = WINDOW // 2
    for _ in range(10):
        ours.send(bytes(size - 1))
    congested = ours.congested
    assert congested
    pair.run()
    assert listener.messages == []
    assert [len(message.payload) for message in theirs._early] == [size - 1] * 2
    theirs.resume()
    pair.run()
    assert len(listener.messages) == 10
    assert not ours.congested
    assert sender.room == 1


def test_a_message_larger_than_the_window_passes() -> None:
    pair = Pair()
    ours, _, listener = pair.open()
    ours.send(bytes(4 * WINDOW), parts_of(3 * WINDOW))
    pair.run()
    ((payload, (buffer,)),) = listener.messages
    assert (len(payload), len(buffer)) == (4 * WINDOW, 3 * WINDOW)


def test_no_more_than_one_large_message_is_under_way() -> None:
    pair = Pair()
    ours, theirs, listener = pair.open()
    ours.handler = sender = Listener()
    theirs.pause()
    for _ in range(3):
        ours.send(b"", parts_of(3 * WINDOW))
        assert ours.congested
    pair.run()
    assert len(theirs._early) == 1
    theirs.resume()
    pair.run()
    assert len(listener.messages) == 3
    assert sender.room == 1
    assert not ours.congested


def test_a_congested_tunnel_does_not_delay_others() -> None:
    pair = Pair()
    ours, theirs, _ = pair.open()
    theirs.pause()
    for _ in range(2):
        ours.send(bytes(4 * WINDOW))
    quick, _, listener = pair.open()
    quick.send(b"through")
    pair.run()
    assert listener.messages == [(b"through", [])]


@pytest.mark.parametrize("reason", ["", "it is over"])
def test_the_end_comes_after_earlier_messages_and_with_its_reason(reason: str) -> None:
    pair = Pair()
    ours, theirs, listener = pair.open()
    theirs.pause()
    ours.send(bytes(3 * WINDOW))
    ours.send(b"last")
    ours.finish(reason)
    ours.send(b"too late")
    pair.run()
    assert listener.ends == []
    theirs.resume()
    pair.run()
    assert [len(payload) for payload, _ in listener.messages] == [3 * WINDOW, 4]
    assert listener.ends == [reason]
    assert len(pair.agent._streams) == len(pair.master._streams) == 0


def test_messages_before_the_end_arrive_although_paused() -> None:
    pair = Pair()
    ours, theirs, listener = pair.open()
    theirs.pause()
    ours.send(b"last")
    ours.finish()
    pair.run()
    assert listener.messages == [(b"last", [])]
    assert listener.ends == [""]


def test_a_lost_link_ends_all_its_tunnels() -> None:
    pair = Pair()
    ends = []
    for _ in range(3):
        ours, theirs, listener = pair.open()
        ours.handler = own = Listener()
        ends += [own, listener]
    pair.agent.lost("no heartbeat")
    pair.master.lost("no heartbeat")
    assert [listener.ends for listener in ends] == [["no heartbeat"]] * 6
    ours.send(b"into the void")
    theirs.finish()
    assert not pair.up
    assert not pair.down


@pytest.mark.parametrize(
    "frame",
    [
        TunnelData(1, b""),
        TunnelData(1, b"\x07"),
        TunnelData(1, b"\x02", [b"nothing that is known"]),
        TunnelData(1, b"\x01" + (5).to_bytes(9, "little")),
        TunnelData(1, b"\x01\x05", [b"x"]),
        TunnelData(1, b"\x01"),
        TunnelData(1, b"\x03"),
    ],
)
def test_nonsense_ends_the_tunnel_not_the_link(frame: TunnelData) -> None:
    pair = Pair()
    ours, _, listener = pair.open()
    ours.handler = own = Listener()
    pair.master.on_frame(frame)
    pair.run()
    assert "malformed" in listener.ends[0]
    assert "malformed" in own.ends[0]
    again, _, listener = pair.open()
    again.send(b"fine")
    pair.run()
    assert listener.messages == [(b"fine", [])]


def test_frames_for_a_tunnel_that_ended_are_ignored() -> None:
    pair = Pair()
    pair.master.on_frame(TunnelData(99, b"\0"))
    pair.master.on_frame(TunnelClose(99))
    assert pair.down == []
    pair.master.on_frame(TunnelOpen(99, "there"))
    assert isinstance(pair.arrived[-1][1].handler, NullHandler)


# Across three hosts


@pytest.fixture
def agents(hosts: Hosts) -> Hosts:
    """Two agents that know only their master."""
    hosts.link("one", "master", only=False)
    hosts.link("two", "master", only=False)
    return hosts


@pytest.mark.parametrize(("home", "away"), [*itertools.permutations(["one", "two", "master"], 2)])
def test_any_host_reaches_any_other(agents: Hosts, home: str, away: str) -> None:
    with agents.at(home):
        here, there = fiber.Pipe()
        data = pickle.dumps(there)
    with agents.at(away):
        remote = pickle.loads(data)
        assert isinstance(remote._channel, RemoteChannel)
        remote.send(b"x" * 3_000_000)
        assert here.recv() == b"x" * 3_000_000
        here.send("back")
        assert remote.recv() == "back"
        remote.close()


def test_an_agent_that_is_lost_is_named_to_the_others(agents: Hosts) -> None:
    with agents.at("one"):
        here, there = fiber.Pipe()
        data = pickle.dumps(there)
    with agents.at("two"):
        remote = pickle.loads(data)
        here.send(1)
        assert remote.recv() == 1
        agents.on_loop(agents["master"].unlink, "one", "agent one was lost")
        with pytest.raises(ObjectUnreachable, match="agent one was lost"):
            remote.poll(None)
        remote.close()


def test_a_slow_reader_holds_the_sender_and_not_the_memory(agents: Hosts) -> None:
    with agents.at("one"):
        here, there = fiber.Pipe()
        data = pickle.dumps(there)
    with agents.at("two"):
        remote = pickle.loads(data)
        sent: list[int] = []

        def send_all() -> None:
            for number in range(30):
                remote.send_bytes(bytes(1_000_000))
                sent.append(number)

        sender = threading.Thread(target=send_all)
        sender.start()
        assert wait_until(lambda: len(sent) >= 2, PATIENCE)
        assert here.poll(PATIENCE)
        # As many bytes as fit into the pipe, without gaps.
        assert not wait_until(lambda: len(sent) > 5, 0.2)
        for _ in range(30):
            assert len(here.recv_bytes()) == 1_000_000
        sender.join()
        remote.close()


def test_a_host_that_the_master_does_not_know_is_named(agents: Hosts) -> None:
    with agents.at("nobody"):
        _, there = fiber.Pipe()
        data = pickle.dumps(there)
    with agents.at("two"):
        remote = pickle.loads(data)
        with pytest.raises(ObjectUnreachable, match="'nobody' cannot be reached"):
            remote.poll()
        remote.close()
