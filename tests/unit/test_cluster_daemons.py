"""Smoke tests of the test cluster's processes: they are found again, end, and are diagnosed."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from cluster import control_plane, diagnosis, memory, places
from cluster.daemons import Daemon, all_daemons
from cluster.shell import wait_for
from patience import PATIENCE

SLEEP = ("sleep", "300.0625")


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    monkeypatch.setattr(places, "STATE", tmp_path / "state")
    yield
    for daemon in all_daemons():
        daemon.kill()


def record_of(daemon: Daemon) -> Path:
    return places.STATE / "daemons" / f"{daemon.name}.process"


def pid_of(daemon: Daemon) -> int:
    return int(record_of(daemon).read_text().split()[0])


def test_a_daemon_is_started_once_found_again_and_killed() -> None:
    daemon = Daemon("sleeper")
    for _ in range(2):
        daemon.start(*SLEEP)
    pid = pid_of(daemon)
    assert Daemon("sleeper").runs()
    assert [found.name for found in all_daemons()] == ["sleeper"]
    # No interrupt of the terminal reaches it.
    assert os.getpgid(pid) == pid != os.getpgid(0)
    daemon.kill()
    assert not daemon.runs()
    Daemon("sleeper").start_again()
    assert daemon.runs()
    assert pid_of(daemon) != pid


def test_a_daemon_that_is_kept_is_started_again_when_it_ends_by_itself() -> None:
    daemon = Daemon("shell")
    daemon.start("sh", "-c", "echo here I am $$; exec sleep 300.0625")
    daemon.keep()

    def said() -> list[str]:
        return re.findall("here I am ([0-9]+)", daemon.log.read_text())

    wait_for("its first words", lambda: len(said()) == 1, seconds=PATIENCE)
    assert diagnosis.ends_meanwhile(all_daemons()) == ""
    os.kill(int(said()[0]), signal.SIGKILL)
    wait_for("its next words", lambda: len(said()) == 2, seconds=PATIENCE)
    assert daemon.runs()
    (end,) = daemon.ends()
    assert end.startswith("here I am ")
    assert "with status 137, and is started again" in end
    assert diagnosis.ends_meanwhile(all_daemons()) == f"shell:\n{end}"
    daemon.kill()
    assert not daemon.runs()


def test_a_daemon_inherits_no_variable() -> None:
    daemon = Daemon("printer")
    daemon.start("env")
    wait_for("its end", lambda: not daemon.runs(), seconds=PATIENCE)
    said = daemon.log.read_text()
    assert "XDG" not in said
    assert "PYTEST_CURRENT_TEST" not in said
    assert f"PATH={places.programs()}:" in said


def test_a_process_that_has_the_number_of_a_daemon_is_not_killed() -> None:
    daemon = Daemon("sleeper")
    daemon.start(*SLEEP)
    record, pid = record_of(daemon).read_text(), pid_of(daemon)
    daemon.kill()
    record_of(daemon).write_text(record.replace(str(pid), str(os.getpid()), 1))
    assert not daemon.runs()
    daemon.kill()  # and the test goes on


def test_the_controllers_get_another_rate_and_their_first_one_again() -> None:
    manager = Daemon("controller-manager")
    command = ["sh", "-c", "exec sleep 300.0625", "sh", "--bind-address=127.0.0.1"]
    manager.start(*command, "--kube-api-qps=1000", "--kube-api-burst=2000")
    before, first = manager.command, pid_of(manager)
    control_plane.limit_controllers(20)
    assert manager.command == [*command, "--kube-api-qps=20", "--kube-api-burst=30"]
    assert pid_of(manager) != first
    control_plane.limit_controllers()
    assert manager.command == before
    assert manager.runs()


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("for i in $(seq 30); do echo line $i; done; exit 3", "exit status 3"),
        ("exit 0", "log, is empty"),
        ("kill -SEGV $$", "signal 11"),
    ],
)
def test_the_diagnosis_says_how_a_daemon_ended_and_its_last_words(script: str, said: str) -> None:
    daemon = Daemon("node-2-containerd")
    daemon.start("sh", "-c", script)
    wait_for("its end", lambda: not daemon.runs(), seconds=PATIENCE)
    found = diagnosis.end_of([daemon]) or ""
    assert found.startswith("node-2-containerd has ended: ")
    assert said in found.replace(str(daemon.log), "log").replace(".log,", "log,")
    assert found.count("\nline ") == (15 if "seq" in script else 0)
    assert "`make cluster-down`" in found
    daemon.start(*SLEEP)
    assert (daemon.status(), diagnosis.end_of([daemon])) == (None, None)


def test_the_diagnosis_names_killings_and_shortages(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    daemon = Daemon("node-2-containerd")
    daemon.start("sh", "-c", "kill -KILL $$")
    wait_for("its end", lambda: not daemon.runs(), seconds=PATIENCE)
    counters = tmp_path / "vmstat"
    counters.write_text(f"pgfault 1\noom_kill {memory.kills() + 2}\n")
    monkeypatch.setattr(memory, "_COUNTERS", counters)
    monkeypatch.setattr(memory, "available", lambda: 17 << 20)
    monkeypatch.setattr(diagnosis, "_free_space", lambda: 17 << 20)
    said = diagnosis.end_of([daemon]) or ""
    assert "the kernel has killed 2 of the machine's processes for want of memory" in said
    assert "17 MiB of memory left" in said
    assert "17 MiB of disk left" in said
    assert diagnosis.silence_of([], "refused\n").startswith("the last answer: refused\n")
