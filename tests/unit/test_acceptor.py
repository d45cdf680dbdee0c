"""Rejections of the acceptor: which client is rejected, when, and with which message."""

from __future__ import annotations

import contextlib
import errno
import gc
import os
import socket
import threading
from typing import Any

import pytest

from faults.program import wait_for
from fiber._transport import acceptor, authentication
from fiber._transport.acceptor import Admission
from fiber._transport.authentication import AgentHello, Identity
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop
from patience import PATIENCE
from unit.link_site import Notes, Site, complete, port_of, say

HELLO = AgentHello(Identity.of_this_process("stranger"), "0" * 32, 0, False).encode()


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(acceptor, "_DEADLINE", PATIENCE)


class Visitor:
    """Client with an agent's credentials that stops where the test says."""

    def __init__(self, site: Site, address: str) -> None:
        self._credentials = site.credentials.agent("stranger", "")
        self.sock = socket.create_connection(("127.0.0.1", port_of(address)), PATIENCE)
        self.handshake = authentication.AgentHandshake(self.sock, authentication.agent_context())

    def go(self, state: str) -> None:
        """Up to ``state``, and not a step further."""
        if state == "connected":
            return
        if state == "hello of TLS sent":
            next(self.handshake._when_ready(self.handshake.sock.do_handshake), None)
        elif state == "welcome":
            complete(self.handshake, self.handshake.ask(self._credentials, HELLO))
        else:
            complete(self.handshake, self.handshake._when_ready(self.handshake.sock.do_handshake))
            if state == "half of its first words":
                self.handshake.sock.send(self.handshake._ours + (100).to_bytes(4, "big") + b"half")

    def rest(self) -> bytes:
        """All that still comes, up to the end."""
        sock = self.handshake.sock
        raw = socket.socket(fileno=os.dup(sock.fileno()))
        raw.settimeout(PATIENCE)
        data = b""
        try:
            while more := raw.recv(1 << 16):
                data += more
        except ConnectionError:
            pass
        finally:
            raw.close()
            self.close()
        return data

    def close(self) -> None:
        self.handshake.close()


def pass_time(listener: MasterListener, seconds: float) -> None:
    """Let the acceptor's clock go forward by ``seconds``."""
    loop = listener._acceptor.loop
    loop.now = lambda: Loop.now() + seconds  # type: ignore[method-assign]  # of this loop alone
    loop.call_soon(lambda: None)  # the loop looks at its clock when it wakes up


STATES = (
    "connected",
    "hello of TLS sent",
    "TLS proved",
    "half of its first words",
    "welcome",
)


@pytest.mark.parametrize("state", STATES)
def test_a_client_that_stops_halfway_is_rejected_in_time_and_reported_once(
    site: Site, state: str
) -> None:
    listener, master = site.listener()
    visitors = [Visitor(site, listener.address) for _ in range(3)]
    for visitor in visitors:
        visitor.go(state)
    _, agent = site.dialer(listener.address)
    assert agent.link is not master.link  # they delay no other client
    pass_time(listener, PATIENCE)
    for visitor in visitors:
        visitor.rest()
    master.wait(lambda: master.refusals)
    (told,) = master.refusals
    assert told.startswith("127.0.0.1:")
    assert told.endswith(f"was turned away: it did not prove itself within {PATIENCE:g} s")
    assert len(master.links) == 1


@pytest.mark.parametrize("state", STATES)
def test_garbage_in_every_state_is_rejected_and_reported_once(site: Site, state: str) -> None:
    listener, master = site.listener()
    for _ in range(3):
        visitor = Visitor(site, listener.address)
        visitor.go(state)
        os.write(visitor.handshake.sock.fileno(), b"GET / HTTP/1.1\r\n\r\n" * 10)
        visitor.rest()
    master.wait(lambda: master.refusals)
    (told,) = master.refusals
    assert told.startswith("127.0.0.1:")
    assert "the TLS handshake failed" in told
    assert master.links == []


def test_a_greeting_without_end_is_turned_away(site: Site) -> None:
    listener, master = site.listener()
    visitor = Visitor(site, listener.address)
    visitor.go("TLS proved")
    visitor.handshake.sock.send(bytes(32) + b"\xff\xff\xff\xff")
    visitor.rest()
    master.wait(lambda: master.refusals)
    assert "its greeting is longer than 65536 bytes" in master.refusals[0]


