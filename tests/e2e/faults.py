"""Faults that strike while a program runs, and how long they last."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from e2e.clusters import Cluster
from e2e.program import Program
from e2e.scene import Scene

OUTAGE = 60
"""Seconds."""


class Trouble:
    """Place where a fault strikes: the cluster, a namespace, and a program that runs."""

    def __init__(self, cluster: Cluster, scene: Scene, program: Program) -> None:
        self.cluster = cluster
        self.scene = scene
        self.program = program

    def lasts(self, seconds: float) -> None:
        """Wait, and check that the program does not end meanwhile."""
        self.scene.never("it ends", lambda: self.program.status is not None, seconds)


@contextmanager
def api_server_stopped(trouble: Trouble) -> Iterator[None]:
    """Stop the API server for a minute, in which the work goes on."""
    with trouble.cluster.without_apiserver():
        trouble.lasts(OUTAGE)
    yield
