"""buildah, which builds images without a daemon."""

from __future__ import annotations

from pathlib import Path

from cluster.shell import output

BUILDAH = ("buildah", "--storage-driver", "overlay")


def buildah(*arguments: str | Path, check: bool = True) -> str:
    return output(*BUILDAH, *arguments, check=check)
