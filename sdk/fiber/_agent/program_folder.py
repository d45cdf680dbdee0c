"""The program's files on a host that does not share the program's file system.

The master packs the files (``fiber._backends.shipping``).  A zygote unpacks them to a new folder
before it imports anything from there, and removes the folder when it ends.
"""

from __future__ import annotations

import os
import sys
from typing import IO, TYPE_CHECKING, Any, NamedTuple

from fiber._wire.descriptor import contents

if TYPE_CHECKING:
    import tarfile

_INSTALLED = ("site-packages", "dist-packages")


class ProgramPaths(NamedTuple):
    """Paths of the program's folders and files, relative to the folder that holds them."""

    before_library: tuple[str, ...]
    """Entries of ``sys.path`` before the standard library, such as a script's folder."""
    before_installed: tuple[str, ...]
    """Entries after the standard library; here they come before all installed packages."""
    directory: str
    """Working directory."""
    main: str | None
    """File of the main module, if children import that by its path."""


def places(paths: ProgramPaths, folder: str) -> dict[str, Any]:
    """Return the entries of a child's preparation that hold paths."""

    def here(names: tuple[str, ...]) -> list[str]:
        return [os.path.join(folder, name) for name in names]

    library, installed = _own_path(folder)
    directory = os.path.join(folder, paths.directory)
    data: dict[str, Any] = {
        "sys_path": here(paths.before_library) + library + here(paths.before_installed) + installed,
        "dir": directory,
        "orig_dir": directory,
    }
    if paths.main is not None:
        data["init_main_from_path"] = os.path.join(folder, paths.main)
    return data


def _own_path(folder: str) -> tuple[list[str], list[str]]:
    """Return this interpreter's ``sys.path`` in two parts: standard library, installed packages."""
    own = [path for path in sys.path if path and not path.startswith(folder + os.sep)]
    names = map(os.path.basename, own)
    end = next((index for index, name in enumerate(names) if name in _INSTALLED), len(own))
    return own[:end], own[end:]


def unpack(archive: int, folder: str) -> None:
    """Unpack the file ``archive`` to a new ``folder``: folders, plain files, links within it.

    ValueError: the archive has something else.  After an error there is no folder.
    """
    import shutil
    import tarfile  # needed only if a program was sent

    os.mkdir(folder, 0o700)
    try:
        file: Any = contents(archive)
        with tarfile.open(fileobj=file, mode="r|gz") as members:
            _extract(members, folder)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _extract(members: tarfile.TarFile, folder: str) -> None:
    links = []
    for member in members:
        path = os.path.join(folder, _within(member.name, member.name))
        if member.isdir():
            os.mkdir(path, 0o700)
        elif member.isreg():
            _write(path, members.extractfile(member), executable=bool(member.mode & 0o100))
        elif member.issym():
            _within(os.path.join(os.path.dirname(member.name), member.linkname), member.name)
            links.append((member.linkname, path))
        else:
            raise ValueError(f"{member.name!r} is neither a file nor a folder nor a link")
    # Links come last, so that no file is written through a link.
    for target, path in links:
        os.symlink(target, path)


def _within(path: str, name: str) -> str:
    normal = os.path.normpath(path)
    if os.path.isabs(normal) or normal.split(os.sep)[0] in (os.pardir, os.curdir):
        raise ValueError(f"{name!r} leads out of the folder")
    return normal


def _write(path: str, source: IO[bytes] | None, *, executable: bool) -> None:
    import shutil

    assert source is not None
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        shutil.copyfileobj(source, file)
        if executable:
            os.fchmod(file.fileno(), 0o700)
