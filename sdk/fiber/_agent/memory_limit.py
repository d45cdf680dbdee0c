"""Detection of processes that the kernel killed because this control group was out of memory.

Such a child looks like any other that got a SIGKILL.  Control groups of both versions count these
deaths.  A container sees the count of its control group if that is mounted.
"""

from __future__ import annotations

_ROOT = "/sys/fs/cgroup"
_MEMBERSHIP = "/proc/self/cgroup"

_UNITS = (("Gi", 1 << 30), ("Mi", 1 << 20), ("Ki", 1 << 10))


class MemoryLimit:
    """Memory limit of the control group that this process is in."""

    def __init__(self, root: str = _ROOT, membership: str = _MEMBERSHIP) -> None:
        self._events, self._maximum = _files(root, membership)
        self._kills = self._count()

    def was_exceeded(self) -> bool:
        """Return whether the kernel has killed a process for memory since the last call."""
        before, self._kills = self._kills, self._count()
        return self._kills > before

    def describe(self) -> str:
        """Return a sentence with the limit as Kubernetes writes it."""
        limit = _read(self._maximum).strip()
        if limit.isdigit():
            return f"its memory limit is {_quantity(int(limit))}"
        return "no limit of its own"

    def _count(self) -> int:
        for line in _read(self._events).splitlines():
            name, _, count = line.partition(" ")
            if name == "oom_kill" and count.isdigit():
                return int(count)
        return 0


def _files(root: str, membership: str) -> tuple[str, str]:
    """Return the paths of the file that counts the deaths and the file with the limit."""
    groups = {}
    for line in _read(membership).splitlines():
        _, controllers, group = line.split(":", 2)
        groups[controllers] = group.rstrip("/")
    found = []
    # In a separate cgroup namespace the group is the root of the mount, under any name.
    for group in (groups.get("", ""), ""):
        found.append((f"{root}{group}/memory.events", f"{root}{group}/memory.max"))
    for group in (groups.get("memory", ""), ""):
        old = f"{root}/memory{group}"
        found.append((f"{old}/memory.oom_control", f"{old}/memory.limit_in_bytes"))
    return next((files for files in found if _read(files[0])), found[0])


def _quantity(limit: int) -> str:
    for unit, size in _UNITS:
        if limit % size == 0:
            return f"{limit // size}{unit}"
    return f"{limit} bytes"


def _read(path: str) -> str:
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except OSError:  # no such file, or no such group
        return ""