def test_a_rejected_client_has_time_to_read_the_reason_until_it_leaves(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acceptor, "_LAST_WORD", 2 * PATIENCE)
    listener, master = site.listener()
    accepting = listener._acceptor
    visitor = Visitor(site, listener.address)
    visitor.go("TLS proved")
    visitor.handshake.sock.send(bytes(32) + b"\xff\xff\xff\xff")
    master.wait(lambda: master.refusals)
    os.write(visitor.handshake.sock.fileno(), b"it has more to say")
    for _ in range(2):  # in the second turn the loop has read that
        turned = threading.Event()
        accepting.loop.call_soon(turned.set)
        assert turned.wait(PATIENCE)
    assert accepting._pending
    visitor.rest()
    wait_for(lambda: not accepting._pending)


def test_a_false_proof_is_reported_with_the_claimed_name(site: Site) -> None:
    listener, master = site.listener()
    forged = site.credentials.agent("another", "")
    with pytest.raises(authentication.Untrusted, match="does not believe"):
        say(listener.address, forged, HELLO)
    master.wait(lambda: master.refusals)
    assert "it cannot prove that it is 'stranger'" in master.refusals[0]
    assert master.proofs == []


def test_a_proven_agent_takes_no_strangers_place(site: Site) -> None:
    """Agents that wait for the watch of pods are as many as there are pods."""
    listener, master = site.listener()
    listener._knows = lambda identity: None
    visitor = Visitor(site, listener.address)
    waiting = visitor.handshake.ask(visitor._credentials, HELLO)
    while not master.proofs:
        next(waiting)
    assert len(listener._acceptor._admission) == 0
    visitor.close()


def test_a_crowd_from_one_address_is_bounded_and_blocks_no_agent(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acceptor, "_MOST", 8)
    monkeypatch.setattr(acceptor, "_FAIR_CHANCE", 60.0)
    listener, master = site.listener()
    crowd = [Visitor(site, listener.address) for _ in range(20)]
    ended = [visitor for visitor in crowd[4:] if visitor.rest() == b""]
    assert len(ended) == 16, "no more than half of the bound is for one address"
    monkeypatch.setattr(acceptor, "_FAIR_CHANCE", 0.0)
    _, agent = site.dialer(listener.address)
    agent.link.send(b"in")  # one of them had to make room
    master.wait(lambda: master.frames)
    for visitor in crowd[:4]:
        visitor.close()
    assert any("too many connections come at the same time" in told for told in master.refusals)


class ScarceListener:
    """A listening socket for which the process has no descriptor left, for a while."""

    def __init__(self, listener: socket.socket, times: int) -> None:
        self._listener = listener
        self.refusals = times

    def accept(self) -> Any:
        if self.refusals:
            self.refusals -= 1
            raise OSError(errno.EMFILE, "Too many open files")
        return self._listener.accept()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._listener, name)


def test_without_descriptors_it_goes_on_later_and_says_so_once(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acceptor, "_PAUSE", 0.05)
    listener, master = site.listener()
    scarce = ScarceListener(listener._acceptor._listener, times=4)
    monkeypatch.setattr(listener._acceptor, "_listener", scarce)
    _, agent = site.dialer(listener.address)
    assert agent.link is not master.link
    assert scarce.refusals == 0
    assert [told for told in master.refusals if "Too many open files" in told] == master.refusals
    assert len(master.refusals) == 1


def test_connections_that_break_before_they_are_taken_harm_no_other(site: Site) -> None:
    listener, master = site.listener()
    for _ in range(20):
        sock = socket.create_connection(("127.0.0.1", port_of(listener.address)), PATIENCE)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        sock.close()  # by a reset
    _, agent = site.dialer(listener.address)
    assert agent.link is not master.link


class _BreaksAfterTheCheck(socket.socket):
    """A connection that is reset right after it was found to be one."""

    other: socket.socket

    def getpeername(self) -> Any:
        found = super().getpeername()
        self.other.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        self.other.close()
        return found


def test_a_connection_that_breaks_during_its_handshake_is_closed(site: Site) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        other = socket.create_connection(server.getsockname(), PATIENCE)
        accepted, _ = server.accept()
    taken = _BreaksAfterTheCheck(fileno=accepted.detach())
    taken.other = other
    context = authentication.master_context(site.credentials.certificate)
    handshake = authentication.MasterHandshake(taken, context, site.credentials.certificate)
    with contextlib.closing(handshake.sock) as secured:
        fd = secured.fileno()
        assert fd >= 0, "its next user has to close it"
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(fd)


def test_closing_closes_unfinished_connections(site: Site) -> None:
    listener, _ = site.listener()
    visitors = [Visitor(site, listener.address) for _ in range(3)]
    visitors[1].go("hello of TLS sent")
    visitors[2].go("TLS proved")
    site.close(listener)
    ends = [threading.Thread(target=visitor.rest) for visitor in visitors]
    for end in ends:
        end.start()
    for end in ends:
        end.join(PATIENCE)
        assert not end.is_alive()


