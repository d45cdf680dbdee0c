"""Relay: agents reach their master through it, and strangers do no harm."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest

from faults.program import wait_for
from fiber._transport.credentials import OwnCredentials
from fiber._transport.link import Keepalive
from fiber._transport.listener import MasterListener
from fiber._transport.multiplexer import Multiplexer, SocketCarrier
from fiber._transport.relay import Relay
from fiber._wire.streams import VERSION, FrameDecoder, Kind, StreamFrame, hello
from patience import PATIENCE
from unit.link_site import Notes, Site, wires_of

PATIENT = Keepalive(heartbeat=0.2, suspect_after=PATIENCE / 2, lost_after=PATIENCE)


class Master:
    """Master's end of a relay: gives each stream to a listener.  Runs on the site's loop."""

    def __init__(
        self,
        site: Site,
        relay: Relay,
        take: Callable[[socket.socket, str], None],
        epoch: int = 1,
        identity: str = "laptop",
    ) -> None:
        self.notes = Notes()
        self._take = take
        self._site = site
        sock = socket.create_connection(("127.0.0.1", relay.master_port), PATIENCE)
        self.end: Multiplexer = site.on_loop(lambda: self._begin(sock, epoch, identity))

    def _begin(self, sock: socket.socket, epoch: int, identity: str) -> Multiplexer:
        end = Multiplexer(
            self._site.loop,
            SocketCarrier(sock),
            on_hello=lambda frame: self.notes.add(self.notes.frames, frame.hello),
            on_end=lambda reason: self.notes.add(self.notes.events, reason),
            on_open=self._open,
        )
        end.send(hello(epoch=epoch, identity=identity))
        return end

    def _open(self, origin: str) -> socket.socket:
        near, far = socket.socketpair()
        self._take(far, origin)
        return near

    @property
    def answer(self) -> dict[str, object]:
        self.notes.wait_for_frames(1)
        found: object = self.notes.frames[0]
        assert isinstance(found, dict)
        return found

    def close(self) -> None:
        self._site.on_loop(self.end.close)


class Relayed:
    """A site with a relay, and masters that are closed at the end."""

    def __init__(self, site: Site) -> None:
        self.site = site
        self.log = Notes()
        self.relay: Relay = site.on_loop(self._begin)
        self.address = f"127.0.0.1:{self.relay.agents_port}"
        self._masters: list[Master] = []

    def _begin(self) -> Relay:
        return Relay(self.site.loop, 0, 0, self.log.on_refused)

    def listener(self) -> tuple[MasterListener, Notes]:
        return self.site.listener(keepalive=PATIENT)

    def master(
        self, take: Callable[[socket.socket, str], None], epoch: int = 1, identity: str = "laptop"
    ) -> Master:
        master = Master(self.site, self.relay, take, epoch, identity)
        self._masters.append(master)
        return master

    def wait_for_log(self, text: str) -> None:
        self.log.wait(lambda: any(text in line for line in self.log.refusals))

    def close(self) -> None:
        for master in self._masters:
            master.close()
        self.site.on_loop(self.relay.close)


@pytest.fixture
def relayed(site: Site) -> Iterator[Relayed]:
    relayed = Relayed(site)
    yield relayed
    relayed.close()


def dropped(sock: socket.socket, origin: str) -> None:
    sock.close()


# -- Links


def exchange(master: Notes, agent: Notes, count: int, first: int = 0) -> None:
    """Send ``count`` frames in each direction and check that all have arrived, in order."""
    for number in range(first, first + count):
        agent.link.send(b"up %d " % number + bytes(5000))
        master.link.send(b"down %d " % number + bytes(5000))
    for notes, words in ((master, b"up"), (agent, b"down")):
        notes.wait_for_frames(first + count)
        expected = [b"%s %d " % (words, number) + bytes(5000) for number in range(first + count)]
        assert [bytes(frame) for frame in notes.frames] == expected


def test_an_agent_reaches_its_master_through_the_relay(relayed: Relayed) -> None:
    listener, master = relayed.listener()
    end = relayed.master(listener.take)
    assert end.answer == {"version": VERSION}
    _, agent = relayed.site.dialer(relayed.address)
    exchange(master, agent, 100)
    assert relayed.log.refusals == ["connected to the master laptop with the epoch 1"]


def test_agents_wait_for_the_master(relayed: Relayed) -> None:
    agents = [relayed.site.dialer(relayed.address)[1] for _ in range(5)]
    site = relayed.site
    wait_for(lambda: site.on_loop(lambda: len(relayed.relay._spoken)) == 5)
    listener, master = relayed.listener()
    relayed.master(listener.take)
    for agent in agents:
        assert agent.link.peer.name
    master.wait(lambda: len(master.links) == 5)
    assert site.on_loop(lambda: (len(relayed.relay._waiting), len(relayed.relay._spoken))) == (0, 0)


def test_a_master_that_comes_back_goes_on_with_its_links(relayed: Relayed) -> None:
    listener, master = relayed.listener()
    end = relayed.master(listener.take)
    _, agent = relayed.site.dialer(relayed.address)
    exchange(master, agent, 50)
    for round_number in range(1, 4):
        end.close()
        relayed.wait_for_log("the connection to the master is gone: it was closed")
        for number in range(50 * round_number, 50 * round_number + 10):  # while there is none
            agent.link.send(b"up %d " % number + bytes(5000))
            master.link.send(b"down %d " % number + bytes(5000))
        end = relayed.master(listener.take)
        for number in range(50 * round_number + 10, 50 * round_number + 50):
            agent.link.send(b"up %d " % number + bytes(5000))
            master.link.send(b"down %d " % number + bytes(5000))
        exchange(master, agent, 0, 50 * round_number + 50)
    assert (len(master.links), len(agent.links)) == (1, 1)
    assert master.events == agent.events == []


def test_a_connection_that_breaks_between_relay_and_agent_is_made_again(relayed: Relayed) -> None:
    listener, master = relayed.listener()
    relayed.master(listener.take)
    _, agent = relayed.site.dialer(relayed.address)
    exchange(master, agent, 10)
    relayed.site.on_loop(lambda: [wire.break_off() for wire in wires_of(listener)])
    exchange(master, agent, 10, 10)
    assert len(master.links) == 1


def test_an_end_of_the_link_reaches_the_agent_with_its_reason(relayed: Relayed) -> None:
    listener, master = relayed.listener()
    end = relayed.master(listener.take)
    _, agent = relayed.site.dialer(relayed.address)
    exchange(master, agent, 1)
    relayed.site.close(listener, "the pool is closed", linger=PATIENCE)
    agent.wait(lambda: agent.events)
    assert "the pool is closed" in agent.events[0]
    site = relayed.site
    wait_for(lambda: site.on_loop(lambda: len(end.end)) == 0)


def test_an_agent_with_wrong_credentials_is_told_so(
    relayed: Relayed, credentials: OwnCredentials
) -> None:
    listener, master = relayed.listener()
    relayed.master(listener.take)
    wrong = credentials.agent("another", "")
    _, agent = relayed.site.dialer(relayed.address, credentials=wrong)
    agent.wait(lambda: agent.errors)
    assert "do not trust each other" in str(agent.errors[0])
    master.wait(lambda: master.refusals)
    assert master.refusals[0].startswith("127.0.0.1:")


# -- Masters


def test_a_newer_epoch_replaces_the_master(relayed: Relayed) -> None:
    old = relayed.master(dropped, epoch=3)
    assert "refused" not in old.answer
    new = relayed.master(dropped, epoch=4, identity="desktop")
    assert "refused" not in new.answer
    old.notes.wait(lambda: old.notes.events)
    assert old.notes.events == ["it was closed by the other side"]
    assert new.notes.events == []
    relayed.wait_for_log("connected to the master desktop with the epoch 4")


def test_the_same_epoch_replaces_the_connection(relayed: Relayed) -> None:
    """The master has noticed a break that the relay has not noticed yet."""
    old = relayed.master(dropped, epoch=3)
    assert "refused" not in old.answer
    new = relayed.master(dropped, epoch=3)
    assert "refused" not in new.answer
    old.notes.wait(lambda: old.notes.events)


@pytest.mark.parametrize("there", [True, False])
def test_an_older_epoch_is_refused(relayed: Relayed, there: bool) -> None:
    new = relayed.master(dropped, epoch=4)
    assert "refused" not in new.answer
    if not there:
        new.close()
        relayed.wait_for_log("the connection to the master is gone")
    old = relayed.master(dropped, epoch=3)
    assert old.answer["refused"] == "the pool has a master with the epoch 4"
    assert new.notes.events == []


@pytest.mark.parametrize(
    "content",
    [
        b"{",
        b"[" * 60_000,
        b'{"version": 99, "epoch": 1, "identity": "x"}',
        b'{"version": 1}',
        b'{"version": 1, "epoch": "x", "identity": "x"}',
        b'{"version": 1, "epoch": null, "identity": "x"}',
        b'{"version": 1, "epoch": Infinity, "identity": "x"}',
        b'{"version": 1, "epoch": NaN, "identity": "x"}',
    ],
)
def test_a_hello_that_the_relay_does_not_understand_is_refused(
    relayed: Relayed, content: bytes
) -> None:
    with socket.create_connection(("127.0.0.1", relayed.relay.master_port), PATIENCE) as sock:
        sock.sendall(StreamFrame(Kind.HELLO, 0, content).encode())
        decoder = FrameDecoder()
        (answer,) = decoder.feed(sock.recv(1 << 16))
    assert "the relay does not understand it" in answer.hello["refused"]
    assert "refused" not in relayed.master(dropped).answer


def test_a_master_that_says_hello_twice_is_cut_off_and_may_come_again(relayed: Relayed) -> None:
    master = relayed.master(dropped)
    assert master.answer
    relayed.site.on_loop(lambda: master.end.send(hello(epoch=1, identity="laptop")))
    relayed.wait_for_log("is gone: the master said twice which one it is")
    taken = Notes()

    def take(sock: socket.socket, origin: str) -> None:
        sock.close()
        taken.on_refused(origin)

    relayed.master(take)
    with socket.create_connection(("127.0.0.1", relayed.relay.agents_port), PATIENCE) as agent:
        taken.wait(lambda: taken.refusals)
        assert agent.recv(1) == b""


# -- The process


class Process:
    """``python -m fiber.agent`` as a relay."""

    def __init__(self, agents_port: object, master_port: object, *prefix: str) -> None:
        environment = {name: value for name, value in os.environ.items() if "FIBER" not in name}
        given = {
            "FIBER_RELAY_AGENTS_PORT": agents_port,
            "FIBER_RELAY_MASTER_PORT": master_port,
        }
        environment |= {name: str(value) for name, value in given.items() if value is not None}
        self.process = subprocess.Popen(
            [*prefix, sys.executable, "-m", "fiber.agent"],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def line(self) -> str:
        """Return the next line of its output."""
        assert self.process.stdout is not None
        return self.process.stdout.readline()

    def ports(self) -> list[int]:
        """Return the ports for agents and for the master, which the first line says."""
        return [int(word) for word in re.findall(r"\d+", self.line())]

    def end(self, number: int | None = None) -> tuple[int, str]:
        """Send a signal, if there is one; return the status and the rest of both outputs."""
        if number is not None:
            self.process.send_signal(number)
        out, err = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, out + err


@pytest.fixture
def start() -> Iterator[Callable[..., Process]]:
    started: list[Process] = []

    def start(*arguments: object) -> Process:
        started.append(Process(*arguments))  # type: ignore[arg-type]
        return started[-1]

    yield start
    for one in started:
        one.process.kill()
        one.process.communicate()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_relay_ends_at_a_signal(start: Callable[..., Process], number: int) -> None:
    relay = start(0, 0)
    line = relay.line()
    assert re.fullmatch(r"fiber relay: listens at port \d+ for agents, \d+ for the master\n", line)
    assert relay.end(number) == (0, "")


def test_a_relay_ends_at_a_signal_while_it_has_a_master_and_agents(
    start: Callable[..., Process],
) -> None:
    relay = start(0, 0)
    agents_port, master_port = relay.ports()
    with (
        socket.create_connection(("127.0.0.1", master_port), PATIENCE) as master,
        socket.create_connection(("127.0.0.1", agents_port), PATIENCE) as agent,
    ):
        master.sendall(hello(epoch=7, identity="laptop-7:4711").encode())
        line = relay.line()
        assert line == "fiber relay: connected to the master laptop-7:4711 with the epoch 7\n"
        assert relay.end(signal.SIGTERM) == (0, "")
        assert agent.recv(1) == b""


@pytest.mark.parametrize(
    ("ports", "reason"),
    [
        (("x", 0), "FIBER_RELAY_AGENTS_PORT is 'x'. Set it to the number of a port, 0 to 65535"),
        ((0, 65536), "FIBER_RELAY_MASTER_PORT is '65536'"),
        ((-1, 0), "FIBER_RELAY_AGENTS_PORT is '-1'"),
        (("", 0), "FIBER_RELAY_AGENTS_PORT is ''"),
        ((0, None), "FIBER_RELAY_MASTER_PORT is ''"),
    ],
)
def test_a_wrong_port_is_named(
    start: Callable[..., Process], ports: tuple[object, object], reason: str
) -> None:
    status, told = start(*ports).end()
    assert status == 1
    assert told.startswith(f"fiber relay: it cannot begin: {reason}")
    assert len(told.splitlines()) == 1


@pytest.mark.parametrize("which", [0, 1])
def test_a_port_in_use_is_named(start: Callable[..., Process], which: int) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        status, told = start(*((port, 0) if which == 0 else (0, port))).end()
    assert status == 1
    assert f"_PORT={port}" in told
    assert "address already in use. Choose ports that no other program uses" in told


@pytest.mark.slow
def test_strangers_that_take_all_descriptors_do_not_keep_the_master_out(
    start: Callable[..., Process],
) -> None:
    relay = start(0, 0, "sh", "-c", 'ulimit -n 64; exec "$@"', "sh")
    agents_port, master_port = relay.ports()
    strangers = [socket.create_connection(("127.0.0.1", agents_port), PATIENCE) for _ in range(100)]
    with socket.create_connection(("127.0.0.1", master_port), PATIENCE) as master:
        master.sendall(hello(epoch=7, identity="me").encode())
        assert next(FrameDecoder().feed(master.recv(1 << 16))).kind is Kind.HELLO
        for stranger in strangers:
            stranger.close()
        master.sendall(StreamFrame(Kind.PING).encode())
        assert relay.end(signal.SIGTERM)[0] == 0
