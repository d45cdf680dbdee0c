"""The cluster's processes: they outlive who started them, are found again, and end for good."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from cluster import control_plane, places
from cluster.daemons import Daemon, all_daemons
from cluster.shell import ClusterError, wait_for
from patience import PATIENCE

SLEEP = ("sleep", "300.0625")


@pytest.fixture(autouse=True)
def state(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    monkeypatch.setattr(places, "STATE", tmp_path / "state")
    yield tmp_path / "state"
    for daemon in all_daemons():
        daemon.kill()


def record_of(daemon: Daemon) -> Path:
    return places.STATE / "daemons" / f"{daemon.name}.process"


def pid_of(daemon: Daemon) -> int:
    return int(record_of(daemon).read_text().split()[0])


def test_a_daemon_runs_until_it_is_killed() -> None:
    daemon = Daemon("sleeper")
    assert not daemon.runs()
    daemon.start(*SLEEP)
    assert daemon.runs()
    assert [found.name for found in all_daemons()] == ["sleeper"]
    daemon.kill()
    assert not daemon.runs()


def test_starting_it_twice_starts_it_once() -> None:
    daemon = Daemon("sleeper")
    daemon.start(*SLEEP)
    first = pid_of(daemon)
    daemon.start(*SLEEP)
    assert pid_of(daemon) == first


def test_another_process_finds_it_again() -> None:
    Daemon("sleeper").start(*SLEEP)
    assert Daemon("sleeper").runs()


def test_controllers_are_started_again_with_another_rate_and_as_before() -> None:
    manager = Daemon("controller-manager")
    command = ["sh", "-c", "exec sleep 300.0625", "sh", "--bind-address=127.0.0.1"]
    manager.start(*command, "--kube-api-qps=1000", "--kube-api-burst=2000")
    before, first = manager.command, pid_of(manager)
    control_plane.limit_controllers(20)
    assert manager.command == [*command, "--kube-api-qps=20", "--kube-api-burst=30"]
    assert manager.runs()
    assert pid_of(manager) != first
    control_plane.limit_controllers()
    assert manager.command == before
    assert manager.runs()


def test_it_is_started_again_as_it_was() -> None:
    daemon = Daemon("sleeper")
    daemon.start(*SLEEP)
    first = pid_of(daemon)
    daemon.kill()
    Daemon("sleeper").start_again()
    assert daemon.runs()
    assert pid_of(daemon) != first


def test_one_that_executes_another_program_has_not_ended() -> None:
    """Command line of a process that executes another program: it is empty for a moment."""
    daemon = Daemon("changeable")
    daemon.start("sh", "-c", 'exec sh -c "echo changed; exec sleep 300.0625"', "unchanged")
    wait_for("the other program", lambda: "changed" in daemon.log.read_text(), seconds=PATIENCE)
    assert daemon.runs()


def test_a_number_that_is_somebody_elses_by_now_is_not_killed() -> None:
    daemon = Daemon("sleeper")
    daemon.start(*SLEEP)
    record = record_of(daemon).read_text()
    pid = pid_of(daemon)
    daemon.kill()
    record_of(daemon).write_text(record.replace(str(pid), str(os.getpid()), 1))
    assert not daemon.runs()
    daemon.kill()  # and we are still here


def test_its_children_end_with_it() -> None:
    daemon = Daemon("parent")
    script = 'sleep 300.125 & echo "child $!"; wait; true'
    daemon.start("sh", "-c", script)
    wait_for("the child", lambda: "child" in daemon.log.read_text(), seconds=PATIENCE)
    child = int(daemon.log.read_text().split()[1])
    daemon.kill()
    wait_for("the end of the child", lambda: not is_alive(child), seconds=PATIENCE)


def is_alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_it_inherits_no_state_of_its_starter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SECRET_OF_THE_TESTS", "yes")
    daemon = Daemon("printer")
    daemon.start("env")
    wait_for("its end", lambda: not daemon.runs(), seconds=PATIENCE)
    assert "SECRET_OF_THE_TESTS" not in daemon.log.read_text()
    assert f"{places.programs()}:" in daemon.log.read_text()


def test_it_ignores_interrupts_of_the_terminal() -> None:
    daemon = Daemon("sleeper")
    daemon.start(*SLEEP)
    assert os.getpgid(pid_of(daemon)) == pid_of(daemon) != os.getpgid(0)


def test_waiting_ends_with_a_complaint() -> None:
    with pytest.raises(ClusterError, match="the kettle: it has no water"):
        wait_for("the kettle", lambda: False, complaint=lambda: "it has no water")


def test_waiting_ends_at_the_deadline() -> None:
    with pytest.raises(ClusterError, match=r"the kettle: not there after 0 s\nit is cold"):
        wait_for("the kettle", lambda: False, seconds=0, account=lambda: "it is cold")
