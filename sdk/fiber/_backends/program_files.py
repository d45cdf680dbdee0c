"""Selection of the program's files that are sent, with the reasons for those that are not."""

from __future__ import annotations

import enum
import os
import stat
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

from fiber._backends import secret_files
from fiber._backends.program_layout import IgnoreRules, Layout
from fiber.errors import ProgramTooLarge

LIMIT = 100 << 20
"""Bytes of all files together."""

MOST_FILES = 50_000

_LARGEST = 5
"""Entries that an error lists."""


class Entry(NamedTuple):
    """File, folder or link, as it was found."""

    path: str
    """Path on this host.  The contents are read from there, through a link if need be."""
    mode: int
    size: int = 0
    modified: int = 0
    target: str | None = None
    """Target of a link within the folder.  For other links their target is sent in their place."""


class Why(enum.Enum):
    """Reason to leave something out."""

    IGNORED = "ignored"
    SECRET = "secret"
    LINK = "link"
    PATH = "path"
    UNREADABLE = "unreadable"


class LeftOut(NamedTuple):
    """File, folder or link that is not sent."""

    path: str
    why: Why
    detail: str


class Selection(NamedTuple):
    """Files that are sent, by their names in the archive, and files that are left out."""

    files: dict[str, Entry]
    left_out: tuple[LeftOut, ...]


def select(layout: Layout, *, bounded: bool = True) -> Selection:
    """Return what is sent of the program; ProgramTooLarge if that is too much and ``bounded``."""
    found: dict[str, Entry] = {}
    name_of = layout.places.name_of
    walk = _Walk(layout)
    for top in dict.fromkeys((*layout.places, layout.program, *layout.files)):
        if name_of(top) is None:
            continue
        for path, entry in walk.everything_in(top):
            found[name_of(path) or path] = entry
            if bounded and len(found) > MOST_FILES:
                raise too_large(layout, found, f"more than {MOST_FILES:,} files")
    if bounded:
        _check_size(layout, found)
    if layout.paths.directory:  # whatever of it is sent, somebody will work in it
        found.setdefault(layout.paths.directory, Entry("", stat.S_IFDIR))
    sent = {entry.path for entry in found.values()}
    return Selection(found, tuple(left for left in walk.left_out if left.path not in sent))


def _check_size(layout: Layout, found: dict[str, Entry]) -> None:
    total = sum(entry.size for entry in found.values())
    if total > LIMIT:
        raise too_large(layout, found, mebibytes(total))


def too_large(layout: Layout, found: dict[str, Entry], what: str) -> ProgramTooLarge:
    """Return the error for a program that has ``what``."""
    sizes: Counter[str] = Counter()
    for entry in found.values():
        place = layout.places.place_of(entry.path) or ""
        below = entry.path[len(place) :].split(os.sep)
        sizes[place + os.sep.join(below[:2]) + os.sep * (len(below) > 2)] += entry.size
    largest = {path: mebibytes(size) for path, size in sizes.most_common(_LARGEST) if size}
    return ProgramTooLarge(layout.program, what, mebibytes(LIMIT), largest)


def mebibytes(size: int) -> str:
    """Return a size for people."""
    return f"{size / (1 << 20):.1f} MiB"


class _Around(NamedTuple):
    """The way to a folder."""

    folders: tuple[str, ...]
    """The real folders that it was come to through, and itself."""
    top: str
    """The real folder that links may lead to: the first, or where a link has led."""
    trusted: bool = False
    """True if an ignore file asks for a folder of secrets around this one."""

    def within(self, real: str, trusted: bool) -> _Around:
        top = self.top if _is_inside(real, self.top) else real
        return _Around((*self.folders, real), top, trusted)


