"""Links over nng and TLS, on the loopback device, once both ends have met."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from fiber._transport.authentication import Identity
from fiber._transport.credentials import OwnCredentials
from fiber._transport.link import Keepalive
from fiber._transport.listener import MasterListener
from patience import PATIENCE
from unit.link_site import SHORT, Site, break_connections, vanish


def test_frames_of_all_sizes_cross_both_ways(site: Site) -> None:
    master, agent = site.pair()
    frames = [b"", b"x", bytes(100), os.urandom(300_000), os.urandom(3_000_000), b"end"]
    for frame in frames:
        master.link.send(frame)
        agent.link.send(frame)
    for notes in (master, agent):
        notes.wait_for_frames(len(frames))
        assert notes.frames == frames


def test_a_flood_of_small_frames_causes_no_overflow(site: Site) -> None:
    master, agent = site.pair()
    count = 20_000
    for number in range(count):
        master.link.send(b"%d" % number)
        agent.link.send(b"%d" % number)
    for notes in (master, agent):
        notes.wait_for_frames(count)
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
        own = [frame for frame in map(bytes, master.frames) if frame.startswith(b"%d " % name)]
        assert own == [b"%d %d" % (name, number) for number in range(300)]


def test_each_side_learns_the_identity_of_the_other(site: Site) -> None:
    master, agent = site.pair()
    assert master.link.peer == Identity.of_this_process("agent-1", "uid", host="here")
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
        agent.wait_for_frames(1)
        assert agent.frames == [b"agent-%d" % number]


@pytest.mark.parametrize("break_off", [break_connections, MasterListener.break_connections])
@pytest.mark.parametrize("times", [1, 5])
def test_a_broken_connection_neither_loses_nor_repeats_a_frame(
    site: Site, times: int, break_off: Callable[[MasterListener], None]
) -> None:
    # nng may not notice the break; then the agent's suspicion makes it dial again.
    keepalive = Keepalive(heartbeat=0.1, suspect_after=0.5, lost_after=60)
    listener, master = site.listener(keepalive=keepalive)
    _, agent = site.dialer(listener.address)
    sent = [b"%d " % number * 5000 for number in range(300)]
    assert agent.link is not master.link
    for number, frame in enumerate(sent):
        master.link.send(frame)
        agent.link.send(frame)
        if number % (len(sent) // times) == 50:
            master.wait_for_frames(number // 2 + 1)
            site.on_loop(lambda: break_off(listener))
    for notes in (master, agent):
        notes.wait_for_frames(len(sent))
        assert notes.frames == sent
        assert not any("lost" in event for event in notes.events)
    assert agent.link.statistics().breaks > 0


def test_a_master_that_began_anew_refuses_the_old_session(site: Site) -> None:
    listener, former = site.listener(keepalive=Keepalive())
    _, agent = site.dialer(listener.address)
    former.link.send(b"known")
    agent.wait(lambda: agent.frames)
    site.on_loop(lambda: vanish(listener))
    _, successor = site.listener(listener.address)
    agent.wait(lambda: agent.events)
    assert "not known here" in agent.events[0]
    successor.wait(lambda: successor.refusals)
    assert "'agent-1' is not known here" in successor.refusals[0]


def test_close_gives_the_other_side_the_reason(site: Site) -> None:
    listener, master = site.listener()
    _, agent = site.dialer(listener.address)
    master.link.send(b"last words")
    site.close(listener, "the pool is closed", linger=9 * PATIENCE)
    agent.wait(lambda: agent.events)
    assert agent.frames == [b"last words"]
    assert agent.events == ["lost: the pool is closed"]
    assert master.events == []


def test_an_agent_may_close_too(site: Site) -> None:
    master, agent = site.pair()
    closed = threading.Event()
    agent.link.send(b"result")
    agent.link.close("drained", then=closed.set)
    master.wait(lambda: master.events)
    assert (master.frames, master.events) == ([b"result"], ["lost: drained"])
    assert closed.wait(PATIENCE)


@pytest.mark.slow
def test_a_blocked_loop_does_not_lose_its_peers(site: Site) -> None:
    listener, master = site.listener()
    with remote_agent(listener, site.credentials):
        master.wait(lambda: master.frames)
        site.on_loop(lambda: time.sleep(SHORT.lost_after + 1))
        count = len(master.frames)
        master.link.send(b"are you there?")
        master.wait(lambda: len(master.frames) > count)
        assert not any("lost" in event for event in master.events)


@pytest.mark.slow
def test_a_stopped_agent_is_suspect_until_it_goes_on(site: Site) -> None:
    listener, master = site.listener(keepalive=SHORT._replace(lost_after=60))
    with remote_agent(listener, site.credentials) as process:
        master.wait(lambda: master.frames)
        process.send_signal(signal.SIGSTOP)
        master.wait(lambda: master.events[-1:] == ["suspect"])
        master.link.send(b"wake up")
        process.send_signal(signal.SIGCONT)
        master.wait(lambda: b"wake up" in master.frames)
        master.wait(lambda: master.events[-1] == "trusted")


@pytest.mark.slow
def test_a_killed_agent_is_lost(site: Site) -> None:
    listener, master = site.listener()
    with remote_agent(listener, site.credentials) as process:
        master.wait(lambda: master.frames)
        process.kill()
        master.wait(lambda: master.events and "lost" in master.events[-1])
    assert master.events[-2] == "suspect"
    assert "the other side was silent for" in master.events[-1]


ECHO = """
import os, sys
from fiber._transport.credentials import Credentials
from fiber._transport.dialer import AgentDialer
from fiber._transport.authentication import Identity
from fiber._transport.link import Keepalive
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
credentials = Credentials.from_descriptor(int(os.environ["CREDENTIALS"]))
identity = Identity.of_this_process("echo")
AgentDialer(loop, sys.argv[1], credentials, identity, on_link=on_link, on_failed=on_failed)
loop.run()
"""


@contextlib.contextmanager
def remote_agent(
    listener: MasterListener, credentials: OwnCredentials
) -> Iterator[subprocess.Popen[bytes]]:
    """An agent in a process of its own that sends back what it gets."""
    path = os.pathsep.join(entry for entry in sys.path if entry)
    descriptor = credentials.agent("echo", "").to_descriptor()
    process = subprocess.Popen(
        [sys.executable, "-c", ECHO, listener.address],
        env={**os.environ, "CREDENTIALS": str(descriptor), "PYTHONPATH": path},
        pass_fds=(descriptor,),
    )
    os.close(descriptor)
    try:
        yield process
    finally:
        process.kill()
        process.wait(PATIENCE)


FORKER = """
import os, sys, threading, warnings
from fiber._transport.credentials import make_credentials
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop

loop = Loop()
loop.start_thread("io")
credentials = make_credentials()
listener = MasterListener(
    loop, "127.0.0.1:0", credentials, on_agent=print, on_refused=print
)
# From Python 3.12 on os.fork() warns of any thread, and the loop is one.
warnings.simplefilter("ignore", DeprecationWarning)
child = os.fork()
if child == 0:
    del listener, loop
    sys.exit(7)  # runs what was registered with atexit
status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
closed = threading.Event()
listener.close(then=closed.set)
closed.wait(60)
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
