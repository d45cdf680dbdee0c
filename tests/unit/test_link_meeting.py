"""Agents dial, masters listen: who is found, who is trusted, who is refused."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pynng
import pytest

from faults.program import wait_for
from fiber._transport import authentication, dialer
from fiber._transport.authentication import AgentHello, Identity, MasterWelcome
from fiber._transport.credentials import Credentials, make_credentials
from fiber._transport.link import Keepalive
from fiber._transport.loop import Loop
from fiber.errors import AuthenticationError, ConfigError, LinkError, VersionMismatch
from patience import PATIENCE
from ports import reserved_port
from unit.link_site import Site, black_hole, port_of, say, vanish


def test_a_port_in_use_is_named(site: Site) -> None:
    listener, _ = site.listener()
    with pytest.raises(LinkError, match=f"cannot listen on {listener.address}: another program"):
        site.listener(listener.address)


@pytest.mark.parametrize("address", ["192.0.2.1:0", "no-such-host.invalid:0"])
def test_an_address_of_another_host_is_named(site: Site, address: str) -> None:
    with pytest.raises(LinkError, match=f"cannot listen on {address}"):
        site.listener(address)


@pytest.mark.parametrize("address", ["localhost", ":80", "localhost:http", "localhost:65536"])
def test_an_invalid_address_is_refused(site: Site, address: str) -> None:
    with pytest.raises(ConfigError, match="is no address"):
        site.listener(address)
    with pytest.raises(ConfigError, match="is no address"):
        site.dialer(address)


@pytest.fixture
def address() -> Iterator[str]:
    """An address at which nothing listens yet."""
    with reserved_port() as port:
        yield f"127.0.0.1:{port}"


def test_a_master_that_comes_later_is_found(site: Site, address: str) -> None:
    _, agent = site.dialer(address)
    _, master = site.listener(address)
    agent.link.send(b"found you")
    master.wait(lambda: master.frames == [b"found you"])


def test_the_dialer_gives_up_without_a_listener(site: Site, address: str) -> None:
    _, agent = site.dialer(address, timeout=1.0)
    agent.wait(lambda: agent.errors)
    assert isinstance(agent.errors[0], LinkError)
    assert f"no master answered at {address} within 1 s: connection refused" in str(agent.errors[0])


def test_a_link_outlives_the_time_to_find_a_master(site: Site) -> None:
    listener, master = site.listener()
    _, agent = site.dialer(listener.address, timeout=PATIENCE)
    assert agent.link is not master.link
    site.loop.now = lambda: Loop.now() + PATIENCE  # type: ignore[method-assign]  # of this loop alone
    for _ in range(2):  # in the second turn the loop has called what was due
        site.on_loop(lambda: None)
    agent.link.send(b"late")
    master.wait_for_frames(1)
    assert not agent.events
    assert not agent.errors


def test_a_malformed_name_is_given_up_in_time_and_named(site: Site) -> None:
    _, agent = site.dialer(f"{'x' * 64}.example:80", timeout=1.0)
    agent.wait(lambda: agent.errors)
    assert "within 1 s: its name is malformed: " in str(agent.errors[0])


@pytest.mark.slow
def test_an_agent_dials_again_after_a_thread_could_not_be_started(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    listener, master = site.listener()
    refusals, start = [1, 2, 3], threading.Thread.start

    def scarce(thread: threading.Thread) -> None:
        if thread.name == "fiber-dial" and refusals:
            refusals.pop()
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", scarce)
    _, agent = site.dialer(listener.address)
    assert agent.link is not master.link
    assert refusals == []


def test_the_dialer_gives_up_on_a_silent_server(site: Site) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        _, agent = site.dialer(address, timeout=1.0)
        agent.wait(lambda: agent.errors)
    assert "no master answered" in str(agent.errors[0])


def test_an_address_without_an_answer_is_soon_asked_again(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel alone would be silent for minutes, and ask where a Service led at first."""
    monkeypatch.setattr(dialer, "_CONNECT", 0.2)
    with black_hole() as address:
        dialling, agent = site.dialer(address)
        wait_for(lambda: "no answer" in dialling._obstacle)
        site.on_loop(dialling._too_late)
        agent.wait(lambda: agent.errors)
    assert "no answer within 0.2 s" in str(agent.errors[0])


@pytest.mark.parametrize("before", ["the first welcome", "another welcome"])
def test_a_host_that_vanishes_before_the_welcome_is_dialled_anew(
    site: Site, monkeypatch: pytest.MonkeyPatch, address: str, before: str
) -> None:
    monkeypatch.setattr(dialer, "_GREET", 0.3)
    with contextlib.ExitStack() as held:
        if before == "another welcome":
            listener, former = site.listener(address, Keepalive())
            _, agent = site.dialer(address)
            former.link.send(b"known")
            agent.wait(lambda: agent.frames)
            site.on_loop(lambda: vanish(listener))
        silent = held.enter_context(socket.create_server(("127.0.0.1", port_of(address))))
        if before == "the first welcome":
            _, agent = site.dialer(address, timeout=None)
        held.enter_context(silent.accept()[0])
        silent.close()
        _, master = site.listener(address)
        if before == "the first welcome":
            assert agent.link is not master.link
        else:
            master.wait(lambda: master.refusals)  # another master: it was reached, that is all


