"""Nodes that a test keeps pods from, and that take pods again even if the test was killed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from e2e.kube import Kube

_LABEL = "fiber.dev/e2e-cordoned"
"""Label of nodes that a test has cordoned.  An administrator's own cordons stay."""


@contextmanager
def cordoned(kube: Kube, *nodes: str) -> Iterator[None]:
    """Cordon the nodes meanwhile."""
    if nodes:
        kube.kubectl("label", "nodes", *nodes, f"{_LABEL}=true", "--overwrite")
        kube.kubectl("cordon", *nodes)
    try:
        yield
    finally:
        uncordon(kube)


def uncordon(kube: Kube) -> None:
    """Let all nodes take pods that tests have cordoned."""
    chosen = ("--selector", f"{_LABEL}=true")
    nodes = kube.kubectl("get", "nodes", *chosen, "--output", "name").split()
    if nodes:
        kube.kubectl("uncordon", *(node.removeprefix("node/") for node in nodes))
        kube.kubectl("label", *nodes, f"{_LABEL}-")
