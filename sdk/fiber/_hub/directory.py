"""Directory of a hub: its socket, and notes of named shared memory, which outlives processes.

The last process of the program removes the directory.  That may be the zygote, so this module
imports little.
"""

from __future__ import annotations

import _posixshmem
import contextlib
import os
import shutil

HUB_SOCKET = "hub"
"""Name of the hub's socket."""

_NOTE = "memory-"


def note_memory(directory: str, name: str) -> None:
    """Note that ``name`` is removed together with the directory."""
    with open(os.path.join(directory, _NOTE + name), "xb"):
        pass


def forget_memory(directory: str, name: str) -> None:
    """Remove the note of a name that was removed."""
    with contextlib.suppress(FileNotFoundError):
        os.unlink(os.path.join(directory, _NOTE + name))


def remove_directory(path: str) -> None:
    """Remove a hub's directory and its named shared memory, if they are still there."""
    with contextlib.suppress(OSError):
        for entry in os.listdir(path):
            if entry.startswith(_NOTE):
                with contextlib.suppress(FileNotFoundError):
                    _posixshmem.shm_unlink("/" + entry.removeprefix(_NOTE))
    shutil.rmtree(path, ignore_errors=True)
