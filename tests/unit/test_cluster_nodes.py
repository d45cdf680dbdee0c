"""Settings of nodes, recognition of this project's nodes, and rights to use the cluster."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from cluster import cgroups, fake_nodes, faults, lifecycle, network, places, remains
from cluster.daemons import Daemon
from cluster.lifecycle import Found
from cluster.node import Node
from cluster.pki import Pair, Pki
from cluster.shell import ClusterError


class PaperPki(Pki):
    """Certificates that are named and never made."""

    def __init__(self, folder: Path) -> None:
        self.authority = Pair(folder / "ca.crt", folder / "ca.key")


@pytest.fixture(autouse=True)
def folders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(places, "STATE", tmp_path / "state")
    monkeypatch.setattr(places, "SOCKETS", tmp_path / "sockets")


@pytest.fixture
def node(tmp_path: Path) -> Node:
    return Node(2, PaperPki(tmp_path))


def test_containerd_can_read_its_settings(node: Node) -> None:
    settings = tomllib.loads(node.containerd_settings())
    assert settings["grpc"]["address"] == str(places.socket(2))
    runtime = settings["plugins"]["io.containerd.grpc.v1.cri"]
    assert runtime["cni"]["conf_dir"].startswith(str(places.STATE))


def test_two_nodes_share_no_folder(tmp_path: Path) -> None:
    """A kubelet removes the logs of pods that it does not know, and containerd its own things."""
    one, two = (paths_of(Node(index, PaperPki(tmp_path))) for index in (1, 2))
    shared = {"/etc/resolv.conf", "/usr/lib/cni", str(tmp_path / "ca.crt")}
    assert one & two <= shared
    assert len(one - shared) > 3


def paths_of(node: Node) -> set[str]:
    serving = Pair(Path(f"/{node.name}.crt"), Path(f"/{node.name}.key"))
    found: set[str] = set()
    collect(tomllib.loads(node.containerd_settings()), found)
    collect(node.kubelet_settings(serving), found)
    return found


def collect(value: Any, found: set[str]) -> None:
    if isinstance(value, dict):
        for inner in value.values():
            collect(inner, found)
    elif isinstance(value, str) and value.removeprefix("unix://").startswith("/"):
        found.add(value)


def test_addresses_of_nodes_and_pods_do_not_overlap() -> None:
    assert places.node_ip(2) == "172.30.0.12"
    assert places.pod_range(2) == "10.244.2.0/24"
    assert places.node_ip(2) != places.HOST_IP


def test_pretended_nodes_repel_real_pods() -> None:
    manifest = fake_nodes.node(3)
    assert manifest["metadata"]["name"] == "fake-3"
    assert manifest["spec"]["taints"][0]["effect"] == "NoSchedule"
    assert manifest["metadata"]["labels"] == {fake_nodes.KEY: fake_nodes.VALUE}


@pytest.mark.parametrize(
    ("cgroup", "ours"),
    [
        ("12:memory:/fiber-node-1/kubepods/burstable/pod1/abc", True),
        ("0::/fiber-node-12/kubepods/pod1/abc", True),
        ("0::/kubepods/pod1/abc", False),
        ("0::/user.slice", False),
    ],
)
def test_processes_of_our_pods_are_known_by_their_cgroup(cgroup: str, ours: bool) -> None:
    assert cgroups.holds_a_pod(cgroup) is ours


def test_only_shims_of_our_containerds_are_ours() -> None:
    shim = b"/usr/bin/containerd-shim-runc-v2"
    socket = str(places.socket(1)).encode()
    assert remains.is_shim([shim, b"-namespace", b"k8s.io", b"-address", socket])
    assert not remains.is_shim([shim, b"-address", b"/run/containerd/containerd.sock"])
    assert not remains.is_shim([b"tail", b"-f", socket])


def test_a_node_that_is_not_there_is_named_with_those_that_are() -> None:
    places.socket(1).parent.mkdir(parents=True)
    with pytest.raises(ClusterError, match="no node node-7; there are: node-1"):
        faults.cut("node-7")


def test_a_daemon_that_is_not_there_is_named() -> None:
    with pytest.raises(ClusterError, match="no daemon apisever"):
        faults.stop("apisever")


@pytest.fixture
def running(monkeypatch: pytest.MonkeyPatch) -> None:
    """A daemon of the cluster runs, as far as can be seen."""
    etcd = Daemon("etcd")
    monkeypatch.setattr(etcd, "runs", lambda: True)
    monkeypatch.setattr(lifecycle, "all_daemons", lambda: [Daemon("apiserver"), etcd])


@pytest.mark.usefixtures("running")
def test_the_found_cluster_is_the_one_that_was_written() -> None:
    assert lifecycle.find() is None
    found = Found("/home/me/fiber", str(places.cache()), 2)
    found.write()
    assert lifecycle.find() == found
    assert found.description.endswith("2 nodes, from /home/me/fiber")


@pytest.mark.usefixtures("running")
@pytest.mark.parametrize("text", ["", "[]", '{"checkout": 1}', "not json"])
def test_a_damaged_record_is_no_cluster(text: str) -> None:
    places.STATE.mkdir()
    (places.STATE / "cluster.json").write_text(text)
    assert lifecycle.find() is None


@pytest.fixture
def whole_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network, "is_there", lambda _: True)


@pytest.mark.usefixtures("running", "whole_network")
def test_a_cluster_of_another_checkout_is_used_and_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = Found("/home/me/fiber", str(places.cache()), 3)
    found.write()
    assert lifecycle.keep_or_clear() == found
    assert "brought up from /home/me/fiber" in capsys.readouterr().err


@pytest.mark.usefixtures("running", "whole_network")
def test_a_cluster_of_other_versions_is_left_alone() -> None:
    Found("/home/me/fiber", "/cache/kubernetes-1.20.0", 2).write()
    with pytest.raises(
        ClusterError, match=r"kubernetes-1\.20\.0, 2 nodes, .* \(make cluster-down\)"
    ):
        lifecycle.keep_or_clear()


@pytest.fixture
def cleared(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Return a list with one entry for each time that the cluster was taken down."""
    times: list[bool] = []
    monkeypatch.setattr(lifecycle, "take_down", lambda: times.append(True))
    return times


@pytest.mark.usefixtures("running")
def test_remains_of_a_reboot_are_cleared(
    monkeypatch: pytest.MonkeyPatch, cleared: list[bool]
) -> None:
    Found("/home/me/fiber", str(places.cache()), 2).write()
    monkeypatch.setattr(network, "is_there", lambda _: False)
    assert lifecycle.keep_or_clear() is None
    assert cleared == [True]


@pytest.mark.usefixtures("whole_network")
def test_a_cluster_without_processes_is_cleared(cleared: list[bool]) -> None:
    """Not gone on with: a benchmark killed in it would still be in its etcd."""
    Found("/home/me/fiber", str(places.cache()), 2).write()
    assert lifecycle.find() is None
    assert lifecycle.keep_or_clear() is None
    assert cleared == [True]


def test_kubeconfigs_hold_all_they_need(tmp_path: Path) -> None:
    if not Path("/usr/bin/openssl").exists():
        pytest.skip("openssl is not installed")
    file = Pki(tmp_path / "pki").kubeconfig("admin", "admin", "system:masters")
    config = json.loads(file.read_text())
    assert config["clusters"][0]["cluster"]["server"] == places.API
    assert set(config["users"][0]["user"]) == {"client-certificate-data", "client-key-data"}
    assert file.stat().st_mode & 0o777 == 0o600
