"""Records of published programs: what each needs, how it runs, and what is compared."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from published.runs import Run, Value

PROGRAMS = Path(__file__).with_name("programs")


@dataclass(frozen=True)
class Package:
    """Package that a program imports."""

    module: str
    requirement: str
    """Requirement of its distribution, in pip's words."""


@dataclass(frozen=True)
class Version:
    """Version of a clone, which one of its files says."""

    file: str
    wanted: str
    """Versions that fit, in pip's words."""
    pattern: str = r"""__version__ = ["']([^"']+)"""


@dataclass(frozen=True)
class Program:
    """Published program, and how the harness runs it."""

    name: str
    upstream: str
    clone: str
    """Name of its folder among the clones."""
    way: str
    """Way in which the program gets Fiber."""
    ran: str
    """Description of what ran, in a few words."""
    run: Callable[[Run], dict[str, Value]]
    """Runs the program once, and returns the values to compare."""
    files: tuple[str, ...] = ()
    """Files of the clone without which it is not the version that is meant."""
    packages: tuple[Package, ...] = ()
    roms: tuple[str, ...] = ()
    """Games of which ale-py must have the ROM."""
    version: Version | None = None
    stood_in: tuple[str, ...] = ()
    """Names of packages that no longer install, and for which a stand-in is imported."""
    reference: str = "multiprocessing"
    """Backend whose values the others must repeat."""
    seconds: float = 1800
    """Limit for one run, which a hang exceeds and a busy machine does not."""


def programs() -> dict[str, Program]:
    """Return the records by name, in the order of their names."""
    modules = sorted(path.stem for path in PROGRAMS.glob("*.py"))
    found = [importlib.import_module(f"published.programs.{name}") for name in modules]
    return {program.name: program for module in found for program in module.PROGRAMS}
