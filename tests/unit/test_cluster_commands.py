"""Smoke tests of the test cluster's commands and recognition of what is its own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from cluster import (
    cgroups,
    commands,
    faults,
    images,
    lifecycle,
    network,
    places,
    remains,
)
from cluster.daemons import Daemon, all_daemons
from cluster.lifecycle import Found
from cluster.node import Node
from cluster.pki import Pair, Pki
from cluster.shell import ClusterError
from patience import PATIENCE

TESTS = Path(__file__).resolve().parents[1]
SLEEP = ("sleep", "300.0625")


@pytest.fixture(autouse=True)
def _own_folders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    monkeypatch.setattr(places, "STATE", tmp_path / "state")
    monkeypatch.setattr(places, "SOCKETS", tmp_path / "sockets")
    yield
    for daemon in all_daemons():
        daemon.kill()


# -- Commands


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    given = commands.parser().parse_args(words)
    given.run(given)
    return capsys.readouterr().out


def test_the_readme_has_every_command() -> None:
    helped = commands.parser().format_help().partition("COMMAND\n")[2]
    names = re.findall(r"^    ([a-z-]+)", helped.partition("\n\n")[0], re.MULTILINE)
    readme = (TESTS / "cluster" / "README.md").read_text(encoding="utf-8")
    first_column = "".join(re.findall(r"^\| (`[^|]+) \|", readme, re.MULTILINE))
    assert names
    assert sorted(names) == sorted(re.findall(r"`([a-z-]+)`", first_column))


@pytest.mark.parametrize(
    ("words", "brought"),
    [(["up", "--nodes", "3"], None), (["up", "--images"], ":1"), (["env"], ":1"), (["env"], None)],
    ids=["up", "up-with-images", "env-with-images", "env"],
)
def test_up_and_env_print_lines_for_a_shell(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: list[str],
    brought: str | None,
) -> None:
    asked: list[object] = []
    monkeypatch.setattr(lifecycle, "up", asked.append)
    monkeypatch.setattr(images, "brought", lambda image: brought and f"{image.name}:1")
    monkeypatch.setattr(
        images, "bring_images", lambda: {image.name: f"{image.name}:1" for image in images.IMAGES}
    )
    lines = [f"export KUBECONFIG={places.KUBECONFIG}", f"export PATH={places.programs()}:$PATH"]
    if brought:
        lines.append("export FIBER_IMAGE=fiber-worker-rl:1")
    assert printed(capsys, *words).splitlines() == lines
    assert not asked if words == ["env"] else len(asked) == 1


def test_status_names_the_parts_that_do_not_run(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(network, "is_plugged_in", lambda _: False)
    assert printed(capsys, "status") == "no cluster is up\n"
    Found("/home/me/fiber", "/cache/kubernetes-1.34.4", 1).write()
    places.socket(1).parent.mkdir(parents=True)
    Daemon("etcd").start(*SLEEP)
    (places.STATE / "daemons" / "apiserver.json").write_text("[]")
    out = printed(capsys, "status")
    for line in ("1.34.4, 1 nodes, from /home/me/fiber", "node-1 is cut off", "etcd: runs"):
        assert line in out
    assert "apiserver: does not run" in out


@pytest.mark.parametrize("command", ["cut", "restore", "stop", "start"])
def test_a_fault_is_a_command(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []
    monkeypatch.setattr(faults, command, asked.append)
    printed(capsys, command, "node-1")
    assert asked == ["node-1"]


def test_a_daemon_that_could_not_be_stopped_in_good_order_is_started_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[str] = []

    def fails(_: str) -> None:
        raise ClusterError("it does not end")

    monkeypatch.setattr(faults, "stop", fails)
    monkeypatch.setattr(faults, "start", asked.append)
    with pytest.raises(ClusterError, match="it does not end"), faults.stopped("apiserver"):
        pass
    assert asked == ["apiserver"]


def test_an_error_is_a_sentence_and_not_a_traceback() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "cluster", "cut", "node-99"],
        cwd=TESTS,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("cluster: there is no node node-99; there are: ")
    assert "Traceback" not in done.stderr
    with pytest.raises(ClusterError, match="no daemon apisever"):
        faults.stop("apisever")


# -- What belongs to the cluster


class PaperPki(Pki):
    """Certificates that are named and never made."""

    def __init__(self, folder: Path) -> None:
        self.authority = Pair(folder / "ca.crt", folder / "ca.key")


def test_settings_that_are_the_same_are_not_written_again(tmp_path: Path) -> None:
    node = Node(1, PaperPki(tmp_path))
    (places.STATE / "conf" / "node-1").mkdir(parents=True)
    file = node.write("proxy.yaml", {"mode": "iptables"})
    os.utime(file, (0, 0))
    node.write("proxy.yaml", {"mode": "iptables"})
    assert file.stat().st_mtime == 0
    node.write("proxy.yaml", {"mode": "nftables"})
    assert file.stat().st_mtime > 0
    assert "nftables" in file.read_text()


def test_nodes_share_no_folder_of_containerd(tmp_path: Path) -> None:
    roots = set()
    for index in (1, 2):
        settings = tomllib.loads(Node(index, PaperPki(tmp_path)).containerd_settings())
        assert settings["grpc"]["address"] == str(places.socket(index))
        roots |= {settings["root"], settings["state"]}
    assert len(roots) == 4


@pytest.mark.parametrize(
    ("cgroup", "ours"),
    [
        ("12:memory:/fiber-node-1/kubepods/burstable/pod1/abc", True),
        ("0::/fiber-node-12/kubepods/pod1/abc", True),
        ("0::/kubepods/pod1/abc", False),
        ("0::/user.slice", False),
    ],
)
def test_a_process_of_our_pods_is_known_by_its_cgroup(cgroup: str, ours: bool) -> None:
    assert cgroups.holds_a_pod(cgroup) is ours


def test_a_shim_belongs_to_the_cluster_whose_containerd_it_names() -> None:
    shim = b"/usr/bin/containerd-shim-runc-v2"
    socket = str(places.socket(1)).encode()
    assert remains.is_shim([shim, b"-namespace", b"k8s.io", b"-address", socket])
    assert not remains.is_shim([shim, b"-address", b"/run/containerd/containerd.sock"])
    assert not remains.is_shim([b"tail", b"-f", socket])


@pytest.mark.parametrize(
    ("runs", "whole", "cleared"),
    [(True, True, False), (True, False, True), (False, True, True)],
    ids=["whole", "after-a-reboot", "without-processes"],
)
def test_a_whole_cluster_is_used_and_remains_of_one_are_cleared(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    runs: bool,
    whole: bool,
    cleared: bool,
) -> None:
    times: list[bool] = []
    monkeypatch.setattr(lifecycle, "take_down", lambda: times.append(True))
    monkeypatch.setattr(network, "is_there", lambda _: whole)
    if runs:
        Daemon("etcd").start(*SLEEP)
    found = Found("/home/me/fiber", str(places.cache()), 2)
    found.write()
    assert lifecycle.find() == (found if runs else None)
    assert lifecycle.keep_or_clear() == (None if cleared else found)
    assert bool(times) is cleared
    if not cleared:
        assert "brought up from /home/me/fiber" in capsys.readouterr().err


def test_a_cluster_of_other_versions_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network, "is_there", lambda _: True)
    Daemon("etcd").start(*SLEEP)
    Found("/home/me/fiber", "/cache/kubernetes-1.20.0", 2).write()
    with pytest.raises(ClusterError, match=r"1\.20\.0, 2 nodes, .* \(make cluster-down\)"):
        lifecycle.keep_or_clear()


@pytest.mark.parametrize("text", ["", "[]", '{"checkout": 1}', "not json"])
def test_a_damaged_record_is_no_cluster(text: str) -> None:
    Daemon("etcd").start(*SLEEP)
    (places.STATE / "cluster.json").write_text(text)
    assert lifecycle.find() is None
