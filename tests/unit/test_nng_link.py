"""Links over nng and TLS, on the loopback device."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pynng
import pytest

from fiber._transport.credentials import Credentials, MasterCredentials, make_credentials
from fiber._transport.dialer import AgentDialer
from fiber._transport.handshake import Hello, Identity
from fiber._transport.link import Link, Patience
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop
from fiber._transport.nng import Socket, url_of
from fiber._transport.session import Frame
from fiber.errors import AuthenticationError, ConfigError, LinkError, VersionMismatch

# Once used, nng keeps threads and two descriptors for as long as the process lives.  The census of
# what tests leave behind begins after the collection, and so after this.
pynng.Pair1().close()

DEADLINE = 10.0
SHORT = Patience(heartbeat=0.1, suspect_after=0.8, lost_after=2.0)


class Notes:
    """Writes down what a link, a listener or a dialer calls back, and wakes who waits for it."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self.frames: list[Frame] = []
        self.events: list[str] = []
        self.links: list[Link] = []
        self.refusals: list[str] = []
        self.errors: list[Exception] = []

    def add(self, notes: list[Any], note: Any) -> None:
        with self.changed:
            notes.append(note)
            self.changed.notify_all()

    def wait(self, condition: Callable[[], Any]) -> None:
        with self.changed:
            assert self.changed.wait_for(condition, DEADLINE), vars(self)

    def on_frame(self, frame: Frame) -> None:
        self.add(self.frames, frame)

    def on_suspect(self) -> None:
        self.add(self.events, "suspect")

    def on_trusted(self) -> None:
        self.add(self.events, "trusted")

    def on_lost(self, reason: str) -> None:
        self.add(self.events, f"lost: {reason}")

    def on_link(self, link: Link) -> None:
        link.attach(self)
        self.add(self.links, link)

    def on_refused(self, reason: str) -> None:
        self.add(self.refusals, reason)

    def on_failed(self, error: Exception) -> None:
        self.add(self.errors, error)

    @property
    def link(self) -> Link:
        self.wait(lambda: self.links)
        return self.links[0]


class Site:
    """A loop with listeners and dialers on it, all closed at the end."""

    def __init__(self, credentials: MasterCredentials) -> None:
        self.credentials = credentials
        self.loop = Loop()
        self.loop.start_thread("test-io")
        self._closing: list[Callable[[], None]] = []

    def listener(
        self, address: str = "127.0.0.1:0", patience: Patience = SHORT
    ) -> tuple[MasterListener, Notes]:
        notes = Notes()
        listener = MasterListener(
            self.loop,
            address,
            self.credentials,
            on_agent=notes.on_link,
            on_refused=notes.on_refused,
            patience=patience,
        )
        self._closing.append(lambda: self.close(listener, linger=0.1))
        return listener, notes

    def dialer(
        self,
        address: str,
        *,
        credentials: Credentials | None = None,
        identity: Identity | None = None,
        timeout: float = DEADLINE,
    ) -> tuple[AgentDialer, Notes]:
        notes = Notes()
        dialer = AgentDialer(
            self.loop,
            address,
            credentials or self.credentials.agent_half(),
            identity or Identity.of_this_process("agent-1", host="here"),
            on_link=notes.on_link,
            on_failed=notes.on_failed,
            timeout=timeout,
        )
        self._closing.append(dialer.close)
        return dialer, notes

    def pair(self) -> tuple[Notes, Notes]:
        listener, master = self.listener()
        _, agent = self.dialer(listener.address)
        assert agent.link is not master.link
        return master, agent

    def on_loop(self, function: Callable[[], Any]) -> Any:
        done, results = threading.Event(), []
        self.loop.call_soon(lambda: (results.append(function()), done.set())[0])
        assert done.wait(DEADLINE)
        return results[0]

    def close(self, listener: MasterListener, reason: str = "", *, linger: float = 1.0) -> None:
        closed = threading.Event()
        listener.close(reason, linger=linger, then=closed.set)
        assert closed.wait(DEADLINE)

    def end(self) -> None:
        for close in reversed(self._closing):
            close()
        self.loop.stop()


@pytest.fixture(scope="module")
def credentials() -> MasterCredentials:
    return make_credentials("test")


@pytest.fixture
def site(credentials: MasterCredentials) -> Iterator[Site]:
    site = Site(credentials)
    try:
        yield site
    finally:
        site.end()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def break_connections(listener: MasterListener) -> None:
    for pipe in list(listener._socket._pipes.values()):
        pipe.close()


