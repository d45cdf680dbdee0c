"""Two hosts in one process, for the tests of what is used from another host."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import fiber
from fiber.connection import Connection
from hosts import Far, Hosts, Wire


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
def pipe(far: Far) -> Iterator[tuple[Connection, Connection]]:
    """An end of a pipe on its host, and the other end on another."""
    here, there = fiber.Pipe()
    remote = far(there)
    there.close()
    yield here, remote
    here.close()
    remote.close()