class _Walk:
    """Walk over all files of a program."""

    def __init__(self, layout: Layout) -> None:
        self.left_out: list[LeftOut] = []
        self._packages = {os.path.dirname(file) for file in layout.files}
        """Folders with modules that the program has imported."""

    def everything_in(self, top: str) -> Iterator[tuple[str, Entry]]:
        """``top`` itself and, if it is a folder, what the rules leave of it."""
        entry = _entry(top)
        if entry is None:
            return
        if not _is_readable(entry):
            self.left_out.append(LeftOut(top, Why.UNREADABLE, ""))
            return
        yield top, entry
        if stat.S_ISDIR(entry.mode):
            real = os.path.realpath(top)
            yield from self._walk(top, IgnoreRules.around(top), _Around((real,), real))

    def _walk(
        self, folder: str, rules: IgnoreRules, around: _Around
    ) -> Iterator[tuple[str, Entry]]:
        rules = rules.within(folder)
        for found in _found_in(folder):
            path = found.path
            if found.is_symlink():
                real = os.path.realpath(path)
                entry = _link(path, real, around)
            else:
                real = os.path.join(around.folders[-1], found.name)
                entry = _entry(path)
            if entry is None:
                continue
            is_folder = stat.S_ISDIR(entry.mode)
            left_out = self._objection(entry, real, rules, around)
            if left_out is not None:
                self.left_out.append(left_out)
            elif not is_folder:
                yield path, entry
            elif real not in around.folders:  # or a link leads back to where we came from
                yield path, entry
                trusted = around.trusted or secret_files.in_folder(found.name) is not None
                yield from self._walk(path, rules, around.within(real, trusted))

    def _objection(
        self, entry: Entry, real: str, rules: IgnoreRules, around: _Around
    ) -> LeftOut | None:
        """Why the entry of a folder is left out."""
        path, is_folder = entry.path, stat.S_ISDIR(entry.mode)
        ignored = rules.ignores(path, is_folder=is_folder)
        if ignored is not None:
            return LeftOut(path, Why.IGNORED, ignored)
        holds = None if around.trusted else _secret(entry, real)
        leads_out = not _is_inside(real, around.top) and path not in self._packages
        if (holds or leads_out) and not rules.asks_for(path, is_folder=is_folder):
            return LeftOut(path, Why.SECRET, holds) if holds else LeftOut(path, Why.LINK, real)
        return None if _is_readable(entry) else LeftOut(path, Why.UNREADABLE, "")


def _found_in(folder: str) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as found:
            return list(found)
    except OSError:
        return []


def _is_readable(entry: Entry) -> bool:
    """Tell whether this program can read the file, or list and enter the folder."""
    if entry.target is not None:
        return True
    needed = os.R_OK | os.X_OK if stat.S_ISDIR(entry.mode) else os.R_OK
    return os.access(entry.path, needed)


def _secret(entry: Entry, real: str) -> str | None:
    """Return the kind of secret, if the name of the entry or of its target is that of one."""
    if stat.S_ISDIR(entry.mode):
        names = map(os.path.basename, (entry.path, real))
        return next(filter(None, map(secret_files.in_folder, names)), None)
    for path in dict.fromkeys((entry.path, real)):
        holds = secret_files.in_file(path, entry.size, entry.modified)
        if holds is not None:
            return holds
    return None


def _link(path: str, real: str, around: _Around) -> Entry | None:
    """A link as it is, if it stays within the folder, otherwise what it leads to."""
    first, parent = around.folders[0], around.folders[-1]
    inside = all(_is_inside(place, first) for place in (*around.folders, real))
    if inside and os.path.exists(path):
        return Entry(path, stat.S_IFLNK, target=os.path.relpath(real, parent))
    return _entry(path)


def _is_inside(path: str, folder: str) -> bool:
    return f"{path}/".startswith(f"{folder.rstrip('/')}/")


def _entry(path: str) -> Entry | None:
    """A file or folder; None for anything else, and for what is gone."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    if stat.S_ISDIR(found.st_mode):
        return Entry(path, stat.S_IFDIR)
    if not stat.S_ISREG(found.st_mode):
        return None
    mode = stat.S_IFREG | (found.st_mode & stat.S_IXUSR)
    return Entry(path, mode, found.st_size, found.st_mtime_ns)
