"""Checks before a program runs: each returns one line that says what to install, or None."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import re
import subprocess
from pathlib import Path

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from published.records import Package, Program

EVERYTHING = "pip install -r tests/published/requirements.txt"


def missing(program: Program, clones: Path) -> str | None:
    """Return what is missing to run this program, and how to get it, or None."""
    clone = clones / program.clone
    found = (
        missing_clone(program, clone)
        or next(filter(None, map(missing_package, program.packages)), None)
        or next(filter(None, map(missing_rom, program.roms)), None)
    )
    return f"{program.name}: {found}" if found else None


def missing_clone(program: Program, clone: Path) -> str | None:
    """Return what is wrong with the clone, or None."""
    if not clone.is_dir():
        return f"{clone} is not there: git clone {program.upstream} {clone}"
    lost = next((file for file in program.files if not (clone / file).exists()), None)
    if lost:
        return (
            f"{clone} has no {lost}, so its version does not fit: "
            "check out the commit that docs/published.md names"
        )
    return unfit_version(program, clone)


def unfit_version(program: Program, clone: Path) -> str | None:
    """Return what is wrong with the clone's version, or None."""
    if program.version is None:
        return None
    path = clone / program.version.file
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    match = re.search(program.version.pattern, text)
    if match is None:
        return (
            f"{program.version.file} of {clone} says no version: "
            "check out the commit that docs/published.md names"
        )
    if not SpecifierSet(program.version.wanted).contains(match[1], prereleases=True):
        return (
            f"{clone} has version {match[1]}, which does not fit: "
            f"check out a version {program.version.wanted}"
        )
    return None


def missing_package(package: Package) -> str | None:
    """Return how to install this package, or None if a version that fits is installed."""
    wanted = Requirement(package.requirement)
    if not _is_found(package.module):
        return f"{package.module} is not installed: pip install {str(wanted)!r}, or {EVERYTHING}"
    try:
        version = importlib.metadata.version(wanted.name)
    except importlib.metadata.PackageNotFoundError:
        return f"{package.module} is not that of {wanted.name}: pip install {str(wanted)!r}"
    if not wanted.specifier.contains(version, prereleases=True):
        return (
            f"{wanted.name} {version} is installed, which does not fit: pip install {str(wanted)!r}"
        )
    return None


def _is_found(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # the package that would contain it is missing
        return False


def missing_rom(game: str) -> str | None:
    """Return how to get the ROM of this game, or None if ale-py has it."""
    spec = importlib.util.find_spec("ale_py")
    folder = Path(spec.origin).parent / "roms" if spec and spec.origin else None
    if folder and (folder / f"{game}.bin").exists():
        return None
    return f"the ROM of {game} is not installed: pip install 'ale-py>=0.10', which brings it"


def commit(clone: Path) -> str:
    """Return the first characters of the clone's commit; "unknown" without git or its folder."""
    command = ["git", "-c", "safe.directory=*", "-C", str(clone), "rev-parse", "HEAD"]
    try:
        found = subprocess.run(command, capture_output=True, text=True)
    except FileNotFoundError:
        return "unknown"
    return found.stdout[:10] if found.returncode == 0 else "unknown"
