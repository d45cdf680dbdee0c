"""Owners of descriptors.  A descriptor is closed with its last owner, also if a signal strikes."""

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
    """Call ``opener(*args)``, a function written in C; return the owner of what it opens.

    The call is one step of the interpreter, and signals strike between steps.  So there is no
    moment at which the descriptor has no owner.
    """
    return next(map(own, starmap(opener, (args,))))


def opened_pair(
    opener: Callable[..., tuple[SocketType, SocketType]], *args: Any
) -> tuple[Descriptor, Descriptor]:
    """Call ``opener(*args)``, which opens two sockets; return their owners."""
    sockets = chain.from_iterable(starmap(opener, (args,)))
    one, other = map(own, map(SocketType.detach, sockets))
    return one, other


def contents(fd: int) -> bytes | mmap.mmap:
    """Return the bytes of the file ``fd``, without moving its position, which duplicates share."""
    size = os.fstat(fd).st_size
    return mmap.mmap(fd, size, access=mmap.ACCESS_READ) if size else b""
