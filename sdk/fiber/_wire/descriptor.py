"""Owners of descriptors.  A descriptor is closed with its last owner, also after a signal."""

from __future__ import annotations

import mmap
import os
import select
from collections.abc import Callable
from itertools import chain, starmap
from socket import SocketType
from typing import Any, TypeAlias

Descriptor: TypeAlias = select.epoll
"""Owner of a descriptor, with ``fileno`` and ``close``.

The descriptor is closed with the last reference at the latest.  In the standard library, only
``select.epoll.fromfd`` takes over a descriptor of any kind and closes it in C, without a warning.
A class with ``__del__`` is not enough: a signal's handler that raises there leaves the descriptor
open for ever.
"""


own: Callable[[int], Descriptor] = select.epoll.fromfd
"""Take over a descriptor."""


def opened(opener: Callable[..., int], *args: Any) -> Descriptor:
    """Call ``opener(*args)``, a function written in C; return the owner of what it opens.

    The call is one step of the interpreter, and a signal's handler runs between steps.  So the
    descriptor has an owner at each moment.
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
