"""Packages that this program has installed, and that the image of its workers lacks.

Workers in pods have the packages of their image.  A module that a worker cannot import may be one
that the program imports without trouble.
"""

from __future__ import annotations

from importlib.machinery import PathFinder
from pathlib import Path

INSTALLED = ("site-packages", "dist-packages")
"""Folders of installed packages."""

_in_use = False


def use(in_use: bool) -> None:
    """Note whether this program's workers have the packages of an image."""
    global _in_use
    _in_use = in_use


def missing_module(error: BaseException) -> str:
    """Return the module that ``error`` or its cause could not find; empty for other errors."""
    for found in (error, error.__cause__):
        if isinstance(found, ModuleNotFoundError) and isinstance(found.name, str):
            return found.name
    return ""


def advice(module: str) -> str:
    """Return what to do about a module that a worker lacks; empty if this program lacks it, too.

    Runs on any thread: no code of the program takes part.
    """
    package = module.partition(".")[0]
    if not _in_use or not package or not _is_installed(package):
        return ""
    return (
        f"The image of the workers has no package {package!r}. This program has it, but a worker "
        "has the packages of its image. Build an image with the packages of this environment: "
        "`fiber image build --tag REGISTRY/NAME --push`"
    )


def _is_installed(package: str) -> bool:
    """Return whether this interpreter has the package in a folder of installed packages."""
    spec = PathFinder.find_spec(package)
    if spec is None:
        return False
    places = [spec.origin, *(spec.submodule_search_locations or ())]
    return any(set(INSTALLED) & set(Path(place).parts) for place in places if place)
