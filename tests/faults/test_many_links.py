"""A thousand agents dial one master, and each is taken.  The agents benchmark has the cost."""

from __future__ import annotations

import pickle
import resource
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from faults.program import Program
from fiber._transport.credentials import OwnCredentials, make_credentials
from fiber._transport.link import Link
from fiber._transport.link_protocol import Frame
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop
from patience import PATIENCE

COUNT = 1024
PROCESSES = 2
DESCRIPTORS = 4 * COUNT

AGENTS = """
    import os, sys
    import pickle
    from fiber._transport.dialer import AgentDialer
    from fiber._transport.authentication import Identity
    from fiber._transport.loop import Loop

    class Echo:
        def __init__(self, link): self.link = link
        def on_frame(self, frame): self.link.send(frame)
        def on_suspect(self): pass
        def on_trusted(self): pass
        def on_lost(self, reason): pass

    address, folder, count = sys.argv[1:]
    credentials = pickle.load(open(folder, "rb"))
    loop = Loop()
    dialers = [
        AgentDialer(
            loop, address, credentials.agent(f"fake-{os.getpid()}-{number}", ""),
            Identity.of_this_process(f"fake-{os.getpid()}-{number}"),
            on_link=lambda link: link.attach(Echo(link)), on_failed=print, timeout=None,
        )
        for number in range(int(count))
    ]
    loop.run()
"""


class Master:
    """Master that accepts every agent and counts its messages."""

    def __init__(self, credentials: OwnCredentials) -> None:
        self.links: list[Link] = []
        self.lost: list[str] = []
        self.joined, self.answered = threading.Event(), threading.Event()
        self._answers = 0
        self.loop = Loop()
        self.loop.start_thread("test-io")
        self.listener = MasterListener(
            self.loop,
            "127.0.0.1:0",
            credentials,
            on_agent=self._on_agent,
            on_refused=lambda reason: None,  # of too many at a time, each dials again
        )

    def _on_agent(self, link: Link) -> None:
        link.attach(self)
        self.links.append(link)
        if len(self.links) == COUNT:
            self.joined.set()

    def on_frame(self, frame: Frame) -> None:
        self._answers += 1
        if self._answers == COUNT:
            self.answered.set()

    def on_suspect(self) -> None: ...
    def on_trusted(self) -> None: ...

    def on_lost(self, reason: str) -> None:
        self.lost.append(reason)

    def close(self) -> None:
        closed = threading.Event()
        self.listener.close(linger=0.1, then=closed.set)
        assert closed.wait(PATIENCE)
        self.loop.stop()


@pytest.fixture
def descriptors() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < DESCRIPTORS:
        pytest.skip(f"this user may have {hard} descriptors, and {DESCRIPTORS} are needed")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, DESCRIPTORS), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.usefixtures("descriptors")
def test_a_thousand_agents_join_and_answer(launch: Callable[..., Program], tmp_path: Path) -> None:
    credentials = make_credentials()
    (tmp_path / "agent").write_bytes(pickle.dumps(credentials))
    master = Master(credentials)
    for _ in range(PROCESSES):
        count = COUNT // PROCESSES
        launch(AGENTS, master.listener.address, str(tmp_path / "agent"), str(count))
    assert master.joined.wait(PATIENCE)
    for link in master.links:
        link.send(b"are you there?")
    assert master.answered.wait(PATIENCE)
    assert master.lost == []
    master.close()
