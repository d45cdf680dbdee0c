"""Diagnosis of a cluster that does not come up: which part, how it ended, why, what to do."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cluster import control_plane, diagnosis, lifecycle, memory, places
from cluster.daemons import Daemon, all_daemons
from cluster.shell import ClusterError, wait_for
from patience import PATIENCE


@pytest.fixture(autouse=True)
def state(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    monkeypatch.setattr(places, "STATE", tmp_path / "state")
    yield
    for daemon in all_daemons():
        daemon.kill()


@pytest.fixture
def ended() -> Callable[[str], str]:
    """Return the diagnosis of a daemon that has run this script and ended."""

    def say(script: str) -> str:
        daemon = Daemon("node-2-containerd")
        daemon.start("sh", "-c", script)
        wait_for("its end", lambda: not daemon.runs(), seconds=PATIENCE)
        return diagnosis.end_of([daemon]) or "nothing"

    return say


def test_running_daemons_need_no_diagnosis() -> None:
    daemon = Daemon("sleeper")
    daemon.start("sleep", "300.0625")
    assert diagnosis.end_of([daemon]) is None


def test_status_last_words_and_advice(ended: Callable[[str], str]) -> None:
    said = ended("for i in $(seq 30); do echo line $i; done; exit 3")
    assert said.startswith("node-2-containerd has ended: exit status 3\nthe end of its log, ")
    assert said.count("\nline ") == 15
    assert "\nline 30\n" in said
    assert "`make cluster-down`" in said


def test_an_empty_log_is_called_empty(ended: Callable[[str], str]) -> None:
    assert "node-2-containerd.log, is empty\n" in ended("exit 0")


def test_a_signal_is_named(ended: Callable[[str], str]) -> None:
    said = ended("kill -SEGV $$")
    assert f"signal 11 ({signal.strsignal(signal.SIGSEGV)})" in said
    assert "for want of memory" not in said


def test_the_kernels_killings_are_counted_from_its_start(
    ended: Callable[[str], str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert "for want of memory" not in ended("kill -KILL $$")
    daemon = Daemon("node-2-containerd")
    counters = tmp_path / "vmstat"
    counters.write_text(f"pgfault 1\noom_kill {memory.kills() + 2}\n")
    monkeypatch.setattr(memory, "_COUNTERS", counters)
    said = diagnosis.end_of([daemon]) or ""
    assert "the kernel has killed 2 of the machine's processes for want of memory" in said


def test_a_killed_watcher_leaves_no_status() -> None:
    daemon = Daemon("sleeper")
    daemon.start("sleep", "300.0625")
    daemon.kill()
    assert "nobody saw how" in (diagnosis.end_of([daemon]) or "")


def test_the_status_of_an_earlier_run_is_forgotten(ended: Callable[[str], str]) -> None:
    ended("exit 3")
    daemon = Daemon("node-2-containerd")
    daemon.start("sleep", "300.0625")
    assert daemon.status() is None


@pytest.mark.parametrize("scarce", ["memory", "disk"])
def test_missing_abilities_of_the_machine_are_named(
    scarce: str, ended: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ample, little = 64 << 30, 17 << 20
    monkeypatch.setattr(memory, "available", lambda: little if scarce == "memory" else ample)
    monkeypatch.setattr(diagnosis, "_free_space", lambda: little if scarce == "disk" else ample)
    said = ended("exit 1")
    assert f"17 MiB of {scarce} left" in said
    assert said.count(" left: ") == 1


def test_one_that_runs_and_does_not_answer_is_quoted() -> None:
    daemon = Daemon("apiserver")
    daemon.start("sh", "-c", "echo waiting for etcd; sleep 300.0625; true")
    wait_for("its words", lambda: "etcd" in daemon.log.read_text(), seconds=PATIENCE)
    said = diagnosis.silence_of([daemon], "connection refused\n")
    assert said.startswith("the last answer: connection refused\napiserver runs; ")
    assert "\nwaiting for etcd\n" in said


def test_simultaneous_failures_are_all_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(what: str) -> Callable[..., None]:
        def start(*_: object) -> None:
            raise ClusterError(f"{what} is not well")

        return start

    monkeypatch.setattr(lifecycle, "Pki", lambda _: None)
    monkeypatch.setattr("cluster.network.connect", lambda _: None)
    monkeypatch.setattr(control_plane, "start", fail("etcd"))
    monkeypatch.setattr("cluster.node.Node.start", fail("containerd"))
    with pytest.raises(ClusterError, match=r"^etcd is not well\ncontainerd is not well$"):
        lifecycle._start(1)
