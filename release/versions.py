"""Version of a checkout, in every file that has it."""

from __future__ import annotations

import re
from pathlib import Path

from fiber._backends.kubernetes.published import chart_version
from release import ReleaseError

VERSION = re.compile(r"\d+\.\d+\.\d+(rc\d+|\.dev\d+)?")
"""Versions of releases and of what is between them: 1.2.0, 1.2.0rc1, 1.2.0.dev0."""

SOURCE = Path("sdk/fiber/__init__.py")
CHART = Path("charts/fiber-operator")
_IMAGES = ("examples/01-pi/job.yaml", "examples/manifests/*.yaml")

_SOURCE_LINE = re.compile(r'^(__version__ = ")(.+)(")$', re.MULTILINE)
_CHART_LINE = re.compile(r"^(version: )(\S+)()$", re.MULTILINE)
_APP_LINE = re.compile(r'^(appVersion: ")(.+)(")$', re.MULTILINE)
_IMAGE_LINE = re.compile(r"^( *image: fiber-worker:)(\S+)()$", re.MULTILINE)


def is_development(version: str) -> bool:
    """Return whether the version is between releases."""
    return ".dev" in version


def current(root: Path) -> str:
    """Return the version of the checkout; ReleaseError if its files have different ones."""
    version = _found(root / SOURCE, _SOURCE_LINE)
    for path, pattern, wanted in _places(root, version):
        found = _found(path, pattern)
        if found != wanted:
            raise ReleaseError(
                f"{path.relative_to(root)} has the version {found} instead of {wanted}, which "
                f"follows from {SOURCE}. Write one version to all files: `make release-prepare "
                "VERSION=...`"
            )
    return version


def write(root: Path, version: str) -> None:
    """Write the version to every file that has it."""
    if not VERSION.fullmatch(version):
        raise ReleaseError(
            f"{version!r} cannot be the version of a release: releases are called 1.2.0 or "
            "1.2.0rc1, and what is between them 1.2.0.dev0. Choose such a name"
        )
    places = [(root / SOURCE, _SOURCE_LINE, version), *_places(root, version)]
    for path, pattern, wanted in places:
        _found(path, pattern)
        text = path.read_text(encoding="utf-8")
        path.write_text(pattern.sub(rf"\g<1>{wanted}\g<3>", text), encoding="utf-8")


def check_tag(tag: str, version: str) -> None:
    """Raise ReleaseError unless the tag is that of the version, and the version a release's."""
    if tag != f"v{version}":
        raise ReleaseError(
            f"the tag is {tag}, and the version of the checkout {version}. Their names must agree: "
            f"tag the commit that `make release-prepare VERSION={tag.removeprefix('v')}` made"
        )
    if is_development(version):
        raise ReleaseError(
            f"{version} is a development version, which is not released. Make the commit of the "
            "release first: `make release-prepare VERSION=...`"
        )


def _places(root: Path, version: str) -> list[tuple[Path, re.Pattern[str], str]]:
    """Return the files, the lines and the text of the version beside the package's."""
    chart = root / CHART / "Chart.yaml"
    manifests = sorted(path for pattern in _IMAGES for path in root.glob(pattern))
    having = [path for path in manifests if _IMAGE_LINE.search(path.read_text(encoding="utf-8"))]
    return [
        (chart, _CHART_LINE, chart_version(version)),
        (chart, _APP_LINE, version),
        *((path, _IMAGE_LINE, version) for path in having),
    ]


def _found(path: Path, pattern: re.Pattern[str]) -> str:
    found = pattern.search(path.read_text(encoding="utf-8"))
    if found is None:
        raise ReleaseError(
            f"{path} has no line with its version (expected {pattern.pattern!r}). Restore it"
        )
    return found[2]
