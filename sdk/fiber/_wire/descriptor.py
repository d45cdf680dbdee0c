"""Owners of descriptors.  A descriptor is closed with its last owner, also after a signal."""

from __future__ import annotations

import mmap
import os
import select
from collections.abc import Callable
from typing import TypeAlias

Descriptor: TypeAlias = select.epoll
"""Owner of a descriptor, with ``fileno`` and ``close``.

The descriptor is closed with the last reference at the latest.  In the standard library, only
``select.epoll.fromfd`` takes over a descriptor of any kind and closes it in C, without a warning.
"""


own: Callable[[int], Descriptor] = select.epoll.fromfd
"""Take over a descriptor."""


def contents(fd: int) -> bytes | mmap.mmap:
    """Return the bytes of the file ``fd``, without moving its position, which duplicates share."""
    size = os.fstat(fd).st_size
    return mmap.mmap(fd, size, access=mmap.ACCESS_READ) if size else b""
