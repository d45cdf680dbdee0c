"""The program's files in one archive: the same files are the same bytes."""

from __future__ import annotations

import contextlib
import gzip
import io
import os
import stat
import tarfile
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

from fiber._backends.ignore_rules import IgnoreRules
from fiber._backends.program_layout import Layout
from fiber.errors import ProgramTooLarge

LIMIT = 100 << 20
"""Bytes of all files together."""

MOST_FILES = 50_000

_LARGEST = 5
"""Entries that an error lists."""

_ATTEMPTS = 3
"""Times to read a file that changes meanwhile."""


class Entry(NamedTuple):
    """One file, folder or link, as it was when it was found.

    What this program may not read its children could not either, and is left out.
    """

    path: str
    """Here.  Its contents are read from there, through a link if need be."""
    mode: int
    size: int = 0
    modified: int = 0
    target: str | None = None
    """Of a link within a folder; what a link to elsewhere leads to is sent in its place."""


def list_files(layout: Layout) -> dict[str, Entry]:
    """What belongs in the archive, by its name there; or ProgramTooLarge."""
    found: dict[str, Entry] = {}
    name_of = layout.places.name_of
    for top in dict.fromkeys((*layout.places, layout.program, *layout.files)):
        if name_of(top) is None:
            continue
        for path, entry in _everything_in(top):
            found[name_of(path) or path] = entry
            if len(found) > MOST_FILES:
                raise _too_large(layout, found, f"more than {MOST_FILES:,} files")
    _check_size(layout, found)
    if layout.paths.directory:  # whatever of it is sent, somebody will work in it
        found.setdefault(layout.paths.directory, Entry("", stat.S_IFDIR))
    return found


def _check_size(layout: Layout, found: dict[str, Entry]) -> None:
    total = sum(entry.size for entry in found.values())
    if total > LIMIT:
        raise _too_large(layout, found, _mebibytes(total))


def _too_large(layout: Layout, found: dict[str, Entry], what: str) -> ProgramTooLarge:
    sizes: Counter[str] = Counter()
    for entry in found.values():
        place = layout.places.place_of(entry.path) or ""
        below = entry.path[len(place) :].split(os.sep)
        sizes[place + os.sep.join(below[:2]) + os.sep * (len(below) > 2)] += entry.size
    largest = {path: _mebibytes(size) for path, size in sizes.most_common(_LARGEST) if size}
    return ProgramTooLarge(layout.program, what, _mebibytes(LIMIT), largest)


def _mebibytes(size: int) -> str:
    return f"{size / (1 << 20):.1f} MiB"


def _everything_in(top: str) -> Iterator[tuple[str, Entry]]:
    """``top`` itself and, if it is a folder, what the rules leave of it."""
    entry = _entry(top)
    if entry is None:
        return
    yield top, entry
    if stat.S_ISDIR(entry.mode):
        yield from _walk(top, IgnoreRules.around(top), (os.path.realpath(top),))


def _walk(folder: str, rules: IgnoreRules, around: tuple[str, ...]) -> Iterator[tuple[str, Entry]]:
    """``around``: the real folders that this one was come to through, and itself."""
    rules = rules.within(folder)
    for found in _found_in(folder):
        path = found.path
        if found.is_symlink():
            real = os.path.realpath(path)
            entry = _link(path, real, around)
        else:
            real = os.path.join(around[-1], found.name)
            entry = _entry(path)
        if entry is None or rules.ignores(path, is_folder=stat.S_ISDIR(entry.mode)):
            continue
        if not stat.S_ISDIR(entry.mode):
            yield path, entry
        elif real not in around:  # or a link leads back to where we came from
            yield path, entry
            yield from _walk(path, rules, (*around, real))


def _found_in(folder: str) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as found:
            return list(found)
    except OSError:
        return []


def _link(path: str, real: str, around: tuple[str, ...]) -> Entry | None:
    """A link as it is, if it stays within the folder, otherwise what it leads to."""
    top, parent = around[0], around[-1]
    inside = all(f"{place}/".startswith(f"{top}/") for place in (*around, real))
    if inside and os.path.exists(path):
        return Entry(path, stat.S_IFLNK, target=os.path.relpath(real, parent))
    return _entry(path)


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


def pack(layout: Layout, files: dict[str, Entry]) -> bytes:
    """The archive: names in order, no times, no owners.  Reads what is there now."""
    buffer = io.BytesIO()
    with (
        gzip.GzipFile("", "wb", 1, buffer, mtime=0) as compressed,
        tarfile.open(fileobj=compressed, mode="w|", format=tarfile.PAX_FORMAT) as archive,
    ):
        for folder in _folders_of(files):
            archive.addfile(_member(folder, stat.S_IFDIR))
        left = LIMIT
        for name in sorted(files, key=os.fsencode):
            left -= _append(archive, name, files[name])
            if left < 0:
                raise _too_large(layout, files, "files that are growing")
    return buffer.getvalue()


def _folders_of(names: dict[str, Entry]) -> list[str]:
    """The folders that must be there first, outer ones before inner ones."""
    folders = {name for name, entry in names.items() if stat.S_ISDIR(entry.mode)}
    for name in names:
        while name := os.path.dirname(name):
            folders.add(name)
    return sorted(folders, key=os.fsencode)


def _append(archive: tarfile.TarFile, name: str, entry: Entry) -> int:
    """Add a file or link; the bytes that it has."""
    member = _member(name, entry.mode)
    if entry.target is not None:
        member.linkname = entry.target
        archive.addfile(member)
    elif stat.S_ISREG(entry.mode) and (data := _read(entry.path)) is not None:
        member.size = len(data)
        archive.addfile(member, io.BytesIO(data))
        return len(data)
    return 0


def _member(name: str, mode: int) -> tarfile.TarInfo:
    member = tarfile.TarInfo(name)
    member.type = {stat.S_IFDIR: tarfile.DIRTYPE, stat.S_IFLNK: tarfile.SYMTYPE}.get(
        stat.S_IFMT(mode), tarfile.REGTYPE
    )
    member.mode = 0o644 if stat.S_ISREG(mode) and not mode & stat.S_IXUSR else 0o755
    return member


def _read(path: str) -> bytes | None:
    """What is in a file, if it can be in one state, and not of two; None if it cannot be read."""
    data = None
    with contextlib.suppress(OSError):
        for _ in range(_ATTEMPTS):
            # A pipe in its place meanwhile must not be waited for.
            with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
                before = os.fstat(file.fileno())
                if not stat.S_ISREG(before.st_mode):
                    return None
                data = file.read(LIMIT + 1)
                after = os.fstat(file.fileno())
            if (before.st_size, before.st_mtime_ns) == (after.st_size, after.st_mtime_ns):
                break
    return data
