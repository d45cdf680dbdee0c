"""Fixtures of several modules: a loop, the ends of links, two hosts in one process."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

import fiber
from fiber._transport.credentials import MasterCredentials, make_credentials
from fiber._transport.loop import Loop
from fiber.connection import Connection
from hosts import Far, Hosts, Wire
from unit.executor_rig import Rig

if TYPE_CHECKING:
    from unit.link_site import Site


def _running_loop() -> Iterator[Loop]:
    running = Loop()
    running.start_thread("loop under test")
    yield running
    running.stop()


loop = pytest.fixture(_running_loop, name="loop")
module_loop = pytest.fixture(_running_loop, scope="module", name="module_loop")


@pytest.fixture(scope="module")
def credentials() -> MasterCredentials:
    return make_credentials()


@pytest.fixture
def site(credentials: MasterCredentials) -> Iterator[Site]:
    from unit.link_site import Site  # it starts nng, which is for the tests of links alone

    site = Site(credentials)
    yield site
    site.end()


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig(2)
    yield rig
    rig.close()


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    hosts = Hosts()
    yield hosts
    hosts.close()


@pytest.fixture
def wires(hosts: Hosts) -> tuple[Wire, Wire]:
    return hosts.link("b", "a")


@pytest.fixture
def far(hosts: Hosts, wires: tuple[Wire, Wire]) -> Iterator[Far]:
    with hosts.at("b"):
        yield Far(hosts)


@pytest.fixture
def far_pipe(far: Far) -> Iterator[tuple[Connection, Connection]]:
    """An end of a pipe on its host, and the other end on another."""
    here, there = fiber.Pipe()
    remote = far(there)
    there.close()
    yield here, remote
    here.close()
    remote.close()
