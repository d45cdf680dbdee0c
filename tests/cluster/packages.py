"""Distribution packages that the cluster needs; installed where root and apt-get are available."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

from cluster import places
from cluster.shell import ClusterError, locked, output, say

_PLUGINS = Path("/usr/lib/cni/bridge")
_HEADERS = Path("/usr/include/stdlib.h")

# What must be there, and the package of Debian and Ubuntu that has it.
TO_RUN: Mapping[str | Path, str] = {
    "containerd": "containerd",
    "runc": "runc",
    _PLUGINS: "containernetworking-plugins",
    "iptables": "iptables",
    "conntrack": "conntrack",
    "ipset": "ipset",
    "socat": "socat",
    "ip": "iproute2",
    "openssl": "openssl",
    "nsenter": "util-linux",
    "buildah": "buildah",
    "gcc": "gcc",
    _HEADERS: "libc6-dev",
}
TO_BUILD_IMAGES: Mapping[str | Path, str] = {"buildah": "buildah"}
TO_BUILD_A_BASE: Mapping[str | Path, str] = {**TO_BUILD_IMAGES, "debootstrap": "debootstrap"}
_SYSTEM_PATH = "/usr/sbin:/usr/bin:/sbin:/bin"


def missing(wanted: Mapping[str | Path, str]) -> list[str]:
    """Return the packages of the missing programs, each once."""
    return sorted({package for item, package in wanted.items() if not _is_there(item)})


def need(wanted: Mapping[str | Path, str], purpose: str) -> None:
    """Install what is missing, or raise ClusterError with the command that does."""
    if not (packages := missing(wanted)):
        return
    if os.geteuid() or not shutil.which("apt-get"):
        raise ClusterError(_advice(packages, purpose))
    with locked(places.PACKAGES_LOCK, "installs packages"):
        if packages := missing(wanted):
            _install(packages, purpose)
    if still := missing(wanted):
        raise ClusterError(
            f"apt-get installed {', '.join(still)}, but what they should bring is not there. "
            + _advice(still, purpose)
        )


def _install(packages: Iterable[str], purpose: str) -> None:
    say(f"installing {' '.join(packages)}, to {purpose}")
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    output("apt-get", "update", "-qq", env=environment)
    command = ("apt-get", "install", "-y", "-qq", "--no-install-recommends")
    output(*command, *packages, env=environment)


def _advice(packages: Iterable[str], purpose: str) -> str:
    names = " ".join(packages)
    return (
        f"to {purpose}, these packages are missing: {names}. "
        f"Install them (Debian, Ubuntu: sudo apt-get install {names}; other systems: what has the "
        "same programs), or run this as root where apt-get is"
    )


def _is_there(item: str | Path) -> bool:
    if isinstance(item, Path):
        return item.exists()
    path = f"{os.environ.get('PATH', '')}:{_SYSTEM_PATH}"
    return shutil.which(item, path=path) is not None
