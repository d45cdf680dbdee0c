"""Powers of an attacker on the path: to delay and to break off, and no others.

``docs/decisions/0006-one-port-accepts-agents-by-tls.md`` says why.
"""

from __future__ import annotations

import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest

from fiber._transport import authentication
from fiber._transport.authentication import AgentHello, Identity, MasterRefusal, decode_greeting
from fiber._transport.credentials import make_credentials
from fiber._transport.link import Keepalive
from fiber._transport.listener import MasterListener
from fiber.errors import AuthenticationError, LinkError
from patience import PATIENCE
from unit.attacker import CUT, DOWN, MESSAGE, TLS, UP, Path, Unit
from unit.link_site import SHORT, Notes, Site, complete, port_of, say

FRAMES = [b"%d " % number * 50 for number in range(30)]
HOPS = 8 + 4
"""Index where a message's sealed part begins: behind its length and nng's count of hops."""


class Once:
    """Applies an attack to the first unit that it is meant for."""

    def __init__(self, meant: Callable[[Unit], bool], attack: Callable[[Any, Unit], Any]) -> None:
        self._meant = meant
        self._attack = attack
        self.seen: list[Unit] = []
        self.held: list[bytes] = []
        self.done = threading.Event()

    def __call__(self, unit: Unit) -> list[bytes | None]:
        self.seen.append(unit)
        if not self.done.is_set() and self._meant(unit):
            self.done.set()
            return list(self._attack(self, unit))
        held, self.held = self.held, []
        return [unit.data, *held]


def flip(at: int) -> Callable[[Once, Unit], list[bytes]]:
    def attack(_: Once, unit: Unit) -> list[bytes]:
        changed = bytearray(unit.data)
        changed[at % len(changed)] ^= 1
        return [bytes(changed)]

    return attack


def swap(once: Once, unit: Unit) -> list[bytes]:
    once.held = [unit.data]
    return []


def from_the_other_direction(once: Once, unit: Unit) -> list[bytes]:
    other = next(u for u in once.seen if u.kind == MESSAGE and u.direction != unit.direction)
    return [other.data, unit.data]


def from_the_beginning(once: Once, unit: Unit) -> list[bytes]:
    first = next(u for u in once.seen if u.kind == MESSAGE and u.direction == unit.direction)
    return [first.data, unit.data]


ATTACKS: dict[str, Callable[[Once, Unit], Any]] = {
    "drop": lambda *_: [],
    "replay": lambda _, unit: [unit.data, unit.data],
    "replay the first": from_the_beginning,
    "reorder": swap,
    "cut": lambda *_: [CUT],
    "truncate": lambda _, unit: [unit.data[:-5], CUT],
    "inject": lambda _, unit: [unit.data[:HOPS] + bytes(len(unit.data) - HOPS), unit.data],
    "inject an empty one": lambda _, unit: [(4).to_bytes(8, "big") + unit.data[8:HOPS], unit.data],
    "reflect": from_the_other_direction,
    "change the beginning": flip(HOPS),
    "change the end": flip(-1),
    "change the hops": lambda _, unit: [unit.data[: HOPS - 1] + b"\xff" + unit.data[HOPS:]],
    "announce far too much": flip(1),
    "announce less": flip(7),
}


def talk(site: Site, path: Path, listener: MasterListener, master: Notes) -> Notes:
    """An agent over ``path``; both sides say all FRAMES, a few at a time."""
    _, agent = site.dialer(listener.address, connect=path.connect)
    sides = (master, agent)
    for number in range(0, len(FRAMES), 3):
        for notes in sides:
            for frame in FRAMES[number : number + 3]:
                notes.link.send(frame)
        for notes in sides:
            notes.wait_for_frames(number + 3)
    return agent