def test_without_descriptors_for_a_moment_both_sides_go_on_to_try(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusals = [pynng.OutOfFiles("Out of files", 0), pynng.OutOfFiles("Out of files", 0)]

    class Scarce(pynng.Pair1):  # type: ignore[misc]  # pynng has no types
        @property
        def recv_fd(self) -> int:
            if refusals:
                raise refusals.pop()
            return int(super().recv_fd)

    monkeypatch.setattr(pynng, "Pair1", Scarce)
    listener, master = site.listener()
    _, agent = site.dialer(listener.address)
    agent.link.send(b"in after all")
    master.wait(lambda: master.frames == [b"in after all"])
    assert refusals == []


WRONG: dict[str, Callable[[Site], Credentials]] = {
    "another run's": lambda _: make_credentials().agent("agent-1", "uid"),
    "another pool's key": lambda site: replace(
        make_credentials().agent("agent-1", "uid"), master=site.credentials.fingerprint
    ),
    "another pod's": lambda site: site.credentials.agent("agent-2", "uid"),
    "another uid": lambda site: site.credentials.agent("agent-1", "another uid"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_credentials_are_an_error_at_once(site: Site, wrong: str) -> None:
    listener, master = site.listener()
    credentials = WRONG[wrong](site)
    _, agent = site.dialer(listener.address, credentials=credentials)
    agent.wait(lambda: agent.errors)
    assert isinstance(agent.errors[0], AuthenticationError)
    assert listener.address in str(agent.errors[0])
    assert credentials.key not in str(agent.errors[0])
    assert master.links == master.proofs == []


def test_the_key_of_a_pool_does_not_suffice_to_pose_as_its_only_master(site: Site) -> None:
    impostor = Site(replace(make_credentials(), pool_key=site.credentials.pool_key))
    try:
        listener, _ = impostor.listener()
        _, agent = site.dialer(
            listener.address, credentials=site.credentials.agent("agent-1", "uid")
        )
        agent.wait(lambda: agent.errors)
        assert "not that of this agent's master" in str(agent.errors[0])
    finally:
        impostor.end()


def test_a_master_without_the_key_of_the_pool_gets_no_agent(site: Site) -> None:
    listener, _ = site.listener()
    other = replace(make_credentials().agent("agent-1", "uid"), master="")
    _, agent = site.dialer(listener.address, credentials=other)
    agent.wait(lambda: agent.errors)
    assert isinstance(agent.errors[0], AuthenticationError)
    assert agent.links == []


def test_a_certificate_that_is_no_pem_is_named(site: Site) -> None:
    broken = Site(
        replace(site.credentials, certificate=replace(site.credentials.certificate, key="nonsense"))
    )
    try:
        with pytest.raises(AuthenticationError, match="master's certificate cannot be used"):
            broken.listener()
    finally:
        broken.end()


def test_a_second_link_of_a_pod_is_refused_while_the_first_lives(site: Site) -> None:
    listener, master = site.listener()
    identity = Identity.of_this_process("agent-1", "uid")
    _, first = site.dialer(listener.address, identity=identity)
    first.link.send(b"first")
    master.wait(lambda: master.frames)
    _, second = site.dialer(listener.address, identity=identity)
    second.wait(lambda: second.errors)
    assert "'agent-1' has a link already" in str(second.errors[0])
    first.link.send(b"still there")
    master.wait(lambda: master.frames == [b"first", b"still there"])
    assert first.events == []
    assert len(master.links) == 1


def test_a_pod_whose_link_broke_may_begin_another(site: Site) -> None:
    """Dial again: the agent has given this master up, and begins anew."""
    listener, master = site.listener(keepalive=Keepalive())
    identity = Identity.of_this_process("agent-1", "uid")
    dialling, first = site.dialer(listener.address, identity=identity)
    assert first.link is not master.link
    dialling.close()
    link: Any = master.links[0]
    wait_for(lambda: site.on_loop(lambda: not link.is_connected))
    _, second = site.dialer(listener.address, identity=identity)
    assert second.link is not master.links[-1]
    master.wait(lambda: len(master.links) == 2)


def test_an_agent_that_comes_before_its_pod_is_known_waits_for_it(site: Site) -> None:
    listener, master = site.listener()
    known: list[str] = []
    listener._knows = lambda identity: "" if identity.name in known else None
    _, agent = site.dialer(listener.address)
    master.wait(lambda: master.proofs)
    assert (agent.links, agent.errors) == ([], [])
    site.on_loop(listener.look_again)
    assert (agent.links, agent.errors) == ([], [])
    known.append("agent-1")
    site.on_loop(listener.look_again)
    assert agent.link is not master.link


def test_an_agent_that_waits_and_dials_again_waits_once(site: Site) -> None:
    listener, master = site.listener()
    listener._knows = lambda _: None
    identity = Identity.of_this_process("agent-1", "uid")
    for count in (1, 2):
        site.dialer(listener.address, identity=identity)
        master.wait(lambda: len(master.proofs) >= count)  # noqa: B023 - it is called at once
    wait_for(lambda: len(listener._acceptor._pending) == 1)
    assert len(site.on_loop(lambda: list(listener._waiting))) == 1


def test_an_agent_with_the_name_of_another_pod_gets_the_reason(site: Site) -> None:
    listener, master = site.listener()
    listener._knows = lambda identity: f"{identity.uid!r} is no pod"
    _, agent = site.dialer(listener.address)
    agent.wait(lambda: agent.errors)
    assert "'uid' is no pod" in str(agent.errors[0])
    assert master.links == []


@pytest.mark.parametrize(
    ("change", "what", "theirs"),
    [
        ({"protocol": 99, "fiber": "9.9"}, "Fiber protocol", r"99 \(fiberpool 9.9\)"),
        ({"python": "3.1.4"}, "Python", "3.1.4"),
    ],
)
def test_another_version_is_refused_and_both_sides_get_both_versions(
    site: Site, change: dict[str, Any], what: str, theirs: str
) -> None:
    listener, master = site.listener()
    ours = Identity.of_this_process("agent-1", "uid")
    _, agent = site.dialer(listener.address, identity=replace(ours, **change))
    agent.wait(lambda: agent.errors)
    assert isinstance(agent.errors[0], VersionMismatch)
    master.wait(lambda: master.refusals)
    assert master.proofs  # it is the pool's, wanted or not
    of_master = f"{ours.protocol} (fiberpool" if what == "Fiber protocol" else ours.python
    for text in (str(agent.errors[0]), master.refusals[0]):
        assert text.startswith(f"{what} version mismatch")
        assert of_master in text
        assert theirs.replace("\\", "") in text
    assert agent.links == master.links == []


def test_a_proof_in_the_form_of_another_version_is_reported_as_that(site: Site) -> None:
    """Before protocol 3 the proof had no length."""
    listener, master = site.listener()
    identity = replace(Identity.of_this_process("agent-1", "uid"), protocol=2, fiber="0.1")
    hello = AgentHello(identity, "0" * 32, 0, False).encode()
    raw = socket.create_connection(("127.0.0.1", port_of(listener.address)), PATIENCE)
    with authentication.agent_context().wrap_socket(raw) as sock:
        sock.recv(authentication.SECRET_SIZE)
        sock.sendall(bytes(32) + len(hello).to_bytes(4, "big") + hello + b"\xff" * 32)
        master.wait(lambda: master.refusals)
    assert "Fiber protocol version mismatch" in master.refusals[0]
    assert "2 (fiberpool 0.1)" in master.refusals[0]


def test_another_patch_level_of_python_will_do(site: Site) -> None:
    listener, master = site.listener()
    ours = Identity.of_this_process("agent-1", "uid")
    minor = ".".join(ours.python.split(".")[:2])
    _, agent = site.dialer(listener.address, identity=replace(ours, python=f"{minor}.99"))
    assert agent.link is not master.link


def test_a_client_that_is_no_agent_is_refused(site: Site) -> None:
    listener, master = site.listener()
    with pytest.raises(authentication.PeerClosed):
        say(listener.address, site.credentials.agent("a", "uid"), b"GET / HTTP/1.1")
    master.wait(lambda: master.refusals)
    assert "no agent of Fiber" in master.refusals[0]


def test_an_agent_that_dials_again_gets_no_more_by_its_old_connection(site: Site) -> None:
    listener, master = site.listener()
    _, agent = site.dialer(listener.address)
    assert agent.link is not master.link
    hello = AgentHello(master.link.peer, next(iter(listener._links)), 0, True)
    greetings: list[bytes] = []

    class Pending:
        def welcome(self, greeting: bytes, then: object) -> None:
            assert not master.link.is_connected, "what still comes is not in the greeting"
            greetings.append(greeting)

    pending: Any = Pending()
    site.on_loop(lambda: listener._welcome(pending, hello))
    assert len(greetings) == 1


@pytest.mark.parametrize("answer", [b"HTTP/1.1 400 Bad Request", bytes(1 << 20)])
def test_a_peer_that_does_not_answer_as_a_master_is_named(
    site: Site, monkeypatch: pytest.MonkeyPatch, answer: bytes
) -> None:
    monkeypatch.setattr(MasterWelcome, "encode", lambda _: answer)
    listener, _ = site.listener()
    _, agent = site.dialer(listener.address)
    agent.wait(lambda: agent.errors)
    assert isinstance(agent.errors[0], LinkError)
    assert str(agent.errors[0]).startswith(f"the peer at {listener.address} is no master: its ")


def test_a_greeting_carries_only_identity_and_place() -> None:
    hello = AgentHello(Identity.of_this_process("agent-1", "uid"), "session", 3, True)
    assert b"PRIVATE" not in hello.encode()