def test_nonsense_in_place_of_a_greeting_is_reported_once(site: Site) -> None:
    listener, master = site.listener()
    for _ in range(3):
        with pytest.raises(authentication.PeerClosed):
            say(listener.address, site.credentials.agent("a", ""), b"GET / HTTP/1.1")
    master.wait(lambda: master.refusals)
    site.on_loop(lambda: None)
    (told,) = [told for told in master.refusals if "no agent of Fiber" in told]
    assert told.startswith("127.0.0.1:")


@pytest.mark.parametrize("name", ["\ud800", "a" * 60_000])
def test_a_name_that_no_pod_can_have_is_not_repeated(
    site: Site, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    listener, master = site.listener()
    hello = AgentHello(Identity.of_this_process(name), "0" * 32, 0, False)
    with pytest.raises(authentication.PeerClosed):
        say(listener.address, site.credentials.agent("a", ""), hello.encode())
    master.wait(lambda: master.refusals)
    assert len(master.refusals[0]) < 500
    assert capfd.readouterr().err == ""  # no traceback for each that comes


def test_an_unwanted_agent_gets_the_reason_and_is_reported_once(site: Site) -> None:
    listener, master = site.listener()
    listener._on_agent = lambda link: f"{link.peer.name} is not wanted"
    identity = Identity.of_this_process("agent-1", "uid")

    def come() -> None:
        _, agent = site.dialer(listener.address, identity=identity)
        agent.wait(lambda: agent.events == ["lost: agent-1 is not wanted"])
        wait_for(lambda: site.on_loop(lambda: not listener._links))

    come()
    come()
    master.wait(lambda: master.refusals)
    (told,) = master.refusals
    assert told.startswith("agent-1 is not wanted (127.0.0.1:")


def test_an_agent_without_a_pod_is_reported_in_spite_of_strangers(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acceptor, "_REMEMBERED", 1)
    listener, master = site.listener()
    listener._knows = lambda identity: None
    told = listener._acceptor._refusals
    told._strangers["192.0.2.1", "it is a stranger"] = told._next_summary = float("inf")
    site.dialer(listener.address)
    master.wait(lambda: master.proofs)
    site.on_loop(lambda: None)  # the agent waits for its pod now
    pass_time(listener, PATIENCE)
    master.wait(lambda: master.refusals)
    assert master.refusals[0].startswith("the pod 'agent-1' did not appear within")


def test_a_crowd_is_reported_once_from_any_address(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acceptor, "_FAIR_CHANCE", 60.0)
    listener, master = site.listener()
    accepting, full = listener._acceptor, Admission(1, 1)
    full.enter("somebody", "192.0.2.1", accepting.loop.now())
    accepting._admission = full
    ends = []
    for number in range(3):
        ours, theirs = socket.socketpair()
        accepting.loop.call_soon(accepting._admit, theirs, f"10.0.0.{number}", f"10.0.0.{number}:1")
        ends.append(ours)
    for ours in ends:
        assert ours.recv(1) == b""
        ours.close()
    site.on_loop(lambda: None)
    assert master.refusals == [
        "10.0.0.0:1 was turned away: too many connections come at the same time"
    ]


def test_complaints_are_bounded(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(acceptor, "_REMEMBERED", 3)
    listener, master = site.listener()
    site.on_loop(lambda: None)
    for number in range(10):
        listener._acceptor.report(f"10.0.0.{number}", f"10.0.0.{number}:1", "nonsense")
    notes: Notes = master
    notes.wait(lambda: len(notes.refusals) == 4)
    assert "strangers come from many addresses" in notes.refusals[-1]
    listener._acceptor.report(
        "10.0.0.99", "10.0.0.99:1", "an agent's trouble", pool=listener._served
    )
    notes.wait(lambda: len(notes.refusals) == 5)
    assert notes.refusals[-1] == "an agent's trouble (10.0.0.99:1)"
    site.on_loop(lambda: None)
    assert len(notes.refusals) == 5


def test_an_acceptor_without_a_thread_leaves_nothing_open(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    gc.collect()
    before = sorted(os.listdir("/proc/self/fd"))
    monkeypatch.setattr(threading.Thread, "start", refuse)
    with pytest.raises(RuntimeError, match="can't start new thread"):
        acceptor.Acceptor("127.0.0.1:0", site.credentials.certificate)
    assert sorted(os.listdir("/proc/self/fd")) == before
