"""cpu_count(): affinity and the quotas of control groups, on pretended file systems."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fiber import cpu


class Machine:
    """A pretended /proc/self and control group mounts under a temporary directory."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.mountinfo: list[str] = ["22 1 0:20 / /proc rw,relatime - proc proc rw"]
        self.groups: list[str] = []

    def mount(self, kind: str, name: str, *, root: str = "/", options: str = "rw") -> Path:
        point = self.root / name
        point.mkdir(parents=True)
        escaped = str(point).replace(" ", r"\040")
        self.mountinfo.append(f"31 23 0:28 {root} {escaped} rw shared:9 - {kind} {kind} {options}")
        return point

    def quota(self) -> float:
        proc = self.root / "proc"
        proc.mkdir()
        (proc / "mountinfo").write_text("".join(f"{line}\n" for line in self.mountinfo))
        (proc / "cgroup").write_text("".join(f"{line}\n" for line in self.groups))
        return cpu._cgroup_quota(str(proc))


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def limit_v1(group: Path, quota: int, period: int = 100_000) -> None:
    group.mkdir(parents=True, exist_ok=True)
    (group / "cpu.cfs_quota_us").write_text(f"{quota}\n")
    (group / "cpu.cfs_period_us").write_text(f"{period}\n")


def limit_v2(group: Path, text: str) -> None:
    group.mkdir(parents=True, exist_ok=True)
    (group / "cpu.max").write_text(f"{text}\n")


def test_without_any_control_group_there_is_no_quota(machine: Machine) -> None:
    assert machine.quota() == float("inf")


def test_without_proc_there_is_no_quota(tmp_path: Path) -> None:
    assert cpu._cgroup_quota(str(tmp_path / "missing")) == float("inf")


def test_version_2_quota(machine: Machine) -> None:
    limit_v2(machine.mount("cgroup2", "unified"), "150000 100000")
    machine.groups.append("0::/")
    assert machine.quota() == 1.5


def test_version_2_without_limit(machine: Machine) -> None:
    limit_v2(machine.mount("cgroup2", "unified"), "max 100000")
    machine.groups.append("0::/")
    assert machine.quota() == float("inf")


def test_the_tightest_group_around_the_process_counts(machine: Machine) -> None:
    top = machine.mount("cgroup2", "unified")
    limit_v2(top / "slice", "200000 100000")
    limit_v2(top / "slice" / "job", "max 100000")
    limit_v2(top / "slice" / "job" / "step", "400000 100000")
    machine.groups.append("0::/slice/job/step")
    assert machine.quota() == 2


def test_limits_of_other_cgroups_do_not_count(machine: Machine) -> None:
    top = machine.mount("cgroup2", "unified")
    limit_v2(top / "other", "100000 100000")
    limit_v2(top / "mine", "300000 100000")
    machine.groups.append("0::/mine")
    assert machine.quota() == 3


def test_version_1_quota(machine: Machine) -> None:
    top = machine.mount("cgroup", "cpu,cpuacct", options="rw,cpu,cpuacct")
    limit_v1(top, -1)
    limit_v1(top / "docker" / "abc", 50_000)
    machine.groups += ["4:memory:/elsewhere", "3:cpu,cpuacct:/docker/abc"]
    assert machine.quota() == 0.5


def test_cpuset_and_cpuacct_are_not_the_cpu_controller(machine: Machine) -> None:
    limit_v1(machine.mount("cgroup", "cpuset", options="rw,cpuset"), 100_000)
    machine.groups.append("3:cpuset:/")
    assert machine.quota() == float("inf")


def test_mount_of_the_containers_own_group(machine: Machine) -> None:
    # Docker without a cgroup namespace: the mount shows only /docker/abc of the host.
    top = machine.mount("cgroup", "cpu", root="/docker/abc", options="rw,cpu")
    limit_v1(top, 200_000)
    machine.groups.append("3:cpu:/docker/abc")
    assert machine.quota() == 2


def test_group_outside_of_the_mount(machine: Machine) -> None:
    top = machine.mount("cgroup2", "unified", root="/pod/container")
    limit_v2(top, "200000 100000")
    machine.groups.append("0::/somewhere/else")
    assert machine.quota() == 2


def test_group_above_the_cgroup_namespace(machine: Machine) -> None:
    limit_v2(machine.mount("cgroup2", "unified"), "200000 100000")
    machine.groups.append("0::/../..")
    assert machine.quota() == 2


def test_a_limit_of_cgroup_version_1_counts_beside_version_2(machine: Machine) -> None:
    limit_v1(machine.mount("cgroup", "cpu", options="rw,cpu"), 250_000)
    machine.mount("cgroup2", "unified")
    machine.groups += ["1:cpu:/", "0::/"]
    assert machine.quota() == 2.5


def test_mount_point_with_a_space(tmp_path: Path) -> None:
    machine = Machine(tmp_path / "with space")
    limit_v2(machine.mount("cgroup2", "unified"), "100000 100000")
    machine.groups.append("0::/")
    assert machine.quota() == 1


@pytest.mark.parametrize(
    ("allowed", "quota", "expected"),
    [
        (8, float("inf"), 8),
        (8, 2.0, 2),
        (8, 1.5, 2),
        (8, 0.1, 1),
        (1, 4.0, 1),
    ],
)
def test_the_smaller_of_affinity_and_quota_at_least_one(
    monkeypatch: pytest.MonkeyPatch, allowed: int, quota: float, expected: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(allowed)))
    monkeypatch.setattr(cpu, "_cgroup_quota", lambda proc: quota)
    assert cpu.cpu_count() == expected


def test_affinity_of_this_very_process_is_followed() -> None:
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(before)})
        assert cpu.cpu_count() == 1
    finally:
        os.sched_setaffinity(0, before)
    assert 1 <= cpu.cpu_count() <= len(before)
