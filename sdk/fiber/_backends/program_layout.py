"""Folders that make up the program, their places on another machine, and their ignore rules.

* The folder of the main module. For ``-m`` it is the folder in which the package was found. A
  session without a main module (``-c``, stdin, a notebook, an installed command) has its working
  directory instead. If that folder is too large, it is left out with a warning; the folder of a
  script that is too large is an error.
* Other folders of ``sys.path`` (from ``PYTHONPATH``, or projects installed for editing) that
  contain a ``.fiberignore``. The file says that the folder may be sent.
* From other folders, and for modules found by other ways than ``sys.path``: the packages and
  modules that have been imported.

Installed code (the standard library, site-packages, Fiber) comes from the image.

Files that children do not need are named in ``.gitignore`` and ``.fiberignore``, in the folder,
below it, and above it up to the root of the repository. Both have the same syntax, and
``.fiberignore`` is the stronger. As in git, the file nearest to a path decides, and in that file
the last line that matches.
"""

from __future__ import annotations

import fnmatch
import os
import sys
import sysconfig
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

from pathspec import GitIgnoreSpec
from pathspec.patterns.gitignore import GitIgnorePatternError
from pathspec.patterns.gitignore.spec import GitIgnoreSpecPattern

from fiber._agent.child import ProgramPaths
from fiber._backends.main_module import is_inside, is_installed, main_file, started_in

LOOSE = "program"
"""Folder on the other machine for modules that are sent without the folder around them."""

_ALL_PLACES = ""
"""Folder on the other machine that holds all places."""


class Places(dict[str, str]):
    """Local folders and files, none within another, and their names on the other machine."""

    def place_of(self, path: str) -> str | None:
        """Return the place that is ``path`` or has it; None if there is none."""
        return next((place for place in self if is_inside(path, place)), None)

    def name_of(self, path: str) -> str | None:
        """Return the path on the other machine; None if ``path`` is not sent."""
        place = self.place_of(path)
        return None if place is None else self[place] + path[len(place) :]


class Layout(NamedTuple):
    """Folders and files to send, and their places on the other machine."""

    places: Places
    program: str
    """Folder of the program, of which only a part may be sent."""
    files: tuple[str, ...]
    """Files that were imported from the places.  They are sent in spite of ignore files."""
    trees: tuple[str, ...]
    """Folders of ``sys.path`` of which only imported files are sent."""
    session: frozenset[str]
    """Places that are only the working directory of a session."""
    paths: ProgramPaths


class ProgramFile(NamedTuple):
    """Main module of a program."""

    file: str | None
    """Absolute path; None if it is installed or has no file."""
    folder: str
    """Folder of the program: that of the script or, for ``-m``, in which the package was found."""

    @classmethod
    def of_this_process(cls) -> ProgramFile:
        """Return the main module of this process."""
        file = main_file()
        return cls(file, "" if file is None else _folder_of(file))


class _ImportedModule(NamedTuple):
    """Module that has been imported."""

    file: str
    whole: str
    """The file, or the folder of its package."""
    name: str
    """Name of the place, so that the module can be imported from it."""


def find_layout(
    preparation: Mapping[str, Any], left_out: frozenset[str], program: ProgramFile | None = None
) -> Layout:
    """Return the layout of a program, whose children are prepared by ``preparation``.

    Without ``program`` it is this one.  Of the folders ``left_out`` only imported modules are sent.
    """
    main, folder = program or ProgramFile.of_this_process()
    here = os.path.abspath(preparation["dir"])
    program_folder = here if main is None else folder
    # Other main modules are imported by their names, or not at all (a package's __main__).
    by_path = "init_main_from_path" in preparation
    path = list(map(os.path.abspath, preparation["sys_path"]))
    whole = (
        folder
        for folder in (program_folder, *path)
        if folder == program_folder or _is_offered(folder)
    )
    places = Places(_named(_outermost(f for f in whole if _is_sent(f) and f not in left_out)))
    modules = sorted(_imported(left_out))
    if main is not None:
        modules.append(_ImportedModule(main, main, os.path.basename(main)))
    loose = [module for module in modules if places.place_of(module.file) is None]
    places.update({module.whole: f"{LOOSE}/{module.name}" for module in loose})
    return Layout(
        places,
        program_folder,
        tuple(module.file for module in modules),
        tuple(dict.fromkeys(tree for tree in path if _is_tree(tree, places))),
        _session(here).intersection(places) if main is None else frozenset(),
        ProgramPaths(
            *_search_path(places, path),
            directory=(is_inside(here, program_folder) and places.name_of(here))
            or places.name_of(program_folder)
            or LOOSE,
            main=None if main is None or not by_path else places.name_of(main),
        ),
    )


