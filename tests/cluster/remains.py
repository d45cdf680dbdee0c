"""Remains of killed nodes on the machine: containers, mounts, namespaces, cgroups.

The state of the cluster is thrown away as a whole, so nothing is asked to end in good order, which
would take the longer the more pods there are, and would not work after a crash.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

from cluster import cgroups, places
from cluster.shell import output

_BUNDLES = "node-*/containerd/io.containerd.runtime.v2.task/k8s.io/*"
_RUNC = Path("/run/containerd/runc/k8s.io")
_CNI_RESULTS = Path("/var/lib/cni/results")
_SHIM = b"containerd-shim-runc-v2"


def clear() -> None:
    """Remove all remains. Call it when no containerd and no kubelet of this cluster runs."""
    for pid in _processes():
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:  # it has just ended
            pass
    _unmount()
    for bundle in places.SOCKETS.glob(_BUNDLES):
        _forget(bundle)
    cgroups.remove()
    for folder in (places.STATE, places.SOCKETS):
        shutil.rmtree(folder, ignore_errors=True)


def _processes() -> Iterator[int]:
    """Return every process in a pod of this cluster, and the shims that watch over them."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words = (process / "cmdline").read_bytes().split(b"\0")
            cgroup = (process / "cgroup").read_text()
        except OSError:  # it has just ended
            continue
        if is_shim(words) or cgroups.holds_a_pod(cgroup):
            yield int(process.name)


def is_shim(words: list[bytes]) -> bool:
    ours = f"{places.SOCKETS}/".encode()
    return words[0].endswith(_SHIM) and any(word.startswith(ours) for word in words)


def _unmount() -> None:
    ours = (f"{places.STATE}/", f"{places.SOCKETS}/")
    mounts = Path("/proc/mounts").read_text().splitlines()
    for line in reversed(mounts):  # the inner ones first
        target = line.split()[1]
        if target.startswith(ours):
            output("umount", "--lazy", target, check=False)


def _forget(bundle: Path) -> None:
    """Remove what there is of a container outside of our own folders."""
    shutil.rmtree(_RUNC / bundle.name, ignore_errors=True)
    for file in _CNI_RESULTS.glob(f"*-{bundle.name}-*"):
        file.unlink(missing_ok=True)
    try:
        shim = (bundle / "address").read_text().removeprefix("unix://")
        settings = json.loads((bundle / "config.json").read_text())
    except (OSError, ValueError):  # the container was not yet, or no more, a whole one
        return
    Path(shim).unlink(missing_ok=True)
    for namespace in settings["linux"]["namespaces"]:
        name = Path(namespace.get("path", "")).name
        if namespace["type"] == "network" and name.startswith("cni-"):
            output("ip", "netns", "delete", name, check=False)
