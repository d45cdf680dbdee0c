"""A master's and agents' ends of links over nng, on one loop, and what they call back."""

from __future__ import annotations

import contextlib
import itertools
import select
import socket
import threading
from collections.abc import Callable, Generator, Iterator
from typing import Any, TypeVar

import pynng

from fiber._transport import authentication
from fiber._transport.acceptor import Acceptor
from fiber._transport.authentication import Identity
from fiber._transport.credentials import Credentials, MasterCredentials, OwnCredentials
from fiber._transport.dialer import AgentDialer
from fiber._transport.link import Keepalive, Link
from fiber._transport.link_protocol import Frame
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop
from patience import PATIENCE

# Once used, nng keeps threads and two descriptors for as long as the process runs. The census of
# leaks begins after the collection, and so after this.
pynng.Pair1().close()

T = TypeVar("T")
SHORT = Keepalive(heartbeat=0.1, suspect_after=0.8, lost_after=2.0)


class Notes:
    """Writes down what a link, a listener or a dialer calls back, and wakes who waits for it."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self.frames: list[Frame] = []
        self.events: list[str] = []
        self.links: list[Link] = []
        self.refusals: list[str] = []
        self.proofs: list[None] = []
        self.errors: list[Exception] = []

    def add(self, notes: list[Any], note: Any) -> None:
        with self.changed:
            notes.append(note)
            self.changed.notify_all()

    def wait(self, condition: Callable[[], Any]) -> None:
        with self.changed:
            assert self.changed.wait_for(condition, PATIENCE), vars(self)

    def wait_for_frames(self, count: int) -> None:
        self.wait(lambda: len(self.frames) >= count)

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

    def on_proven(self) -> None:
        self.add(self.proofs, None)

    def on_failed(self, error: Exception) -> None:
        self.add(self.errors, error)

    @property
    def link(self) -> Link:
        self.wait(lambda: self.links)
        return self.links[0]


class Site:
    """A loop with listeners and dialers on it, all closed at the end."""

    def __init__(self, credentials: OwnCredentials) -> None:
        self.credentials = credentials
        self.loop = Loop()
        self.loop.start_thread("test-io")
        self._closing: list[Callable[[], None]] = []
        self._names = (f"agent-{number}" for number in itertools.count(1))

    def listener(
        self,
        at: str | Acceptor = "127.0.0.1:0",
        keepalive: Keepalive = SHORT,
        credentials: MasterCredentials | None = None,
    ) -> tuple[MasterListener, Notes]:
        notes = Notes()
        listener = MasterListener(
            self.loop,
            at,
            credentials or self.credentials,
            on_agent=notes.on_link,
            on_refused=notes.on_refused,
            on_proven=notes.on_proven,
            keepalive=keepalive,
        )
        self._closing.append(lambda: self.close(listener, linger=0.1))
        return listener, notes

    def dialer(
        self,
        address: str,
        *,
        credentials: Credentials | None = None,
        identity: Identity | None = None,
        timeout: float | None = PATIENCE,
        connect: Callable[[str], socket.socket] | None = None,
    ) -> tuple[AgentDialer, Notes]:
        notes = Notes()
        if identity is None:
            identity = Identity.of_this_process(next(self._names), "uid", host="here")
        dialling = AgentDialer(
            self.loop,
            address,
            credentials or self.credentials.agent(identity.name, identity.uid),
            identity,
            on_link=notes.on_link,
            on_failed=notes.on_failed,
            timeout=timeout,
            connect=connect,
        )
        self._closing.append(dialling.close)
        return dialling, notes

    def acceptor(self) -> Acceptor:
        """Return an acceptor for several pools, which show the certificate of the site."""
        acceptor = Acceptor("127.0.0.1:0", self.credentials.certificate)
        self._closing.append(acceptor.close)
        return acceptor

    def pair(self) -> tuple[Notes, Notes]:
        listener, master = self.listener()
        _, agent = self.dialer(listener.address)
        assert agent.link is not master.link
        return master, agent

    def on_loop(self, function: Callable[[], Any]) -> Any:
        done = threading.Event()
        results: list[Any] = []

        def call() -> None:
            results.append(function())
            done.set()

        self.loop.call_soon(call)
        assert done.wait(PATIENCE)
        return results[0]

    def close(self, listener: MasterListener, reason: str = "", *, linger: float = 1.0) -> None:
        closed = threading.Event()
        listener.close(reason, linger=linger, then=closed.set)
        assert closed.wait(PATIENCE)

    def end(self) -> None:
        for close in reversed(self._closing):
            close()
        self.loop.stop()


@contextlib.contextmanager
def black_hole() -> Iterator[str]:
    """An address that answers nothing: what comes in waits for a queue that stays full."""
    with socket.create_server(("127.0.0.1", 0), backlog=0) as full, contextlib.ExitStack() as queue:
        for _ in range(2):
            waiting = queue.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(full.getsockname())
        yield f"127.0.0.1:{full.getsockname()[1]}"


def port_of(address: str) -> int:
    return int(address.rpartition(":")[2])


def wires_of(listener: MasterListener) -> list[Any]:
    return [link._connection for link in listener._links.values() if link._connection is not None]


def break_connections(listener: MasterListener) -> None:
    for wire in wires_of(listener):
        wire.break_off()


def vanish(listener: MasterListener) -> None:
    """End as a killed process would."""
    for wire in wires_of(listener):
        wire.close()
    listener._acceptor.close()


def say(address: str, credentials: Credentials, words: bytes) -> bytes:
    """Return a master's answer to the first message of a client with the right credentials."""
    sock = socket.create_connection(("127.0.0.1", port_of(address)))
    handshake = authentication.AgentHandshake(sock, authentication.agent_context())
    try:
        return complete(handshake, handshake.ask(credentials, words))[0]
    finally:
        handshake.close()


def complete(handshake: authentication._Handshake, steps: Generator[int, None, T]) -> T:
    poller = select.poll()
    while True:
        try:
            poller.register(handshake.sock, next(steps))
        except StopIteration as finished:
            value: T = finished.value
            return value
        assert poller.poll(PATIENCE * 1000)
