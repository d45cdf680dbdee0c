"""File of the program's main module, and whether files are installed."""

from __future__ import annotations

import os
import sys
import sysconfig
from functools import lru_cache
from multiprocessing import process as mp_process

from fiber._worker_images import INSTALLED


def main_file() -> str | None:
    """Return the file of the main module; None if it is installed or has no file.

    Agents can import the main module if there is such a file.
    """
    path = getattr(sys.modules["__main__"], "__file__", None)
    if path is None:
        return None
    path = os.path.abspath(os.path.join(started_in(), path))
    return path if os.path.isfile(path) and not is_installed(path) else None


def started_in() -> str:
    """Return the working directory in which the program was started; empty if it is gone."""
    directory: str | None = mp_process.ORIGINAL_DIR  # type: ignore[attr-defined]
    return directory or ""


def is_installed(path: str) -> bool:
    """Return whether ``path`` belongs to the interpreter, to an installed package or to Fiber."""
    if not set(INSTALLED).isdisjoint(path.split(os.sep)):
        return True
    return any(is_inside(path, folder) for folder in _own_folders())


@lru_cache(maxsize=1)
def _own_folders() -> frozenset[str]:
    """Return the folders of the interpreter, and that of Fiber."""
    kinds = ("stdlib", "platstdlib", "scripts")
    fiber = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    return frozenset({fiber, *map(sysconfig.get_path, kinds)})


def is_inside(path: str, folder: str) -> bool:
    """Return whether ``path`` is ``folder`` or is in it."""
    return path == folder or path.startswith(folder.rstrip(os.sep) + os.sep)
