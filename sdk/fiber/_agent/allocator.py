"""Settings of malloc that keep the memory of large messages in an agent's process.

glibc gives large free pieces back to the kernel at once.  For the next message it gets them again,
page by page and zeroed.  With messages of half a megabyte that was a page fault for each 4 KiB that
an agent sent.
"""

from __future__ import annotations

import ctypes

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD = -1, -2, -3  # malloc.h

_MAPPED = 2 << 20
"""Bytes from which on malloc maps a piece separately: more than a datagram has."""

_KEPT = 16 << 20
"""Free bytes that malloc keeps.  Above that, it keeps half as many."""


def keep_memory() -> None:
    """Have malloc keep free memory up to a bound; do nothing with another C library than glibc."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MAPPED)
        mallopt(_M_TRIM_THRESHOLD, _KEPT)
        mallopt(_M_TOP_PAD, _KEPT // 2)  # else a trim would free all of it
