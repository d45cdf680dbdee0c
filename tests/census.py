"""Counts the processes that a test or a run started, at any depth and with any adopter.

A process is found in two ways: as a descendant, and by a marker in the environment that it was
executed with. The marker still finds an orphan, whose parent is gone; the descent still finds a
child that was forked from here, which keeps this process's own environment block.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterable
from typing import NamedTuple

Identity = tuple[int, int]
"""Number of a process, and the inode of its folder in /proc: a later process with the same number
has another inode.
"""


class Found(NamedTuple):
    """A process seen in /proc."""

    pid: int
    parent: int
    state: str  # one letter, as in ps; Z is a zombie
    command: str

    def __str__(self) -> str:
        return f"{self.pid} (parent {self.parent}, state {self.state}): {self.command}"


def read(pid: int) -> Found | None:
    """Read one process; None if it is gone."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:
            stat = file.read()
        with open(f"/proc/{pid}/cmdline", "rb") as file:
            command = file.read().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        return None
    # The name stands in parentheses and may hold any character, parentheses too.
    name, _, rest = stat.partition("(")[2].rpartition(")")
    state, parent = rest.split()[:2]
    return Found(pid, int(parent), state, command or f"[{name}]")


def everything() -> list[Found]:
    """Every process that this user can see."""
    pids = [int(name) for name in os.listdir("/proc") if name.isdigit()]
    return [found for pid in pids if (found := read(pid)) is not None]


def identities() -> frozenset[Identity]:
    """Return the identity of every process that this user can see."""
    with os.scandir("/proc") as entries:
        return frozenset((int(e.name), e.inode()) for e in entries if e.name.isdigit())


def started_by(pid: int, marker: str, strangers: frozenset[Identity] = frozenset()) -> list[Found]:
    """The processes below `pid`, and those executed with `marker` (``NAME=value``).

    `strangers` are known to be neither, which saves reading them.
    """
    found_now = (read(number) for number, _ in identities() - strangers)
    seen = [found for found in found_now if found is not None]
    family = {pid}
    grown = True
    while grown:
        children = {found.pid for found in seen if found.parent in family} - family
        grown = bool(children)
        family |= children
    return [
        found
        for found in seen
        if found.pid != pid and (found.pid in family or _carries(found.pid, marker))
    ]


def kill(found: Iterable[Found]) -> None:
    """SIGKILL for each; those that are gone already are no concern."""
    for process in found:
        try:
            os.kill(process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass  # it ended by itself between the look and the kill


def wait_until(condition: Callable[[], bool], seconds: float) -> bool:
    """Return whether `condition` came true within `seconds`. Ask rarely enough to cost nothing."""
    deadline = time.monotonic() + seconds
    pause = 0.001
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(pause)
        pause = min(pause * 2, 0.05)
    return True


def _carries(pid: int, marker: str) -> bool:
    try:
        with open(f"/proc/{pid}/environ", "rb") as file:
            return marker.encode() in file.read().split(b"\0")
    except OSError:
        return False  # gone, or another user's
