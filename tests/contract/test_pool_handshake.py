"""The pool's Secret on the wire: the SDK's own listener and dialer take both halves of it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pynng
import pytest

from fiber._transport.credentials import Credentials
from fiber._transport.dialer import AgentDialer
from fiber._transport.handshake import Identity
from fiber._transport.link import Link
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop
from fiber.errors import AuthenticationError
from fiber_api import names
from fiber_api.certificates import Certificates, make_pool_certificates
from patience import PATIENCE

# Once used, nng keeps threads and two descriptors for as long as the process lives.  The census of
# what tests leave behind begins after the collection, and so after this.
pynng.Pair1().close()


@pytest.fixture(scope="module")
def pool() -> Certificates:
    return make_pool_certificates("es", "research")


def mounted(folder: Path, certificates: Certificates, files: Mapping[str, str]) -> Credentials:
    """What a pod reads from a volume of the Secret that shows it ``files``."""
    folder.mkdir()
    texts = certificates.texts()
    for key, file in files.items():
        (folder / file).write_text(texts[key])
    return Credentials.from_directory(folder)


class Observer:
    """Takes note of the first thing that a link, listener or dialer says."""

    def __init__(self) -> None:
        self._said = threading.Event()
        self._what: list[Any] = []

    def say(self, what: object) -> None:
        self._what.append(what)
        self._said.set()

    def on_link(self, link: Link) -> None:
        link.attach(self)
        self.say(link)

    def on_frame(self, frame: object) -> None: ...
    def on_suspect(self) -> None: ...
    def on_trusted(self) -> None: ...
    def on_lost(self, reason: str) -> None: ...

    def first(self) -> Any:
        assert self._said.wait(PATIENCE)
        return self._what[0]


class Wire:
    """A master and an agent on the loopback device, closed at the end."""

    def __init__(self) -> None:
        self._loop = Loop()
        self._loop.start_thread("test-io")
        self._closing: list[Callable[[], None]] = []

    def listen(self, credentials: Credentials) -> tuple[str, Observer]:
        observer = Observer()
        listener = MasterListener(
            self._loop,
            "127.0.0.1:0",
            credentials,
            on_agent=observer.on_link,
            on_refused=observer.say,
        )

        def close() -> None:
            closed = threading.Event()
            listener.close("", linger=0.1, then=closed.set)
            assert closed.wait(PATIENCE)

        self._closing.append(close)
        return listener.address, observer

    def dial(self, address: str, credentials: Credentials, timeout: float = PATIENCE) -> Observer:
        observer = Observer()
        dialer = AgentDialer(
            self._loop,
            address,
            credentials,
            Identity.of_this_process("es-1a2b3c4d5e", host="here"),
            on_link=observer.on_link,
            on_failed=observer.say,
            timeout=timeout,
        )
        self._closing.append(dialer.close)
        return observer

    def close(self) -> None:
        for close in reversed(self._closing):
            close()
        self._loop.stop()


@pytest.fixture
def wire() -> Iterator[Wire]:
    wire = Wire()
    try:
        yield wire
    finally:
        wire.close()


def test_an_agent_joins_its_master(wire: Wire, pool: Certificates, tmp_path: Path) -> None:
    master = mounted(tmp_path / "master", pool, names.MASTER_FILES)
    agent = mounted(tmp_path / "agent", pool, names.AGENT_FILES)
    assert agent.server_name == "master.es.research.fiber"
    address, listener = wire.listen(master)
    dialer = wire.dial(address, agent)
    assert dialer.first().peer.name == "the master"
    assert listener.first().peer.name == "es-1a2b3c4d5e"


def test_an_agent_cannot_pose_as_the_master(wire: Wire, pool: Certificates, tmp_path: Path) -> None:
    agent = mounted(tmp_path / "agent", pool, names.AGENT_FILES)
    address, _ = wire.listen(agent)
    # nng dials again and again, and nobody who is the master answers.
    assert isinstance(wire.dial(address, agent, timeout=1.0).first(), Exception)


def test_the_masters_certificate_does_not_make_an_agent(
    wire: Wire, pool: Certificates, tmp_path: Path
) -> None:
    master = mounted(tmp_path / "master", pool, names.MASTER_FILES)
    address, _ = wire.listen(master)
    assert isinstance(wire.dial(address, master).first(), AuthenticationError)


@pytest.mark.parametrize(("name", "namespace"), [("es", "other"), ("other", "research")])
def test_another_pools_agent_is_refused(
    wire: Wire, pool: Certificates, tmp_path: Path, name: str, namespace: str
) -> None:
    other = make_pool_certificates(name, namespace)
    address, _ = wire.listen(mounted(tmp_path / "master", pool, names.MASTER_FILES))
    agent = mounted(tmp_path / "agent", other, names.AGENT_FILES)
    assert isinstance(wire.dial(address, agent).first(), AuthenticationError)
