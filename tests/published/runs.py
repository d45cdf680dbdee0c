"""Run of a published program: the module that it gets its processes from, and its clone."""

from __future__ import annotations

import difflib
import importlib
import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Value = float | int | str | bool | Sequence["Value"]

MULTIPROCESSING = "multiprocessing"
STAND_INS = Path(__file__).with_name("stand_ins")
TESTS = Path(__file__).parents[1]


class RunFailed(Exception):
    """Program or test run that ended with an error."""


@dataclass
class Run:
    """Run of one program on one backend."""

    backend: str
    clone: Path
    folder: Path
    """Folder for the files of this run, empty at first."""
    changed: list[str] = field(default_factory=list)
    """Lines of the program that were replaced, as they are now."""

    @property
    def on_fiber(self) -> bool:
        """True if the processes are Fiber's."""
        return self.backend != MULTIPROCESSING

    @property
    def multiprocessing(self) -> Any:
        """`fiber`, or `multiprocessing` for the run that the others are compared with."""
        return importlib.import_module("fiber" if self.on_fiber else MULTIPROCESSING)

    def import_from(self, folder: str | Path = ".") -> None:
        """Import from this folder of the clone first, here and in processes started later."""
        path = str(self.clone / folder)
        sys.path.insert(0, path)
        os.environ["PYTHONPATH"] = _joined(path, os.environ.get("PYTHONPATH", ""))

    def stand_in(self, *packages: str) -> None:
        """Import the stand-ins of these packages, here and in processes started later."""
        for package in packages:
            self.import_from(STAND_INS / package)

    def adopt(self, *modules: str) -> None:
        """Let these modules of a library use Fiber; nothing in the run without Fiber."""
        if self.on_fiber:
            for module in modules:
                self.multiprocessing.adopt(module)

    def copy(self, folder: str = ".") -> Path:
        """Copy a folder of the clone into the run's folder, and return it."""
        copied = self.folder / "copy"
        ignored = shutil.ignore_patterns(".git", "__pycache__")
        shutil.copytree(self.clone / folder, copied, ignore=ignored)
        return copied

    def replace(self, file: Path, old: str, new: str) -> None:
        """Replace the one occurrence of `old` in a copied file, and count the changed lines."""
        before = file.read_text(encoding="utf-8")
        if before.count(old) != 1:
            raise RunFailed(
                f"{file.name} has {before.count(old)} times {old!r}, not once: this version of "
                "the program does not fit; check out the commit that docs/published.md names"
            )
        after = before.replace(old, new)
        file.write_text(after, encoding="utf-8")
        self.changed += added_lines(before, after)

    def script(self, program: Path, *options: str, seed: int = 0, cwd: Path | None = None) -> str:
        """Run a script in a new interpreter with seeded generators; return its output."""
        command = [sys.executable, str(Path(__file__).with_name("script.py")), str(seed)]
        return _output([*command, str(program), *options], cwd or self.folder)

    def tests(
        self, *files: str, cwd: Path, adopt: Sequence[str] = (), options: Sequence[str] = ()
    ) -> dict[str, Value]:
        """Run a project's tests by pytest; return the outcome of each."""
        report = self.folder / "report.xml"
        os.environ["PUBLISHED_ADOPT"] = ",".join(adopt) if self.on_fiber else ""
        command = [sys.executable, "-m", "pytest", "-p", "published.adopting", "-q"]
        command += ["-p", "no:cacheprovider", f"--junitxml={report}", *options, *files]
        subprocess.run(command, cwd=cwd, stdout=sys.stderr)
        return outcomes(report)


def outcomes(report: Path) -> dict[str, Value]:
    """Return the outcome of each test in a JUnit report; it must have at least one that passed."""
    if not report.exists():
        raise RunFailed("pytest wrote no report: its output is above")
    found: dict[str, Value] = {}
    for case in ElementTree.parse(report).iter("testcase"):
        child = next((each.tag for each in case if each.tag in _OUTCOMES), "passed")
        found[f"{case.get('classname')}::{case.get('name')}"] = child
    if "passed" not in found.values():
        raise RunFailed("none of the tests passed: pytest's output is above")
    return found


def added_lines(before: str, after: str) -> list[str]:
    """Return the lines that a text has and its former version had not."""
    lines = difflib.ndiff(before.splitlines(), after.splitlines())
    return [line.removeprefix("+ ").strip() for line in lines if line.startswith("+ ")]


_OUTCOMES = {"failure", "error", "skipped"}


def _joined(*paths: str) -> str:
    return os.pathsep.join(filter(None, paths))


def _output(command: list[str], cwd: Path) -> str:
    done = subprocess.run(command, cwd=cwd, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.stderr.write(done.stdout)
        raise RunFailed(f"{Path(command[3]).name} ended with status {done.returncode}")
    return done.stdout
