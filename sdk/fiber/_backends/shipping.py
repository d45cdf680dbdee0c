"""Archive of the program for agents that do not share its file system.

The files go into one archive. The same files give the same bytes, so each agent receives an archive
once.
"""

from __future__ import annotations

import contextlib
import gzip
import io
import os
import re
import stat
import tarfile
import warnings
from collections.abc import Iterable, Mapping
from itertools import islice
from typing import Any, NamedTuple

from fiber._agent.child import ProgramPaths
from fiber._backends import program_files
from fiber._backends.main_module import main_file
from fiber._backends.program_files import FileEntry, UnsentFile, Why, select
from fiber._backends.program_layout import INCLUDING, Layout, find_layout
from fiber._wire.memory_files import Blob
from fiber.errors import ProgramTooLarge, in_one_line

_SHOWN = 10
"""Number of entries that a warning lists."""


class PackedProgram(NamedTuple):
    """Archive of the program's files, and their paths in it."""

    archive: Blob
    paths: ProgramPaths


class Shipping:
    """Packer of this program's files, which warns of files that are not sent.  Any thread."""

    def __init__(self) -> None:
        self._latest: tuple[dict[str, FileEntry], PackedProgram] | None = None
        self._left_out: frozenset[str] = frozenset()
        self._warned: set[str] = set()
        """Warnings that were given, and the paths in them."""

    def program(self, preparation: Mapping[str, Any], *, anew: bool) -> PackedProgram:
        """Return the program for children that are prepared by ``preparation``; ProgramTooLarge.

        ``anew``: pack the present files, not those that were packed for the last child.
        """
        if self._latest is None or anew:
            self._latest = self._pack(preparation)
        return self._latest[1]

    def _pack(self, preparation: Mapping[str, Any]) -> tuple[dict[str, FileEntry], PackedProgram]:
        layout = find_layout(preparation, self._left_out)
        if main_file() is not None and layout.places.place_of(layout.program) is None:
            self._warn(
                f"the program is in {layout.program!r}, a folder with unrelated files: workers on "
                "other machines get only the modules that it has imported. Move the program to a "
                "separate folder to send its other files."
            )
        try:
            files, left_out = select(layout)
            self._warn_of_left_out(layout, left_out)
            latest = self._latest
            if latest is not None and latest[0] == files:
                return files, latest[1]._replace(paths=layout.paths)
            packed = pack(layout, files)
        except ProgramTooLarge as error:
            if not layout.session:
                raise
            self._left_out |= layout.session
            self._warn(
                f"{error} Until then workers get only imported modules of the working directory."
            )
            return self._pack(preparation)
        self._warn_of_torn(packed.torn)
        archive = Blob(packed.archive)
        if latest is not None and latest[1].archive.digest == archive.digest:
            archive = latest[1].archive  # new times, same contents
        return files, PackedProgram(archive, layout.paths)

    def _warn_of_left_out(self, layout: Layout, left_out: Iterable[UnsentFile]) -> None:
        """Warn once of each path that is left out unexpectedly."""
        news = [left for left in left_out if left.path not in self._warned]
        self._warned.update(left.path for left in news)
        for why, sentence in _SENTENCES.items():
            entries = [left for left in news if left.why is why]
            if entries:
                shown = _shown(f"{left.path} ({left.detail})" for left in entries)
                more = f"  and {len(entries) - _SHOWN} more: fiber.shipping.listing()"
                shown += [more] * (len(entries) > _SHOWN)
                self._warn("\n".join((sentence, *shown, _advice(layout, entries[0].path))))

    def _warn_of_torn(self, torn: list[str]) -> None:
        """Warn once of each file that changed during each attempt to read it."""
        news = [path for path in torn if path not in self._warned]
        self._warned.update(news)
        if news:
            self._warn("\n".join((_TORN, *_shown(news))))

    def _warn(self, message: str) -> None:
        if message not in self._warned:
            self._warned.add(message)
            warnings.warn(message, RuntimeWarning, stacklevel=2)


_SENTENCES = {
    Why.SECRET: "workers on other machines do not get these, which look like secrets:",
    Why.LINK: "workers on other machines do not get these links, which lead out of their folder:",
}


_TORN = (
    "these files changed each time that they were read, so workers on other machines may have them "
    "half written. Write to another file and rename it, or name it in .fiberignore if workers do "
    "not need it:"
)


def _shown(lines: Iterable[str]) -> list[str]:
    return [f"  {in_one_line(line)}" for line in islice(lines, _SHOWN)]


def _advice(layout: Layout, path: str) -> str:
    place = layout.places.place_of(path) or os.path.dirname(path)
    rules = os.path.join(place, INCLUDING)
    # These characters have a special meaning in a line of .fiberignore.
    name = re.sub(r"[^\w./@+~:,%= -]| $", "?", path[len(place) :])
    return (
        f"To send one that workers need, write a line with its name into {rules}, "
        f"for example {'!' + name!r}. The line {name!r} leaves it out without this warning."
    )


_ATTEMPTS = 3
"""Attempts to read a file that changes meanwhile."""


class Packed(NamedTuple):
    """Archive, and the paths of files that it may have half written."""

    archive: bytes
    torn: list[str]


def pack(layout: Layout, files: dict[str, FileEntry]) -> Packed:
    """Return an archive of the present files: names in order, without times and owners."""
    buffer = io.BytesIO()
    torn: list[str] = []
    with (
        gzip.GzipFile("", "wb", 1, buffer, mtime=0) as compressed,
        tarfile.open(fileobj=compressed, mode="w|", format=tarfile.PAX_FORMAT) as archive,
    ):
        for folder in _folders_of(files):
            archive.addfile(_member(folder, stat.S_IFDIR))
        left = program_files.LIMIT
        for name in sorted(files, key=os.fsencode):
            left -= _append(archive, name, files[name], torn)
            if left < 0:
                raise program_files.too_large(layout, files, "files that are growing")
    return Packed(buffer.getvalue(), torn)


def _folders_of(names: dict[str, FileEntry]) -> list[str]:
    """Return all folders of the archive, outer ones before inner ones."""
    folders = {name for name, entry in names.items() if stat.S_ISDIR(entry.mode)}
    for name in names:
        while name := os.path.dirname(name):
            folders.add(name)
    return sorted(folders, key=os.fsencode)


def _append(archive: tarfile.TarFile, name: str, entry: FileEntry, torn: list[str]) -> int:
    """Add a file or link; return its number of bytes."""
    member = _member(name, entry.mode)
    if entry.target is not None:
        member.linkname = entry.target
        archive.addfile(member)
    elif stat.S_ISREG(entry.mode) and (data := _read(entry.path, torn)) is not None:
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


def _read(path: str, torn: list[str]) -> bytes | None:
    """Read a file in one state, and not parts of two states; None if it cannot be read.

    A file that changes each time is added to ``torn``.
    """
    data = None
    with contextlib.suppress(OSError):
        for _ in range(_ATTEMPTS):
            # Do not wait if a pipe has replaced the file.
            with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
                before = os.fstat(file.fileno())
                if not stat.S_ISREG(before.st_mode):
                    return None
                data = file.read(program_files.LIMIT + 1)
                after = os.fstat(file.fileno())
            if (before.st_size, before.st_mtime_ns) == (after.st_size, after.st_mtime_ns):
                return data
        torn.append(path)
    return data
