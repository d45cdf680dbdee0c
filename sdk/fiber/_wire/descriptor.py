"""Descriptors that are closed when nobody holds them any more, wherever a signal strikes."""

from __future__ import annotations

import mmap
import os
import select
from collections.abc import Callable
from itertools import chain, starmap
from socket import SocketType
from typing import Any, TypeAlias

Descriptor: TypeAlias = select.epoll
"""The owner of a descriptor: ``fileno``, ``close``; closed at the latest with its last reference.

Of what the standard library has, ``select.epoll.fromfd`` alone takes over a descriptor of any kind
and closes it in C and without a warning.  A class with ``__del__`` would not do: a handler that
raises there leaves the descriptor open for ever.
"""


own: Callable[[int], Descriptor] = select.epoll.fromfd
"""Take over a descriptor."""


def opened(opener: Callable[..., int], *args: Any) -> Descriptor:
    """What ``opener(*args)``, a function written in C, opens.

    All is one step of the interpreter, between whose steps signals strike: there is no moment at
    which the descriptor is nobody's.
    """
    return next(map(own, starmap(opener, (args,))))


def opened_pair(
    opener: Callable[..., tuple[SocketType, SocketType]], *args: Any
) -> tuple[Descriptor, Descriptor]:
    """The same for two sockets."""
    sockets = chain.from_iterable(starmap(opener, (args,)))
    one, other = map(own, map(SocketType.detach, sockets))
    return one, other


def contents(fd: int) -> bytes | mmap.mmap:
    """The bytes of the file ``fd``, whoever else reads them by a duplicate of it."""
    size = os.fstat(fd).st_size
    return mmap.mmap(fd, size, access=mmap.ACCESS_READ) if size else b""