def test_frames_of_all_sizes_cross_both_ways(site: Site) -> None:
    master, agent = site.pair()
    frames = [b"", b"x", bytes(100), os.urandom(300_000), os.urandom(3_000_000), b"end"]
    for frame in frames:
        master.link.send(frame)
        agent.link.send(frame)
    for notes in (master, agent):
        notes.wait(lambda notes=notes: len(notes.frames) == len(frames))
        assert notes.frames == frames


def test_a_flood_of_small_frames_overflows_nothing(site: Site) -> None:
    master, agent = site.pair()
    count = 20_000
    for number in range(count):
        master.link.send(b"%d" % number)
        agent.link.send(b"%d" % number)
    for notes in (master, agent):
        notes.wait(lambda notes=notes: len(notes.frames) == count)
        assert notes.frames == [b"%d" % number for number in range(count)]
        assert notes.link.statistics().missed == 0


def test_any_thread_may_send(site: Site) -> None:
    master, agent = site.pair()

    def send(name: int) -> None:
        for number in range(300):
            agent.link.send(b"%d %d" % (name, number))

    threads = [threading.Thread(target=send, args=(name,)) for name in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    master.wait(lambda: len(master.frames) == 4 * 300)
    for name in range(4):
        own = [frame for frame in master.frames if frame.startswith(b"%d " % name)]
        assert own == [b"%d %d" % (name, number) for number in range(300)]


def test_each_side_learns_who_the_other_is(site: Site) -> None:
    master, agent = site.pair()
    assert master.link.peer == Identity.of_this_process("agent-1", host="here")
    assert agent.link.peer.name == "the master"


def test_many_agents_share_one_socket(site: Site) -> None:
    listener, master = site.listener()
    agents = [
        site.dialer(listener.address, identity=Identity.of_this_process(f"agent-{number}"))[1]
        for number in range(20)
    ]
    for number, agent in enumerate(agents):
        agent.link.send(b"I am %d" % number)
    master.wait(lambda: len(master.links) == len(agents) == len(master.frames))
    for link in master.links:
        link.send(link.peer.name.encode())
    for number, agent in enumerate(agents):
        agent.wait(lambda agent=agent: agent.frames)
        assert agent.frames == [b"agent-%d" % number]


def test_a_port_in_use_is_named(site: Site) -> None:
    listener, _ = site.listener()
    with pytest.raises(LinkError, match=f"cannot listen on {listener.address}: another program"):
        site.listener(listener.address)


@pytest.mark.parametrize("address", ["192.0.2.1:0", "no-such-host.invalid:0"])
def test_an_address_that_is_not_ours_is_named(site: Site, address: str) -> None:
    with pytest.raises(LinkError, match=f"cannot listen on {address}"):
        site.listener(address)


@pytest.mark.parametrize("address", ["localhost", ":80", "localhost:http", "localhost:65536"])
def test_what_is_no_address_is_refused(site: Site, address: str) -> None:
    with pytest.raises(ConfigError, match="is no address"):
        site.listener(address)
    with pytest.raises(ConfigError, match="is no address"):
        site.dialer(address)


def test_a_master_that_comes_later_is_found(site: Site) -> None:
    address = f"127.0.0.1:{free_port()}"
    _, agent = site.dialer(address)
    _, master = site.listener(address)
    agent.link.send(b"found you")
    master.wait(lambda: master.frames == [b"found you"])


def test_where_nobody_listens_the_dialer_gives_up(site: Site) -> None:
    address = f"127.0.0.1:{free_port()}"
    _, agent = site.dialer(address, timeout=0.3)
    agent.wait(lambda: agent.errors)
    assert isinstance(agent.errors[0], LinkError)
    assert f"no master answered at {address} within 0.3 s: connection refused" in str(
        agent.errors[0]
    )


def test_what_takes_connections_and_says_nothing_is_given_up(site: Site) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        _, agent = site.dialer(address, timeout=0.3)
        agent.wait(lambda: agent.errors)
    assert "no master answered" in str(agent.errors[0])


@pytest.mark.parametrize("wrong", ["other run", "other name", "the agent's certificate"])
def test_wrong_credentials_are_an_error_at_once(site: Site, wrong: str) -> None:
    listener, _ = site.listener()
    agent_half = site.credentials.agent_half()
    if wrong == "other run":
        agent_half = make_credentials("test").agent_half()
    elif wrong == "other name":
        agent_half = replace(agent_half, server_name="master.other.fiber")
    else:
        foreign = make_credentials("test").agent_half()
        agent_half = replace(agent_half, certificate=foreign.certificate, key=foreign.key)
    _, agent = site.dialer(listener.address, credentials=agent_half)
    agent.wait(lambda: agent.errors)
    assert isinstance(agent.errors[0], AuthenticationError)
    assert listener.address in str(agent.errors[0])
    assert "PRIVATE" not in str(agent.errors[0])


def test_an_agent_cannot_pose_as_the_master(site: Site) -> None:
    half = site.credentials.agent_half()
    impostor = Site(replace(site.credentials, certificate=half.certificate, key=half.key))
    try:
        listener, _ = impostor.listener()
        _, agent = site.dialer(listener.address, timeout=1)
        agent.wait(lambda: agent.errors)
        assert agent.links == []
    finally:
        impostor.end()


def test_credentials_that_are_no_pem_are_named(site: Site) -> None:
    broken = replace(site.credentials.agent_half(), key="nonsense")
    with pytest.raises(AuthenticationError, match=r"credentials for master.test.fiber cannot be"):
        site.dialer("127.0.0.1:1", credentials=broken)


@pytest.mark.parametrize(
    ("change", "what", "theirs"),
    [
        ({"protocol": 99, "fiber": "9.9"}, "Fiber protocol", r"99 \(fiberpool 9.9\)"),
        ({"python": "3.1.4"}, "Python", "3.1.4"),
    ],
)
def test_another_version_is_refused_and_both_sides_hear_both(
    site: Site, change: dict[str, Any], what: str, theirs: str
) -> None:
    listener, master = site.listener()
    ours = Identity.of_this_process("agent-1")
    _, agent = site.dialer(listener.address, identity=replace(ours, **change))
    agent.wait(lambda: agent.errors)
    assert isinstance(agent.errors[0], VersionMismatch)
    master.wait(lambda: master.refusals)
    of_master = f"{ours.protocol} (fiberpool" if what == "Fiber protocol" else ours.python
    for text in (str(agent.errors[0]), master.refusals[0]):
        assert text.startswith(f"{what} version mismatch")
        assert of_master in text
        assert theirs.replace("\\", "") in text
    assert agent.links == master.links == []


def test_another_patch_level_of_python_will_do(site: Site) -> None:
    listener, master = site.listener()
    ours = Identity.of_this_process("agent-1")
    minor = ".".join(ours.python.split(".")[:2])
    _, agent = site.dialer(listener.address, identity=replace(ours, python=f"{minor}.99"))
    assert agent.link is not master.link


def test_who_is_no_agent_is_refused(site: Site) -> None:
    listener, master = site.listener()
    stranger = Socket(
        site.loop,
        site.credentials.agent_half(),
        dials=True,
        on_message=lambda *_: None,
        on_gone=lambda _: None,
        on_pipe=lambda pipe: pipe.put(b"GET / HTTP/1.1"),
    )
    stranger.dial(url_of(listener.address))
    master.wait(lambda: master.refusals)
    site.on_loop(stranger.close)
    assert "no agent of Fiber" in master.refusals[0]


@pytest.mark.parametrize("times", [1, 5])
def test_a_broken_connection_loses_and_repeats_nothing(site: Site, times: int) -> None:
    # nng may not notice the break; then the agent's suspicion makes it dial again.
    patience = Patience(heartbeat=0.1, suspect_after=0.5, lost_after=60)
    listener, master = site.listener(patience=patience)
    _, agent = site.dialer(listener.address)
    sent = [b"%d " % number * 5000 for number in range(300)]
    assert agent.link is not master.link
    for number, frame in enumerate(sent):
        master.link.send(frame)
        agent.link.send(frame)
        if number % (len(sent) // times) == 50:
            master.wait(lambda number=number: len(master.frames) > number // 2)
            site.on_loop(lambda: break_connections(listener))
    for notes in (master, agent):
        notes.wait(lambda notes=notes: len(notes.frames) == len(sent))
        assert notes.frames == sent
        assert not any("lost" in event for event in notes.events)
    assert agent.link.statistics().breaks > 0


def test_a_master_that_began_anew_refuses_the_old_session(site: Site) -> None:
    listener, _ = site.listener(patience=Patience())
    _, agent = site.dialer(listener.address)
    assert agent.link
    site.on_loop(listener._socket.close)  # as a killed process would
    _, successor = site.listener(listener.address)
    agent.wait(lambda: agent.events)
    assert "not known here" in agent.events[0]
    successor.wait(lambda: successor.refusals)
    assert "'agent-1' is not known here" in successor.refusals[0]


def test_close_tells_the_other_side_why(site: Site) -> None:
    listener, master = site.listener()
    _, agent = site.dialer(listener.address)
    master.link.send(b"last words")
    began = time.monotonic()
    site.close(listener, "the pool is closed", linger=5)
    agent.wait(lambda: agent.events)
    assert agent.frames == [b"last words"]
    assert agent.events == ["lost: the pool is closed"]
    assert master.events == []
    assert time.monotonic() - began < 3


def test_an_agent_may_close_too(site: Site) -> None:
    master, agent = site.pair()
    closed = threading.Event()
    agent.link.send(b"result")
    agent.link.close("drained", then=closed.set)
    master.wait(lambda: master.events)
    assert (master.frames, master.events) == ([b"result"], ["lost: drained"])
    assert closed.wait(DEADLINE)


def test_a_blocked_loop_does_not_lose_its_peers(site: Site) -> None:
    listener, master = site.listener()
    with remote_agent(listener, site.credentials):
        master.wait(lambda: master.frames)
        site.on_loop(lambda: time.sleep(SHORT.lost_after + 1))
        count = len(master.frames)
        master.link.send(b"are you there?")
        master.wait(lambda: len(master.frames) > count)
        assert not any("lost" in event for event in master.events)


def test_a_stopped_agent_is_suspect_until_it_goes_on(site: Site) -> None:
    listener, master = site.listener(patience=SHORT._replace(lost_after=60))
    with remote_agent(listener, site.credentials) as process:
        master.wait(lambda: master.frames)
        process.send_signal(signal.SIGSTOP)
        master.wait(lambda: master.events[-1:] == ["suspect"])
        master.link.send(b"wake up")
        process.send_signal(signal.SIGCONT)
        master.wait(lambda: b"wake up" in master.frames)
        master.wait(lambda: master.events[-1] == "trusted")


def test_a_killed_agent_is_lost(site: Site) -> None:
    listener, master = site.listener()
    with remote_agent(listener, site.credentials) as process:
        master.wait(lambda: master.frames)
        process.kill()
        master.wait(lambda: master.events and "lost" in master.events[-1])
    assert master.events[-2] == "suspect"
    assert "nothing was heard for" in master.events[-1]


ECHO = """
import os, sys
from fiber._transport.credentials import Credentials
from fiber._transport.dialer import AgentDialer
from fiber._transport.handshake import Identity
from fiber._transport.link import Patience
from fiber._transport.loop import Loop

class Echo:
    def on_frame(self, frame): self.link.send(frame)
    def on_suspect(self): pass
    def on_trusted(self): pass
    def on_lost(self, reason): loop.stop()

def on_link(link):
    echo.link = link
    link.attach(echo)
    link.send(b"ready")

def on_failed(error):
    print(error, file=sys.stderr)
    loop.stop()

echo, loop = Echo(), Loop()
credentials = Credentials.from_environment(os.environ["CREDENTIALS"])
identity = Identity.of_this_process("echo")
AgentDialer(loop, sys.argv[1], credentials, identity, on_link=on_link, on_failed=on_failed)
loop.run()
"""


@contextlib.contextmanager
def remote_agent(
    listener: MasterListener, credentials: MasterCredentials
) -> Iterator[subprocess.Popen[bytes]]:
    """An agent in a process of its own that sends back what it gets."""
    path = os.pathsep.join(entry for entry in sys.path if entry)
    environment = {"CREDENTIALS": credentials.agent_half().to_environment(), "PYTHONPATH": path}
    process = subprocess.Popen(
        [sys.executable, "-c", ECHO, listener.address], env={**os.environ, **environment}
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait(DEADLINE)


FORKER = """
import os, sys, threading
from fiber._transport.credentials import make_credentials
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop

loop = Loop()
loop.start_thread("io")
credentials = make_credentials("test")
listener = MasterListener(
    loop, "127.0.0.1:0", credentials, on_agent=print, on_refused=print
)
child = os.fork()
if child == 0:
    del listener, loop
    sys.exit(7)  # runs what was registered with atexit
status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
closed = threading.Event()
listener.close(then=closed.set)
closed.wait(10)
loop.stop()
sys.exit(status)
"""


def test_a_fork_leaves_the_socket_to_the_parent() -> None:
    path = os.pathsep.join(entry for entry in sys.path if entry)
    done = subprocess.run(
        [sys.executable, "-c", FORKER],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (7, "")


def test_a_greeting_carries_nothing_but_who_and_where() -> None:
    hello = Hello(Identity.of_this_process("agent-1"), "session", 3, True)
    assert b"PRIVATE" not in hello.encode()
