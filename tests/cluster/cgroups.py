"""The cgroup of each node, under which its kubelet puts the pods."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path("/sys/fs/cgroup")
_CONTROLLERS = ("cpu", "cpuset", "memory", "pids")
_HIERARCHIES = (*_CONTROLLERS, "cpuacct", "devices", "freezer", "blkio", "systemd", "hugetlb")
_IN_A_POD = re.compile(r"/fiber-node-\d+/kubepods")


def make(name: str) -> None:
    """Make the cgroup, in the one hierarchy of version 2 or in all of version 1."""
    if (ROOT / "cgroup.controllers").exists():
        (ROOT / name).mkdir(exist_ok=True)
        _pass_on_controllers(ROOT)
        _pass_on_controllers(ROOT / name)
        return
    for hierarchy in _HIERARCHIES:
        if (ROOT / hierarchy).is_dir():
            (ROOT / hierarchy / name).mkdir(exist_ok=True)
    for knob in ("cpuset.cpus", "cpuset.mems"):  # empty in a new one, and then nothing can run
        (ROOT / "cpuset" / name / knob).write_text((ROOT / "cpuset" / knob).read_text())


def _pass_on_controllers(folder: Path) -> None:
    known = (folder / "cgroup.controllers").read_text().split()
    (folder / "cgroup.subtree_control").write_text(
        " ".join(f"+{name}" for name in _CONTROLLERS if name in known)
    )


def holds_a_pod(cgroup_of_process: str) -> bool:
    """Return whether /proc/PID/cgroup is that of a process in a pod of this cluster."""
    return _IN_A_POD.search(cgroup_of_process) is not None


def remove() -> None:
    """Remove the cgroups of all nodes, as far as nothing runs in them."""
    for hierarchy in [ROOT, *ROOT.iterdir()]:
        for top in hierarchy.glob("fiber-node-*"):
            folders = [path for path in top.rglob("*") if path.is_dir()]
            for folder in [*sorted(folders, reverse=True), top]:
                try:
                    folder.rmdir()
                except OSError:  # a process is still ending in it: it is empty, and harmless
                    pass
