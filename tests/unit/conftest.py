"""Fixtures of several modules: the ends of links, and pipes between two hosts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

import fiber
from fiber._transport.credentials import OwnCredentials, make_credentials
from fiber.connection import Connection
from hosts import Far
from unit.executor_rig import Rig

if TYPE_CHECKING:
    from unit.link_site import Site


@pytest.fixture(scope="module")
def credentials() -> OwnCredentials:
    return make_credentials()


@pytest.fixture
def site(credentials: OwnCredentials, all_caught: None) -> Iterator[Site]:
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
def far_pipe(far: Far) -> Iterator[tuple[Connection, Connection]]:
    """An end of a pipe on its host, and the other end on another."""
    here, there = fiber.Pipe()
    remote = far(there)
    there.close()
    yield here, remote
    here.close()
    remote.close()
