"""The program's files in one archive: the same files are the same bytes."""

from __future__ import annotations

import contextlib
import gzip
import io
import os
import stat
import tarfile
from typing import NamedTuple

from fiber._backends import program_files
from fiber._backends.program_files import Entry
from fiber._backends.program_layout import Layout

_ATTEMPTS = 3
"""Times to read a file that changes meanwhile."""


class Packed(NamedTuple):
    """An archive, and the paths of files that may be in it half written."""

    archive: bytes
    torn: list[str]


def pack(layout: Layout, files: dict[str, Entry]) -> Packed:
    """The archive: names in order, no times, no owners.  Reads what is there now."""
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


def _folders_of(names: dict[str, Entry]) -> list[str]:
    """The folders that must be there first, outer ones before inner ones."""
    folders = {name for name, entry in names.items() if stat.S_ISDIR(entry.mode)}
    for name in names:
        while name := os.path.dirname(name):
            folders.add(name)
    return sorted(folders, key=os.fsencode)


def _append(archive: tarfile.TarFile, name: str, entry: Entry, torn: list[str]) -> int:
    """Add a file or link; the bytes that it has."""
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
            # A pipe in its place meanwhile must not be waited for.
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
