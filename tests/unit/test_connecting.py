"""Connections to several addresses of one master, and listeners of both IP families."""

from __future__ import annotations

import errno
import os
import socket
from typing import NoReturn

import pytest

from fiber._transport import dialer
from fiber._transport.dialer import connect
from ports import reserved_port
from unit.link_site import Site, black_hole, port_of

PATIENCE = 3600.0
"""Seconds, longer than any test may take: an attempt that must not be waited for."""


def has_ipv6() -> bool:
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6):
            return True
    except OSError:
        return False


pytestmark = pytest.mark.skipif(not has_ipv6(), reason="this machine has no ::1")


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_the_address_that_answers_is_taken(host: str) -> None:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, 0), family=family) as server, reserved_port() as nothing:
        port = server.getsockname()[1]
        addresses = [("127.0.0.1", nothing), ("::1", nothing), (host, port)]
        with connect(addresses, PATIENCE) as sock:
            assert sock.getpeername()[:2] == (host, port)


def test_an_address_without_an_answer_does_not_delay_the_other() -> None:
    with black_hole() as silent, socket.create_server(("::1", 0), family=socket.AF_INET6) as server:
        where = server.getsockname()[:2]
        with connect([("127.0.0.1", port_of(silent)), where], PATIENCE) as sock:
            assert sock.getpeername()[:2] == where


def test_an_address_without_an_answer_times_out() -> None:
    with black_hole() as silent, reserved_port() as nothing, pytest.raises(TimeoutError):
        connect([("127.0.0.1", port_of(silent)), ("::1", nothing)], 0.1)


def test_where_all_refuse_the_error_says_so() -> None:
    with reserved_port() as nothing, pytest.raises(ConnectionRefusedError):
        connect([("127.0.0.1", nothing), ("::1", nothing)], PATIENCE)


def test_where_no_attempt_can_begin_the_first_error_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    codes = [errno.EMFILE, errno.ENETUNREACH]

    def begin(_: object) -> NoReturn:
        code = codes.pop()
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(dialer, "_begin", begin)
    with pytest.raises(OSError, match=os.strerror(errno.ENETUNREACH)):
        connect([("127.0.0.1", 1), ("::1", 1)], PATIENCE)
    assert not codes


def test_an_agent_reaches_its_master_at_one_of_two_addresses(site: Site) -> None:
    listener, master = site.listener("[::1]:0")
    assert listener.address.startswith("[::1]:")
    with reserved_port() as nothing:
        _, agent = site.dialer(f"127.0.0.1:{nothing},{listener.address}")
        agent.link.send(b"by IPv6")
        master.wait(lambda: master.frames == [b"by IPv6"])


def test_a_master_at_the_unspecified_ipv6_address_takes_both_families(site: Site) -> None:
    listener, master = site.listener("[::]:0")
    for host in ("127.0.0.1", "[::1]"):
        _, agent = site.dialer(f"{host}:{port_of(listener.address)}")
        agent.link.send(host.encode())
    master.wait(lambda: sorted(map(bytes, master.frames)) == [b"127.0.0.1", b"[::1]"])
