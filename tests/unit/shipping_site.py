"""A program on this machine, and a place where its files have been unpacked."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from fiber._agent.child import ProgramPaths
from fiber._agent.zygote import unpack
from fiber._backends.program_files import FileEntry, select
from fiber._backends.program_layout import Layout, Places
from fiber._backends.shipping import pack
from fiber._wire.memory_files import Blob

NOWHERE = ProgramPaths((), (), "", None)


def layout(*folders: Path, program: Path | None = None, files: tuple[Path, ...] = ()) -> Layout:
    """Return the layout of a program that has these folders."""
    places = Places({str(folder): folder.name for folder in folders})
    return Layout(
        places, str(program or folders[0]), tuple(map(str, files)), (), frozenset(), NOWHERE
    )


def files(*folders: Path, **options: Any) -> dict[str, FileEntry]:
    """Return the files of them that are sent."""
    return select(layout(*folders, **options)).files


def packed(*folders: Path, **options: Any) -> bytes:
    """The archive of them."""
    there = layout(*folders, **options)
    return pack(there, select(there).files).archive


def unpacked(archive: bytes, target: Path) -> Path:
    """Unpack the archive into ``target``."""
    blob = Blob(archive)  # it keeps its descriptor open
    unpack(blob.fileno(), str(target))
    return target


def write(folder: Path, **contents: str | bytes) -> Path:
    """``folder``, with files: ``a__b_py`` is a/b.py."""
    for name, text in contents.items():
        path = folder / name.replace("__", "/").replace("_", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder


def tree(folder: Path) -> dict[str, bytes | str | None]:
    """All that is in it: contents, targets of links, None for folders."""
    found: dict[str, bytes | str | None] = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_symlink():
            found[name] = os.readlink(path)
        else:
            found[name] = None if path.is_dir() else path.read_bytes()
    return found
