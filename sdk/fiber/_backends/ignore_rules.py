"""Rules of ignore files: files of a folder that the program's children do not need.

In ``.gitignore`` and, of the same syntax and stronger, ``.fiberignore``, in that folder, in those
below and in those above up to the root of the repository.  As in git, the file nearest to a path
decides, and in it the last line that matches.
"""

from __future__ import annotations

import fnmatch
import os
from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

from pathspec import GitIgnoreSpec
from pathspec.patterns.gitignore import GitIgnorePatternError
from pathspec.patterns.gitignore.spec import GitIgnoreSpecPattern

INCLUDING = ".fiberignore"
"""The file that says what is sent of a folder, although it would not be."""

_FILES = (".gitignore", INCLUDING)

_REPOSITORIES = (".git", ".hg", ".svn")

BYTECODE = "__pycache__"
"""The folder that Python keeps compiled modules in."""

_NEVER_NEEDED = f"""
.git
.hg
.svn
{BYTECODE}/
*.py[co]
.ipynb_checkpoints/
.mypy_cache/
.pytest_cache/
.ruff_cache/
.tox/
.nox/
node_modules/
.DS_Store
"""
"""Files that tools and editors leave.  An ignore file with ``!name`` has them sent."""


class _Level(NamedTuple):
    folder: str
    name: str
    patterns: GitIgnoreSpec

    def decide(self, path: str) -> _Decision | None:
        # No pattern has a line break, and none of pathspec's expressions gets past one.
        found = self.patterns.check_file(path[len(self.folder) + 1 :].replace("\n", "\0"))
        if found.include is None or found.index is None:
            return None
        return _Decision(found.include, str(self.patterns.patterns[found.index].pattern), self)


class _Decision(NamedTuple):
    """Line of an ignore file that decides about a path."""

    ignored: bool
    line: str
    level: _Level

    def names(self, path: str) -> bool:
        """Return whether the line has the path's own name, and not that of a folder around it."""
        last = self.line.strip().rstrip("/").rpartition("/")[2].removeprefix("!")
        name = os.path.basename(path.rstrip("/"))
        return bool(last.strip("*")) and fnmatch.fnmatchcase(name, last)


class IgnoreRules:
    """The rules that hold in one folder."""

    def __init__(self, levels: tuple[_Level, ...]) -> None:
        self._levels = levels

    @classmethod
    def around(cls, folder: str) -> IgnoreRules:
        """Return the rules that ``folder`` has from the folders around it.

        None if they say to ignore that very folder: they were not made for what is run from it.
        """
        rules = cls(())
        for outer in _up_to_repository(folder):
            rules = rules.within(outer)
            way = os.path.relpath(folder, outer).split(os.sep)
            if rules.ignores(os.path.join(outer, way[0]), is_folder=True):
                return cls(())
        return rules

    def within(self, folder: str) -> IgnoreRules:
        """Return the rules that hold in ``folder``, below the folder of these rules."""
        top = folder.rstrip(os.sep)
        found = [_Level(top, name, _compiled(text)) for name, text in _read_all(folder)]
        return IgnoreRules((*self._levels, *found)) if found else self

    def ignores(self, path: str, *, is_folder: bool) -> str | None:
        """Return why ``path``, in the folder, is not needed; None if it may be."""
        if is_folder and os.path.isfile(os.path.join(path, "pyvenv.cfg")):
            return "a virtual environment, whose packages belong into the image"
        path += "/" if is_folder else ""
        for level in reversed(self._levels):
            decision = level.decide(path)
            if decision is not None:
                where = os.path.join(level.folder, level.name)
                return f"{decision.line!r} in {where}" if decision.ignored else None
        name = os.path.basename(path.rstrip("/")) + ("/" if is_folder else "")
        tool = _compiled(_NEVER_NEEDED).check_file(name.replace("\n", "\0")).include
        return "left by a tool" if tool else None

    def asks_for(self, path: str, *, is_folder: bool) -> bool:
        """Return whether a line of ``.fiberignore`` has ``path`` sent, by its name: ``!name``."""
        path += "/" if is_folder else ""
        for level in reversed(self._levels):
            decision = level.decide(path) if level.name == INCLUDING else None
            if decision is not None:
                return not decision.ignored and decision.names(path)
        return False


def _up_to_repository(folder: str) -> list[str]:
    """The folders around ``folder`` in its repository, the outermost first; none without one."""
    around: list[str] = []
    here = folder
    while not any(os.path.exists(os.path.join(here, name)) for name in _REPOSITORIES):
        outer = os.path.dirname(here)
        if outer == here:
            return []
        around.append(outer)
        here = outer
    return around[::-1]


def _read_all(folder: str) -> Iterable[tuple[str, str]]:
    for name in _FILES:
        try:
            path = os.path.join(folder, name)
            with open(path, encoding="utf-8-sig", errors="surrogateescape") as file:
                yield name, file.read()
        except OSError:  # there is none, or nobody may read it: git goes on, too
            continue


@lru_cache(maxsize=256)
def _compiled(text: str) -> GitIgnoreSpec:
    lines = filter(_is_pattern, text.split("\n"))
    return GitIgnoreSpec.from_lines(lines, backend="simple")


def _is_pattern(line: str) -> bool:
    try:
        GitIgnoreSpecPattern(line)
    except GitIgnorePatternError:  # git takes no notice of it
        return False
    return True
