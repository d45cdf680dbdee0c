"""Free memory of the machine, and the processes that the kernel killed for lack of it."""

from __future__ import annotations

import re
from pathlib import Path

_COUNTERS = Path("/proc/vmstat")
_MEMORY = Path("/proc/meminfo")


def kills(counters: Path | None = None) -> int:
    """Return how many processes the kernel has killed for lack of memory since the machine began.

    By its counters of now, or by a copy of them.
    """
    return _number(counters or _COUNTERS, "oom_kill")


def available() -> int:
    """Bytes that programs can still get."""
    return _number(_MEMORY, "MemAvailable:") * 1024


def _number(file: Path, name: str) -> int:
    found = re.search(rf"^{name}\s+(\d+)", file.read_text(), re.MULTILINE)
    return int(found[1]) if found else 0
