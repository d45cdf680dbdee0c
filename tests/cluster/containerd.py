"""The container runtime of one node, spoken to with containerd's own ctr."""

from __future__ import annotations

from pathlib import Path

from cluster import places
from cluster.shell import output, succeeds


class Containerd:
    """One node's containerd. Images must be loaded into each: there is no registry."""

    def __init__(self, index: int) -> None:
        self.index = index
        self.socket = places.socket(index)

    def answers(self) -> bool:
        return self.socket.exists() and succeeds(*self._ctr("version"), timeout=5)

    def images(self) -> list[str]:
        return output(*self._ctr("images", "ls", "-q")).split()

    def has(self, reference: str) -> bool:
        return reference in self.images()

    def load(self, archive: Path) -> None:
        """Import the images of an OCI or docker archive."""
        output(*self._ctr("images", "import", str(archive)))

    def kill(self, container: str) -> None:
        """SIGKILL to the first process of a container: the others of its pid namespace follow."""
        output(*self._ctr("tasks", "kill", "--signal", "SIGKILL", container))

    def _ctr(self, *arguments: str) -> tuple[str | Path, ...]:
        return ("ctr", "--address", self.socket, "--namespace", "k8s.io", *arguments)