@pytest.fixture
def path_of(site: Site) -> Iterator[Callable[..., tuple[Path, MasterListener, Notes]]]:
    paths: list[Path] = []

    def make(meddle: Any, keepalive: Keepalive = SHORT) -> tuple[Path, MasterListener, Notes]:
        listener, master = site.listener(keepalive=keepalive)
        paths.append(Path(listener, meddle))
        return paths[-1], listener, master

    yield make
    for path in paths:
        path.close()


@pytest.mark.parametrize("direction", [UP, DOWN])
@pytest.mark.parametrize("attack", ATTACKS)
def test_an_attack_on_a_message_costs_a_connection_and_no_more(
    site: Site, path_of: Any, attack: str, direction: str
) -> None:
    once = Once(
        lambda unit: (unit.direction, unit.kind) == (direction, MESSAGE) and unit.number == 4,
        ATTACKS[attack],
    )
    path, listener, master = path_of(once)
    agent = talk(site, path, listener, master)
    assert once.done.is_set()
    assert path.connections == 2, "it was noticed, and the agent dialled again"
    assert agent.frames == master.frames == FRAMES
    assert not [event for event in (*agent.events, *master.events) if "lost" in event]
    assert len(master.links) == 1


def test_a_delay_costs_time(site: Site, path_of: Any) -> None:
    goes_on = threading.Event()

    def delay(_: Once, unit: Unit) -> list[bytes]:
        goes_on.wait(0.3)  # the length of the delay, which is tested
        return [unit.data]

    once = Once(lambda unit: unit.kind == MESSAGE and unit.number == 4, delay)
    path, listener, master = path_of(once, SHORT._replace(suspect_after=30.0, lost_after=60.0))
    agent = talk(site, path, listener, master)
    assert agent.frames == master.frames == FRAMES
    assert path.connections == 1


RECORD_ATTACKS: dict[str, Callable[[Once, Unit], Any]] = {
    "drop": lambda *_: [],
    "replay": lambda _, unit: [unit.data, unit.data],
    "cut": lambda *_: [CUT],
    "truncate": lambda _, unit: [unit.data[:-1], CUT],
    "change the beginning": flip(5),
    "change the end": flip(-1),
    "change the version": flip(2),
    "garbage": lambda _, unit: [b"\x17\x03\x03\x00\x20" + bytes(32)],
}


@pytest.mark.parametrize("number", [0, 1, 2, 3])
@pytest.mark.parametrize("direction", [UP, DOWN])
@pytest.mark.parametrize("attack", RECORD_ATTACKS)
def test_an_attack_on_the_handshake_ends_it(
    site: Site, path_of: Any, attack: str, direction: str, number: int, monkeypatch: Any
) -> None:
    """Change a message: that may end the connection, but no false message is accepted."""
    monkeypatch.setattr("fiber._transport.acceptor._DEADLINE", 0.4)
    monkeypatch.setattr("fiber._transport.dialer._GREET", 0.4)
    once = Once(
        lambda unit: (unit.direction, unit.kind, unit.number) == (direction, TLS, number),
        RECORD_ATTACKS[attack],
    )
    path, listener, master = path_of(once)
    _, agent = site.dialer(listener.address, connect=path.connect)
    agent.wait(lambda: agent.links or agent.errors)
    if agent.errors:
        assert isinstance(agent.errors[0], AuthenticationError | LinkError)
        assert master.links == []
    else:
        agent.link.send(b"in order")
        master.wait(lambda: master.frames)
        assert master.frames == [b"in order"]


def test_a_replayed_conversation_is_refused(site: Site, path_of: Any) -> None:
    once = Once(lambda _: False, lambda *_: [])
    path, listener, master = path_of(once)
    talk(site, path, listener, master)
    with socket.create_connection(("127.0.0.1", port_of(listener.address)), PATIENCE) as again:
        for unit in [unit for unit in once.seen if unit.direction == UP]:
            try:
                again.sendall(unit.data)
            except ConnectionError:
                break  # it was turned away in the middle
        master.wait(lambda: master.refusals)
    assert "was turned away: the TLS handshake failed" in master.refusals[0]
    assert len(master.links) == 1
    assert master.frames == FRAMES


