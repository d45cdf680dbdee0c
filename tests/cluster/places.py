"""Paths of the cluster's programs, state and sockets, and its addresses.

There is one such cluster on a machine: names of bridges, network namespaces and cgroups are the
machine's. Programs are shared by all checkouts that ask for the same versions.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parent
CHECKOUT = HERE.parents[1]


class Source(NamedTuple):
    """Input of one `go build`."""

    folder: str
    """Folder of the Go module in this repository that names all versions."""
    package: str
    module: str
    """The module whose version is that of the programs."""
    programs: tuple[str, ...]


SOURCES = {
    "kubernetes": Source(
        "kubernetes",
        ".",
        "k8s.io/kubernetes",
        (
            "etcd",
            "kube-apiserver",
            "kube-controller-manager",
            "kube-scheduler",
            "kubelet",
            "kube-proxy",
            "kubectl",
        ),
    ),
    "helm": Source("kubernetes", "helm.sh/helm/v3/cmd/helm", "helm.sh/helm/v3", ("helm",)),
    "kwok": Source("kwok", "sigs.k8s.io/kwok/cmd/kwok", "sigs.k8s.io/kwok", ("kwok",)),
}

STATE = Path("/var/lib/fiber-cluster")
SOCKETS = Path("/run/fiber-cluster")
# Outside of the state, which is deleted while the lock is held.
LOCK = Path("/run/fiber-cluster.lock")
PACKAGES_LOCK = Path("/run/fiber-packages.lock")
KUBECONFIG = STATE / "pki" / "admin.kubeconfig"

BRIDGE = "fbr0"
HOST_IP = "172.30.0.1"
SERVICE_RANGE, SERVICE_IP = "10.96.0.0/16", "10.96.0.1"
POD_RANGE = "10.244.0.0/16"
API = f"https://{HOST_IP}:6443"


def version(source: str) -> str:
    """Return the version of this source, without its v."""
    folder, module = SOURCES[source].folder, SOURCES[source].module
    text = (HERE / folder / "go.mod").read_text(encoding="utf-8")
    found = re.search(rf"^(?:require |\t){re.escape(module)} v(\S+)", text, re.MULTILINE)
    if found is None:
        raise ValueError(f"{folder}/go.mod has no line `require {module} v…`")
    return found[1]


def cache() -> Path:
    """The folder of the built programs; its name has their versions, so it never goes stale."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return home / "fiber" / "-".join(f"{name}-{version(name)}" for name in SOURCES)


def programs() -> Path:
    return cache() / "bin"


def program(name: str) -> str:
    return str(programs() / name)


def node_name(index: int) -> str:
    return f"node-{index}"


def node_ip(index: int) -> str:
    return f"172.30.0.{10 + index}"


def pod_range(index: int) -> str:
    return f"10.244.{index}.0/24"


def namespace_prefix() -> str:
    return "fiber-node-"


def namespace(index: int) -> str:
    """The network namespace of a node."""
    return f"{namespace_prefix()}{index}"


def link_prefix() -> str:
    return "fveth"


def link(index: int) -> str:
    """The bridge's end of a node's cable."""
    return f"{link_prefix()}{index}"


def socket(index: int) -> Path:
    return SOCKETS / node_name(index) / "containerd.sock"


def nodes() -> list[int]:
    """The numbers of the nodes that run, or that have left something behind."""
    found = (re.fullmatch(r"node-(\d+)", path.name) for path in SOCKETS.glob("*"))
    return sorted(int(name[1]) for name in found if name)
