"""A base image with Python, made of Debian packages, where no registry serves python:X-slim."""

from __future__ import annotations

import shutil
from pathlib import Path

from cluster import packages
from cluster.buildah import buildah
from cluster.shell import ClusterError, need_root, output, say

# The release of Debian that has this Python.
RELEASES = {"3.11": "bookworm", "3.13": "trixie"}
_INCLUDED = "python3,python3-venv,ca-certificates"
_PATH = "PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
_NOT_NEEDED = (
    "usr/share/doc",
    "usr/share/info",
    "usr/share/locale",
    "usr/share/man",
    "var/cache/apt",
    "var/lib/apt/lists",
    "var/log",
)
_ROOT = Path("/var/tmp/fiber-base-image")


def base_image(python: str) -> str:
    """The reference of a base image with this Python, built when buildah does not have it."""
    reference = f"localhost/fiber-base:python{python}"
    if python not in RELEASES:
        raise ClusterError(
            f"no release of Debian has Python {python}, so no base image can be made of its "
            f"packages; those of {', '.join(RELEASES)} can, or name one that buildah can pull: "
            "BASE_IMAGE=… make images"
        )
    if reference not in buildah("images", "--format", "{{.Name}}:{{.Tag}}").split():
        need_root("make a base image with debootstrap")
        packages.need(packages.TO_BUILD_A_BASE, "make a base image")
        _build(reference, RELEASES[python])
    return reference


def _build(reference: str, release: str) -> None:
    say(f"building {reference} of packages of Debian {release} (a minute or two, once)")
    shutil.rmtree(_ROOT, ignore_errors=True)
    try:
        output("debootstrap", "--variant=minbase", f"--include={_INCLUDED}", release, _ROOT)
        for folder in _NOT_NEEDED:
            shutil.rmtree(_ROOT / folder)
            (_ROOT / folder).mkdir()
        container = buildah("from", "scratch").strip()
        buildah("add", "-q", container, _ROOT, "/")
        buildah("config", "--cmd", "python3", "--env", _PATH, container)
        buildah("commit", "-q", "--rm", container, reference)
    finally:
        shutil.rmtree(_ROOT, ignore_errors=True)
