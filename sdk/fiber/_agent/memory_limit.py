"""Whether the kernel has killed a process of this control group for want of memory.

A child that is killed so looks like any other that got a SIGKILL.  Version 2 of control groups
counts such deaths; elsewhere nobody knows.
"""

from __future__ import annotations

_ROOT = "/sys/fs/cgroup"
_MEMBERSHIP = "/proc/self/cgroup"

_UNITS = (("Gi", 1 << 30), ("Mi", 1 << 20), ("Ki", 1 << 10))


class MemoryLimit:
    """Watches the control group that this process is in."""

    def __init__(self, root: str = _ROOT, membership: str = _MEMBERSHIP) -> None:
        self._directory = root + _group(membership).rstrip("/")
        self._kills = self._count()

    def was_exceeded(self) -> bool:
        """Whether the kernel has killed for it since this was asked last."""
        before, self._kills = self._kills, self._count()
        return self._kills > before

    def describe(self) -> str:
        """The limit as Kubernetes writes it, in a sentence."""
        limit = _read(f"{self._directory}/memory.max").strip()
        if limit.isdigit():
            return f"its memory limit is {_quantity(int(limit))}"
        return "no limit of its own"

    def _count(self) -> int:
        for line in _read(f"{self._directory}/memory.events").splitlines():
            name, _, count = line.partition(" ")
            if name == "oom_kill" and count.isdigit():
                return int(count)
        return 0


def _group(membership: str) -> str:
    for line in _read(membership).splitlines():
        if line.startswith("0::"):
            return line.removeprefix("0::")
    return ""


def _quantity(limit: int) -> str:
    for unit, size in _UNITS:
        if limit % size == 0:
            return f"{limit // size}{unit}"
    return f"{limit} bytes"


def _read(path: str) -> str:
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except OSError:  # no such file in a root group, or in version 1
        return ""
