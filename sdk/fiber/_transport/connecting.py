"""Connections to a master that has several addresses, of both IP families for instance.

The attempts begin a quarter of a second apart and run at the same time, and the first that is
answered counts (RFC 8305, Happy Eyeballs).  An address of a family without a route costs no wait.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import time
from collections.abc import Sequence
from itertools import chain, zip_longest
from typing import NamedTuple

_STAGGER = 0.25
"""Seconds between the beginnings of two attempts, as RFC 8305 recommends."""


class _Target(NamedTuple):
    family: socket.AddressFamily
    where: tuple[str | int, ...] | tuple[int, bytes]


def connect(addresses: Sequence[tuple[str, int]], patience: float) -> socket.socket:
    """Connect to the first of ``addresses`` that answers, each within ``patience`` seconds.

    TimeoutError if some have not answered; else the first OSError or UnicodeError of one.
    """
    failures: list[OSError | UnicodeError] = []
    targets = _resolve(addresses, failures)
    attempts: dict[int, socket.socket] = {}
    poller = select.poll()
    deadline = 0.0
    try:
        while targets or attempts:
            if targets:
                try:
                    sock = _begin(targets.pop(0))
                except OSError as error:
                    failures.append(error)
                    continue
                attempts[sock.fileno()] = sock
                poller.register(sock, select.POLLOUT)
                deadline = time.monotonic() + patience
            wait = _STAGGER if targets else deadline - time.monotonic()
            if wait <= 0:
                raise TimeoutError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
            for descriptor, _ in poller.poll(wait * 1000):
                poller.unregister(descriptor)
                code = attempts[descriptor].getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
                if not code:
                    return attempts.pop(descriptor)
                failures.append(OSError(code, os.strerror(code)))
                attempts.pop(descriptor).close()
        raise failures.pop(0)
    finally:
        for late in attempts.values():
            late.close()


def _resolve(
    addresses: Sequence[tuple[str, int]], failures: list[OSError | UnicodeError]
) -> list[_Target]:
    """Return all targets, IPv4 and IPv6 in turn, and add to ``failures`` for names without one."""
    found = []
    for host, port in addresses:
        try:
            answers = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            failures.append(error)
        else:
            found += [_Target(family, where) for family, _, _, _, where in answers]
    first = [target for target in found if target.family == found[0].family]
    others = [target for target in found if target.family != found[0].family]
    return [target for target in chain(*zip_longest(first, others)) if target is not None]


def _begin(target: _Target) -> socket.socket:
    """Begin to connect, without waiting for the answer."""
    sock = socket.socket(target.family, socket.SOCK_STREAM)
    try:
        sock.setblocking(False)
        code = sock.connect_ex(target.where)
        if code not in (0, errno.EINPROGRESS):
            raise OSError(code, os.strerror(code))
    except BaseException:
        sock.close()
        raise
    return sock