def test_a_frame_is_sealed_anew_on_each_connection(site: Site, path_of: Any) -> None:
    """Send again on a new connection: the message is sealed anew."""
    once = Once(lambda unit: unit.kind == MESSAGE and unit.number == 4, lambda *_: [CUT])
    path, listener, master = path_of(once)
    talk(site, path, listener, master)
    sealed = [unit.data[HOPS:] for unit in once.seen if unit.kind == MESSAGE]
    assert len(set(sealed)) == len(sealed)
    assert not [data for data in sealed if FRAMES[0][:20] in data]


@pytest.mark.parametrize("claims", ["to go on with a link", "to begin one that is another's"])
def test_a_stolen_agents_key_opens_no_other_agents_link(site: Site, claims: str) -> None:
    listener, master = site.listener()
    _, agent = site.dialer(listener.address)
    agent.link.send(b"mine")
    master.wait(lambda: master.frames)
    thief = Identity.of_this_process("agent-2", "uid", host="here")
    (name,) = listener._links  # even if the thief knew it
    hello = AgentHello(thief, name, 0, claims == "to go on with a link")
    stolen = site.credentials.agent("agent-2", "uid")
    answer = decode_greeting(say(listener.address, stolen, hello.encode()))
    assert isinstance(answer, MasterRefusal)
    assert "the link of 'agent-1'" in answer.reason
    agent.link.send(b"still mine")
    master.wait(lambda: len(master.frames) == 2)
    assert master.events == agent.events == []


def test_the_path_with_a_stolen_agents_key_is_no_master(site: Site) -> None:
    """Nor can who has such a key sit in the middle: an agent expects the master's name."""
    stolen = replace(make_credentials(), pool_key=site.credentials.agent("b", "uid").key)
    middle = Site(stolen)
    try:
        listener, _ = middle.listener()
        victim = replace(site.credentials.agent("agent-1", "uid"), master="")
        _, agent = site.dialer(listener.address, credentials=victim)
        agent.wait(lambda: agent.errors)
    finally:
        middle.end()
    assert isinstance(agent.errors[0], AuthenticationError)


def test_a_proof_is_good_for_one_master_alone(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """Relay with another certificate in the middle: an agent's proof cannot be passed on."""
    listener, master = site.listener()
    middle = authentication.agent_context()
    credentials = replace(site.credentials.agent("agent-1", "uid"), master="")
    hello = AgentHello(Identity.of_this_process("agent-1", "uid"), "0" * 32, 0, False).encode()
    sock = socket.create_connection(("127.0.0.1", port_of(listener.address)), PATIENCE)
    handshake = authentication.AgentHandshake(sock, middle)
    shown = b"what the one in the middle shows"
    monkeypatch.setattr(handshake.sock, "getpeercert", lambda binary_form=False: shown)
    try:
        with pytest.raises(authentication.Untrusted, match="does not believe"):
            complete(handshake, handshake.ask(credentials, hello))
    finally:
        handshake.close()
    assert master.links == []


@pytest.mark.filterwarnings("ignore:ssl.TLSVersion:DeprecationWarning")
@pytest.mark.parametrize("who", ["agent", "master"])
def test_no_side_accepts_an_older_tls(
    site: Site, monkeypatch: pytest.MonkeyPatch, who: str
) -> None:
    def older(*credentials: Any) -> ssl.SSLContext:
        context: ssl.SSLContext = made(*credentials)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.maximum_version = ssl.TLSVersion.TLSv1_2
        return context

    made: Any = getattr(authentication, f"{who}_context")
    monkeypatch.setattr(authentication, f"{who}_context", older)
    listener, master = site.listener()
    _, agent = site.dialer(listener.address)
    agent.wait(lambda: agent.errors)
    assert isinstance(agent.errors[0], AuthenticationError)
    master.wait(lambda: master.refusals)
    assert "unsupported protocol" in master.refusals[0] or "protocol version" in master.refusals[0]
    assert master.links == []
