"""Choice of the cluster that this machine can run, made before anything is built or installed."""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping
from enum import Enum
from pathlib import Path

from cluster import build, packages
from cluster.shell import ClusterError, output

# What network namespaces and containers take, by the number of the bit in CapEff.
_CAPABILITIES = {"CAP_NET_ADMIN": 12, "CAP_SYS_ADMIN": 21}


class Choice(Enum):
    """Kind of cluster for the end-to-end tests; the value is its name in a sentence."""

    GIVEN = "the cluster of KUBECONFIG"
    KIND = "a cluster of kind"
    OWN = "a cluster of their own on this machine"
    NONE = "nowhere"


def choose(environment: Mapping[str, str]) -> tuple[Choice, list[str]]:
    """Return the kind of cluster, and why the kinds before it cannot run."""
    if environment.get("KUBECONFIG"):
        return Choice.GIVEN, []
    reasons = ["KUBECONFIG is not set"]
    if (lacking := kind_lacks()) is None:
        return Choice.KIND, reasons
    reasons.append(f"no kind: {lacking}")
    if not (hindered := obstacles()):
        return Choice.OWN, reasons
    return Choice.NONE, [*reasons, f"no cluster of tests/cluster: {'; '.join(hindered)}"]


def kind_lacks() -> str | None:
    """Why kind cannot run here, in words; None where it can."""
    for program in ("kind", "docker"):
        if shutil.which(program) is None:
            return f"{program} is not on the PATH"
    try:
        output("docker", "info", timeout=30)
    except ClusterError:
        return "docker's daemon does not run (docker info fails)"
    return None


def obstacles() -> list[str]:
    """Return the reasons why the cluster cannot run here; empty if it can."""
    return list(_obstacles())


def _obstacles() -> Iterator[str]:
    if sys.platform != "linux":
        yield f"it runs on Linux, and this is {sys.platform}"
        return
    if os.geteuid():
        yield "it takes root, and this is an ordinary user"
    elif lacking := _capabilities_lacking():
        yield f"root lacks {' and '.join(lacking)} here, as in most containers"
    if any(build.missing(name) for name in ("kubernetes", "helm")):
        try:
            build.find_go()
        except ClusterError as error:
            yield str(error)
    if (missing := packages.missing(packages.TO_RUN)) and not shutil.which("apt-get"):
        yield f"these are missing, and there is no apt-get to install them: {', '.join(missing)}"


def _capabilities_lacking() -> list[str]:
    found = re.search(r"^CapEff:\s*(\w+)", Path("/proc/self/status").read_text(), re.MULTILINE)
    effective = int(found[1], 16) if found else 0
    return [name for name, bit in _CAPABILITIES.items() if not effective >> bit & 1]