def _session(here: str) -> frozenset[str]:
    # An interactive interpreter has its first working directory on its path.
    return frozenset({here, os.path.abspath(started_in())})


def _folder_of(main: str) -> str:
    folder = os.path.dirname(main)
    spec = sys.modules["__main__"].__spec__
    for _ in range(0 if spec is None else spec.name.count(".")):
        folder = os.path.dirname(folder)
    return folder


def _search_path(places: Places, path: list[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the entries of the other machine's ``sys.path``, before and after the library.

    A package may itself be a place, such as that of a script which lies in its own package.  Then
    the folder of all places stands for the folder around the package.
    """
    around = {os.path.dirname(place) for place, name in places.items() if _is_package(place, name)}

    def there(entries: list[str]) -> list[str]:
        names = [
            _ALL_PLACES if entry in around else places.name_of(entry)
            for entry in entries
            if not is_installed(entry)
        ]
        return [name for name in names if name is not None]

    library = sysconfig.get_path("stdlib")
    end = path.index(library) if library in path else len(path)
    before, after = there(path[:end]), there(path[end:])
    if any(name.startswith(f"{LOOSE}/") for name in places.values()):
        before.append(LOOSE)
    return tuple(before), tuple(after)


def _is_package(place: str, name: str) -> bool:
    """Tell whether a place is a package that has its own name on the other machine."""
    return name == os.path.basename(place) and os.path.isfile(os.path.join(place, "__init__.py"))


def _is_offered(folder: str) -> bool:
    return os.path.isfile(os.path.join(folder, INCLUDING))


def _is_tree(folder: str, places: Places) -> bool:
    return os.path.isdir(folder) and not is_installed(folder) and places.name_of(folder) is None


def _is_sent(path: str) -> bool:
    return os.path.exists(path) and not (is_installed(path) or _is_shared(path))


def _is_shared(folder: str) -> bool:
    """Return whether the folder has unrelated files, as a home folder does."""
    home, here = os.path.realpath(os.path.expanduser("~")), os.path.realpath(folder)
    return is_inside(home, here) or here == os.path.realpath(tempfile.gettempdir())


def _outermost(paths: Iterable[str]) -> list[str]:
    """Return each path once, without those within another."""
    found = list(dict.fromkeys(paths))
    return [
        path
        for path in found
        if not any(path != other and is_inside(path, other) for other in found)
    ]


def _named(paths: Iterable[str]) -> dict[str, str]:
    """Return a different name for each path, as close to its own as possible."""
    names: dict[str, str] = {}
    for path in paths:
        name = wanted = os.path.basename(path)
        number = 1
        while name in (LOOSE, *names.values()):
            number += 1
            name = f"{wanted}-{number}"
        names[path] = name
    return names


def _imported(left_out: frozenset[str]) -> Iterator[_ImportedModule]:
    """Yield the imported modules that are not installed, including parts of packages."""
    for name, module in list(sys.modules.items()):
        if name in ("__main__", "__mp_main__") or name.partition(".")[0] == "fiber_api":
            continue  # a part of Fiber
        file = getattr(module, "__dict__", {}).get("__file__")
        if not isinstance(file, str) or is_installed(file) or not os.path.isfile(file):
            continue
        package, *_ = parts = name.split(".")
        top = sys.modules.get(package, module)
        folder = next(iter(_search_path_of(top)), None)
        if folder is not None and getattr(top, "__file__", None):
            yield _ImportedModule(file, folder, package)
        elif portion := _portion(top, file, left_out):
            yield _ImportedModule(file, portion, package)
        else:  # of a namespace package, whose folder may have unrelated files
            if not _search_path_of(module):
                parts.pop()
            yield _ImportedModule(file, file, os.path.join(*parts, os.path.basename(file)))


def _search_path_of(module: Any) -> list[str]:
    """Return the folders of a package.  A module may have an empty ``__path__``, as six has."""
    return list(getattr(module, "__path__", ()))


def _portion(package: Any, file: str, left_out: frozenset[str]) -> str | None:
    """Return the folder of a namespace package with ``file``; None if it may have others."""
    folders = (os.path.abspath(folder) for folder in getattr(package, "__path__", ()))
    folder = next((folder for folder in folders if is_inside(file, folder)), None)
    if folder is None:
        return None
    around = os.path.dirname(folder)
    return None if around in left_out or _is_shared(around) else folder


INCLUDING = ".fiberignore"
"""File by which a folder is sent, and by which ignored files in it are sent."""

_FILES = (".gitignore", INCLUDING)

_REPOSITORIES = (".git", ".hg", ".svn")

BYTECODE = "__pycache__"
"""Folder in which Python keeps compiled modules."""

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
"""Files that tools and editors leave.  A line ``!name`` of an ignore file sends them."""


class _Level(NamedTuple):
    folder: str
    name: str
    patterns: GitIgnoreSpec

    def decide(self, path: str) -> _Decision | None:
        # No pattern has a line break, and pathspec's expressions do not match one.
        found = self.patterns.check_file(path[len(self.folder) + 1 :].replace("\n", "\0"))
        if found.include is None or found.index is None:
            return None
        return _Decision(found.include, str(self.patterns.patterns[found.index].pattern), self)


class _Decision(NamedTuple):
    """Line of an ignore file that applies to a path."""

    ignored: bool
    line: str
    level: _Level

    def names(self, path: str) -> bool:
        """Return whether the line names the path itself, and not a folder around it."""
        last = self.line.strip().rstrip("/").rpartition("/")[2].removeprefix("!")
        name = os.path.basename(path.rstrip("/"))
        return bool(last.strip("*")) and fnmatch.fnmatchcase(name, last)


class IgnoreRules:
    """Ignore rules of one folder."""

    def __init__(self, levels: tuple[_Level, ...]) -> None:
        self._levels = levels

    @classmethod
    def around(cls, folder: str) -> IgnoreRules:
        """Return the rules for ``folder`` from the folders around it.

        If they ignore the folder itself, there are no rules: they do not fit a program in it.
        """
        rules = cls(())
        for outer in _up_to_repository(folder):
            rules = rules.within(outer)
            way = os.path.relpath(folder, outer).split(os.sep)
            if rules.ignores(os.path.join(outer, way[0]), is_folder=True):
                return cls(())
        return rules

    def within(self, folder: str) -> IgnoreRules:
        """Return the rules of ``folder``, below the folder of these rules."""
        top = folder.rstrip(os.sep)
        found = [_Level(top, name, _compiled(text)) for name, text in _read_all(folder)]
        return IgnoreRules((*self._levels, *found)) if found else self

    def ignores(self, path: str, *, is_folder: bool) -> str | None:
        """Return why ``path``, in the folder, is ignored; None if it is not."""
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
        """Return whether a line ``!name`` of ``.fiberignore`` names ``path``, so it is sent."""
        path += "/" if is_folder else ""
        for level in reversed(self._levels):
            decision = level.decide(path) if level.name == INCLUDING else None
            if decision is not None:
                return not decision.ignored and decision.names(path)
        return False


def _up_to_repository(folder: str) -> list[str]:
    """Return the folders around ``folder`` in its repository, the outermost first."""
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
        except OSError:  # missing or unreadable; git ignores it too
            continue


@lru_cache(maxsize=256)
def _compiled(text: str) -> GitIgnoreSpec:
    lines = filter(_is_pattern, text.split("\n"))
    return GitIgnoreSpec.from_lines(lines, backend="simple")


def _is_pattern(line: str) -> bool:
    try:
        GitIgnoreSpecPattern(line)
    except GitIgnorePatternError:  # git ignores the line
        return False
    return True
