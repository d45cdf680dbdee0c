"""Which files of a folder the program's children do not need, as its people say.

In ``.gitignore`` and, of the same syntax and stronger, ``.fiberignore``, in that folder, in those
below and in those above up to the root of the repository.  As in git, the file nearest to a path
decides, and in it the last line that matches.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

from pathspec import GitIgnoreSpec
from pathspec.patterns.gitignore import GitIgnorePatternError
from pathspec.patterns.gitignore.spec import GitIgnoreSpecPattern

_FILES = (".gitignore", ".fiberignore")

_REPOSITORIES = (".git", ".hg", ".svn")

_NEVER_NEEDED = """
.git
.hg
.svn
__pycache__/
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
"""What versions, tools and editors leave; an ignore file that says ``!name`` has it sent."""


class _Level(NamedTuple):
    folder: str
    patterns: GitIgnoreSpec

    def ignores(self, path: str) -> bool | None:
        return self.patterns.check_file(path[len(self.folder) + 1 :]).include


class IgnoreRules:
    """The rules that hold in one folder."""

    def __init__(self, levels: tuple[_Level, ...]) -> None:
        self._levels = levels

    @classmethod
    def around(cls, folder: str) -> IgnoreRules:
        """Those that ``folder`` has from the folders around it.

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
        """Those that hold in ``folder``, which these are around."""
        found = [_Level(folder.rstrip(os.sep), _compiled(text)) for text in _read_all(folder)]
        return IgnoreRules((*self._levels, *found)) if found else self

    def ignores(self, path: str, *, is_folder: bool) -> bool:
        """Whether ``path``, in the folder, is not needed."""
        if is_folder and os.path.isfile(os.path.join(path, "pyvenv.cfg")):
            return True  # a virtual environment: what an image has installed
        path += "/" if is_folder else ""
        for level in reversed(self._levels):
            answer = level.ignores(path)
            if answer is not None:
                return answer
        name = os.path.basename(path.rstrip("/")) + ("/" if is_folder else "")
        return bool(_compiled(_NEVER_NEEDED).check_file(name).include)


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


def _read_all(folder: str) -> Iterable[str]:
    for name in _FILES:
        try:
            path = os.path.join(folder, name)
            with open(path, encoding="utf-8-sig", errors="surrogateescape") as file:
                yield file.read()
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
