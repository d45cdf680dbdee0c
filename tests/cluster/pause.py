"""The image of a pod's first container: one static program that waits for a signal."""

from __future__ import annotations

from pathlib import Path

from cluster import places
from cluster.buildah import buildah
from cluster.shell import locked, output

PAUSE = "localhost/pause:1"


def pause_archive() -> Path:
    """The image as an archive, built when it is not there."""
    archive = places.cache() / "pause-1.tar"
    if not archive.exists():
        with locked(places.cache() / "lock", "builds the same programs"):
            _build(archive)
    return archive


def _build(archive: Path) -> None:
    program = places.cache() / "pause"
    output("gcc", "-static", "-Os", "-s", "-o", program, places.HERE / "pause.c")
    container = buildah("from", "scratch").strip()
    buildah("copy", container, program, "/pause")
    buildah("config", "--entrypoint", '["/pause"]', container)
    unfinished = archive.with_suffix(".unfinished")
    unfinished.unlink(missing_ok=True)
    buildah("commit", "--rm", container, f"docker-archive:{unfinished}:{PAUSE}")
    unfinished.rename(archive)
