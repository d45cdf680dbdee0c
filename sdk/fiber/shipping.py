"""Lists of the program's files that are sent to workers on other hosts, and that are not.

    print(fiber.shipping.listing())

docs/shipping.md has the rules.
"""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing import spawn

from fiber._backends import program_files
from fiber._backends.program_files import FileEntry, Why
from fiber._backends.program_layout import BYTECODE, INCLUDING, LOOSE, Layout, find_layout
from fiber.errors import in_one_line

__all__ = ["LeftOut", "Listing", "Sent", "listing"]


@dataclass(frozen=True, slots=True)
class Sent:
    """A file or link that is sent."""

    path: str
    """Path on this host."""
    name: str
    """Path in the workers' copy of the program's folder."""
    size: int
    """Bytes."""
    reason: str
    """Reason for which it is sent."""


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A file, folder or link that is not sent."""

    path: str
    """Path on this host."""
    size: int | None
    """Bytes, for a folder with its contents.  None for a folder that has too many files or is not
    readable.
    """
    reason: str
    """Reason for which it is left out."""


@dataclass(frozen=True, slots=True)
class Listing:
    """Files that workers get, and files that they do not get.  ``str()`` is a table of them."""

    sent: tuple[Sent, ...]
    left_out: tuple[LeftOut, ...]

    @property
    def size(self) -> int:
        """Bytes of all files that are sent, before they are compressed."""
        return sum(file.size for file in self.sent)

    @property
    def too_large(self) -> bool:
        """True if a pool would refuse to send that much, with ``ProgramTooLarge``."""
        return self.size > program_files.LIMIT or len(self.sent) > program_files.MOST_FILES

    def __repr__(self) -> str:
        return (
            f"<Listing: {_counted(len(self.sent), 'file')} of {_readable(self.size)} sent, "
            f"{len(self.left_out)} left out>"
        )

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        yield f"sent to workers: {_counted(len(self.sent), 'file')}, {_readable(self.size)}"
        if self.too_large:
            yield (
                f"that is too much: at most {program_files.MOST_FILES:,} files and "
                f"{_readable(program_files.LIMIT)} are sent"
            )
        for file in self.sent:
            yield f"{_readable(file.size):>12}  {in_one_line(file.path)}  ({file.reason})"
        yield f"left out: {len(self.left_out)}"
        for left in self.left_out:
            where, why = in_one_line(left.path), in_one_line(left.reason)
            yield f"{_readable(left.size):>12}  {where}  ({why})"


def listing() -> Listing:
    """Return the files that a pool would now send to workers on other hosts.

    The result is the same for every backend, also for one that sends no files.  This sends no file
    and starts no process.
    """
    # Under pdb the main module has no __spec__.
    vars(sys.modules["__main__"]).setdefault("__spec__", None)
    layout = find_layout(spawn.get_preparation_data(""), frozenset())
    files, left_out = program_files.select(layout, bounded=False)
    sent = frozenset(entry.path for entry in files.values())
    entries = [(left.path, _REASONS[left.why].format(left.detail)) for left in left_out]
    entries += [(tree, _REASONS[Why.PATH]) for tree in layout.trees]
    return Listing(
        tuple(sorted(_sent(layout, files), key=lambda file: file.path)),
        tuple(LeftOut(path, _size_of(path, sent), reason) for path, reason in sorted(set(entries))),
    )


_REASONS = {
    Why.IGNORED: "{}",
    Why.SECRET: "looks like a secret: {}",
    Why.LINK: "a link that leads out of its folder, to {}",
    Why.UNREADABLE: "this program may not read it",
    Why.PATH: "on sys.path; what the program imported from it is sent",
}


def _sent(layout: Layout, files: dict[str, FileEntry]) -> Iterator[Sent]:
    imported = frozenset(layout.files)
    for name, entry in files.items():
        if not stat.S_ISDIR(entry.mode):
            yield Sent(entry.path, name, entry.size, _reason(layout, entry.path, imported))


def _reason(layout: Layout, path: str, imported: frozenset[str]) -> str:
    place = layout.places.place_of(path) or ""
    if place == layout.program:
        where = "working directory" if place in layout.session else "program's folder"
        return f"in the {where}" + ", imported" * (path in imported)
    if path in imported:
        return "imported"
    package = layout.places[place].startswith(f"{LOOSE}/")
    return "in a package that was imported" if package else f"in a folder with a {INCLUDING}"


def _size_of(path: str, sent: frozenset[str]) -> int | None:
    """Return the bytes at ``path``, without links, bytecode and the files that are sent."""
    if os.path.islink(path) or not os.path.isdir(path):
        return _bytes_of(path)
    if not os.access(path, os.R_OK | os.X_OK):
        return None
    total = count = 0
    for folder, folders, names in os.walk(path):
        folders[:] = [each for each in folders if each != BYTECODE]
        count += len(names) + 1
        if count > program_files.MOST_FILES:
            return None
        files = (os.path.join(folder, name) for name in names)
        total += sum(_bytes_of(file) for file in files if file not in sent)
    return total


def _bytes_of(path: str) -> int:
    try:
        return os.lstat(path).st_size
    except OSError:
        return 0


def _counted(number: int, what: str) -> str:
    return f"{number:,} {what}" if number == 1 else f"{number:,} {what}s"


def _readable(size: int | None) -> str:
    if size is None:
        return "not counted"
    for unit, bytes_in_it in (("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10)):
        if size >= bytes_in_it:
            return f"{size / bytes_in_it:.1f} {unit}"
    return f"{size} B"
