"""How an agent's process keeps the memory of large messages.

glibc gives memory back to the kernel as soon as a large piece of it is free, and gets it anew, page
by page and zeroed, for the next message: with messages of half a megabyte that was a page fault for
each 4 KiB that an agent sent.
"""

from __future__ import annotations

import ctypes

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD = -1, -2, -3  # malloc.h

_MAPPED = 2 << 20
"""Bytes from which on a piece is memory of its own: more than a datagram has."""

_KEPT = 16 << 20
"""Bytes that may be free and are kept.  When there are more, half of that is."""


def keep_memory() -> None:
    """Keep what is free, up to a bound; where the C library is another one, nothing changes."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MAPPED)
        mallopt(_M_TRIM_THRESHOLD, _KEPT)
        mallopt(_M_TOP_PAD, _KEPT // 2)  # else nothing would be left of them
