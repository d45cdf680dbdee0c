"""Memory and processor time of a process, as Linux counts them."""

from __future__ import annotations

import os
from typing import NamedTuple

_PAGE = os.sysconf("SC_PAGE_SIZE")
_TICKS = os.sysconf("SC_CLK_TCK")


class Usage(NamedTuple):
    """Memory and processor time of a process."""

    memory: int
    """Resident memory in bytes.  Pages that processes share count for each of them."""
    cpu: float
    """Seconds of processor time since its start, its ended children included."""


def usage_of(pid: int) -> Usage | None:
    """Return the usage of a process; None if it has ended."""
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            fields = file.read().rpartition(b")")[2].split()
    except OSError:
        return None
    if fields[0] in (b"Z", b"X"):
        return None
    user, system, children_user, children_system = map(int, fields[11:15])
    ticks = user + system + children_user + children_system
    return Usage(int(fields[21]) * _PAGE, ticks / _TICKS)
