"""The container runtime of one node, spoken to with containerd's own ctr."""

from __future__ import annotations

from pathlib import Path

from cluster import places
from cluster.shell import answer, output, succeeds


class Containerd:
    """Containerd of one node. Images must be loaded into each: there is no registry."""

    def __init__(self, index: int) -> None:
        self.index = index
        self.socket = places.socket(index)

    def answers(self) -> bool:
        return self.socket.exists() and succeeds(*self._ctr("version"), timeout=5)

    def answer(self) -> str:
        """Return its answer, or the error in its place."""
        return answer(*self._ctr("version"), timeout=5)

    def images(self) -> list[str]:
        return output(*self._ctr("images", "ls", "-q")).split()

    def has(self, reference: str) -> bool:
        return reference in self.images()

    def load(self, archive: Path) -> None:
        """Import the images of an OCI or docker archive."""
        output(*self._ctr("images", "import", str(archive)))

    def tag(self, reference: str, other: str) -> None:
        """Give an image that is there another name, which may have been another image's."""
        output(*self._ctr("images", "tag", "--force", reference, other))

    def remove(self, reference: str) -> None:
        """Remove an image, if it is there."""
        output(*self._ctr("images", "rm", "--sync", reference))

    def kill(self, container: str) -> None:
        """SIGKILL to the first process of a container: the others of its pid namespace follow."""
        output(*self._ctr("tasks", "kill", "--signal", "SIGKILL", container))

    def _ctr(self, *arguments: str) -> tuple[str | Path, ...]:
        return ("ctr", "--address", self.socket, "--namespace", "k8s.io", *arguments)
