"""Packages of this environment, as an image can get them: from an index, or as wheels made here."""

from __future__ import annotations

import json
import re
import sysconfig
import urllib.parse
import urllib.request
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from fiber._worker_images import INSTALLED

FIBER = "fiberpool"
"""Name of Fiber's distribution."""

IN_EACH_IMAGE = frozenset({"pip"})
"""Packages that are in the image anyway, in its version."""

_PROJECT_FILES = ("pyproject.toml", "setup.py")


class Package(NamedTuple):
    """Package that the image gets."""

    name: str
    version: str
    made_of: str = ""
    """Requirement for ``pip wheel`` on this machine; empty if an index has the package."""
    problem: str = ""
    """Reason why the image cannot have it; empty if there is none."""

    @property
    def pin(self) -> str:
        """Requirement with the exact version."""
        return f"{self.name}=={self.version}"


@dataclass(frozen=True)
class Contents:
    """Packages of an image."""

    requirements: tuple[str, ...]
    """Lines of a requirements file, for an index."""
    built: tuple[Package, ...]
    """Packages whose wheels are made on this machine."""
    constraints: tuple[str, ...] = ()
    """Lines of a constraints file."""
    complete: bool = False
    """True if all dependencies are listed, so that pip has to find none."""
    notes: tuple[str, ...] = ()
    """Hints for the user."""


def canonical(name: str) -> str:
    """Return the name as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def of_environment(without: Collection[str] = ()) -> Contents:
    """Return the packages of this environment, except those in ``without``."""
    left_out = {canonical(name) for name in without} | IN_EACH_IMAGE
    packages = [each for each in installed() if canonical(each.name) not in {*left_out, FIBER}]
    packages.append(fiber_itself())
    packages.sort(key=lambda each: canonical(each.name))
    return Contents(
        tuple(each.pin for each in packages if not each.made_of and not each.problem),
        tuple(each for each in packages if each.made_of or each.problem),
        complete=True,
        notes=tuple(_notes(packages)),
    )


def fiber_itself() -> Package:
    """Return Fiber as this environment has it."""
    for each in installed():
        if canonical(each.name) == FIBER:
            return each
    why = "it was not installed by pip or a similar program"
    return Package(FIBER, "", problem=why)


def installed() -> list[Package]:
    """Return the packages that this interpreter finds, sorted by name."""
    found: dict[str, Package] = {}
    for distribution in metadata.distributions():
        if "Name" not in distribution.metadata:
            continue  # remains of a package that was removed
        name = canonical(distribution.metadata["Name"])
        if name not in found:  # the first on the path is imported
            found[name] = package_of(distribution)
    return [found[name] for name in sorted(found)]


def package_of(distribution: metadata.Distribution) -> Package:
    """Return how the image gets an installed package."""
    name, version = distribution.metadata["Name"], distribution.version
    origin = _json(distribution.read_text("direct_url.json"))
    if (distribution.read_text("INSTALLER") or "").strip() == "conda":
        return Package(name, version)  # its origin is a folder of the machine that built it
    if origin is None:
        folder = _develop_folder(distribution)
        return Package(name, version, str(folder) if folder else "")
    return _from(name, version, origin)


def _from(name: str, version: str, origin: dict[str, Any]) -> Package:
    """Return a package that was installed from a folder, an archive or a repository."""
    url = str(origin.get("url", ""))
    if url.startswith("file:"):
        path = local_path(url)
        problem = "" if path.exists() else f"it was installed from {path}, which is gone"
        return Package(name, version, str(path), problem)
    repository = origin.get("vcs_info")
    if isinstance(repository, dict):
        url = f"{repository.get('vcs')}+{url}@{repository.get('commit_id')}"
    if folder := origin.get("subdirectory"):
        url += f"#subdirectory={folder}"
    return Package(name, version, f"{name} @ {url}")


def local_path(url: str) -> Path:
    """Return the path of a ``file:`` URL."""
    return Path(urllib.request.url2pathname(urllib.parse.urlsplit(url).path))


def _develop_folder(distribution: metadata.Distribution) -> Path | None:
    """Return the project of an editable package of the old kind, which records no origin."""
    if distribution.read_text("PKG-INFO") is None:
        return None  # no .egg-info, which `setup.py develop` makes
    folder = Path(str(distribution.locate_file("")))
    places = {Path(sysconfig.get_path(key)) for key in ("purelib", "platlib")}
    if folder in places or folder.name in INSTALLED:
        return None
    projects = (each for each in (folder, folder.parent) if _is_project(each))
    return next(projects, None)


def _is_project(folder: Path) -> bool:
    return any((folder / name).is_file() for name in _PROJECT_FILES)


def _json(text: str | None) -> dict[str, Any] | None:
    try:
        found = json.loads(text or "null")
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


def _notes(packages: Iterable[Package]) -> Iterator[str]:
    """Yield a hint for versions that the usual index does not have."""
    labelled = [each for each in packages if "+" in each.version and not each.made_of]
    if labelled:
        pins = ", ".join(each.pin for each in labelled)
        yield (
            f"{pins}: the part after + is of another index than pypi.org; name that index in pip's "
            "configuration, for example `pip config set global.extra-index-url "
            "https://download.pytorch.org/whl/cpu`"
        )
