"""Number of CPUs that this process may use: in a container fewer than the host has."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from typing import NamedTuple

__all__ = ["cpu_count"]


def cpu_count() -> int:
    """Return the number of CPUs that this process may use, at least 1.

    It is the smaller of the affinity mask (taskset, cpuset) and the CPU quota of the control
    group (`docker run --cpus`, a pod's limit). A quota of 1.5 counts as 2, so that all of it
    is used. Differs from `multiprocessing.cpu_count()`, which counts the host's CPUs. Each
    call reads the limits again.
    """
    allowed = len(os.sched_getaffinity(0))
    return max(1, math.ceil(min(allowed, _cgroup_quota("/proc/self"))))


class _Mount(NamedTuple):
    root: str  # the control group that is seen at `point`
    point: str
    unified: bool  # version 2 of control groups


def _cgroup_quota(proc: str) -> float:
    """Return the smallest CPU quota of the process's control groups; infinity if none."""
    memberships = _memberships(f"{proc}/cgroup")
    quotas = [
        quota
        for mount in _mounts(f"{proc}/mountinfo")
        if (group := memberships.get(mount.unified)) is not None
        for directory in _ancestry(mount, group)
        if (quota := _quota(directory, mount.unified)) is not None
    ]
    return min(quotas, default=math.inf)


def _memberships(path: str) -> dict[bool, str]:
    """Return the process's control group of version 2 (key True) and of version 1 (False)."""
    groups = {}
    for line in _read(path).splitlines():
        _, controllers, group = line.split(":", 2)
        if not controllers:
            groups[True] = group
        elif "cpu" in controllers.split(","):
            groups[False] = group
    return groups


def _mounts(path: str) -> Iterator[_Mount]:
    for line in _read(path).splitlines():
        # proc(5): ids, root, mount point, options, optional fields, "-", type, source, options
        before, _, after = line.partition(" - ")
        kind, _, options = after.split(" ", 2)
        root, point = (_unescape(field) for field in before.split(" ")[3:5])
        if kind == "cgroup2":
            yield _Mount(root, point, unified=True)
        elif kind == "cgroup" and "cpu" in options.split(","):
            yield _Mount(root, point, unified=False)


def _unescape(field: str) -> str:
    return re.sub(r"\\([0-7]{3})", lambda octal: chr(int(octal[1], 8)), field)


def _ancestry(mount: _Mount, group: str) -> Iterator[str]:
    """Yield the directories of a group and of all groups around it, which limit it, too."""
    relative = os.path.relpath(group, mount.root)
    if relative.startswith(".."):
        # The group is not below the mount (a foreign namespace): take the top of the mount.
        relative = "."
    directory = os.path.normpath(os.path.join(mount.point, relative))
    while directory != mount.point:
        yield directory
        directory = os.path.dirname(directory)
    yield mount.point


def _quota(directory: str, unified: bool) -> float | None:
    if unified:
        fields = _read(f"{directory}/cpu.max").split()
    else:
        fields = [
            *_read(f"{directory}/cpu.cfs_quota_us").split(),
            *_read(f"{directory}/cpu.cfs_period_us").split(),
        ]
    match fields:
        case [limit, period] if limit.isdigit() and period.isdigit():  # not "max", not "-1"
            return int(limit) / int(period)
    return None


def _read(path: str) -> str:
    # No /proc, no such controller, a hidden group: an unreadable limit counts as no limit.
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except OSError:
        return ""
