"""Facts of /proc: the descendants of a process, and the memory that they hold."""

from __future__ import annotations

import ctypes
import os
from collections import defaultdict
from pathlib import Path

_PR_SET_CHILD_SUBREAPER = 36


def adopt_orphans() -> None:
    """Become the parent of every process below this one whose parent dies, so that none gets
    away."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def children_of_all(*, zombies: bool = False) -> dict[int, list[int]]:
    """Return the processes by parent; with `zombies`, also those that ended and were not waited
    for."""
    children: dict[int, list[int]] = defaultdict(list)
    for entry in os.listdir("/proc"):
        if entry.isdigit() and (stat := _read(f"/proc/{entry}/stat")):
            # The name stands in parentheses and may hold any characters, parentheses too.
            state, parent = stat.rpartition(")")[2].split()[:2]
            if zombies or state != "Z":
                children[int(parent)].append(int(entry))
    return children


def descendants(pid: int) -> list[int]:
    """Return the living processes below `pid`, without itself."""
    children, found, ahead = children_of_all(), [], [pid]
    while ahead:
        below = children.get(ahead.pop(), [])
        found += below
        ahead += below
    return found


def runs(pid: int) -> bool:
    """Return whether the process is there and is no zombie."""
    stat = _read(f"/proc/{pid}/stat")
    return bool(stat) and stat.rpartition(")")[2].split()[0] != "Z"


def memory(pid: int) -> int:
    """Return bytes held by `pid` and all below it: PSS, where a page shared by n counts 1/n for
    each."""
    return sum(pss(each) for each in (pid, *descendants(pid)))


def name_of(pid: int) -> str:
    """Return the first words of its command line, or its short name."""
    words = _read(f"/proc/{pid}/cmdline").replace("\0", " ").strip()
    return (words or _read(f"/proc/{pid}/comm").strip() or "gone")[:80]


def pss(pid: int) -> int:
    """Return bytes held by `pid` alone, as `memory` counts; 0 if it is gone."""
    for line in _read(f"/proc/{pid}/smaps_rollup").splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) * 1024
    return 0


def _read(path: str) -> str:
    try:
        return Path(path).read_text(errors="replace")
    except OSError:
        # It ended between the listing and this look, so it counts as never seen.
        return ""
