"""The directory of a hub: its socket, and notes of named shared memory, which outlives processes.

Whoever outlives the program removes it, the zygote too, so this imports little.
"""

from __future__ import annotations

import _posixshmem
import contextlib
import os
import shutil

_NOTE = "memory-"


def note_memory(directory: str, name: str) -> None:
    """Remove the shared memory ``name`` together with the directory."""
    with open(os.path.join(directory, _NOTE + name), "xb"):
        pass


def forget_memory(directory: str, name: str) -> None:
    """Forget a name that was removed."""
    with contextlib.suppress(FileNotFoundError):
        os.unlink(os.path.join(directory, _NOTE + name))


def remove_directory(path: str) -> None:
    """Remove a hub's directory, also after its process was killed; nothing if it is gone."""
    with contextlib.suppress(OSError):
        for entry in os.listdir(path):
            if entry.startswith(_NOTE):
                with contextlib.suppress(FileNotFoundError):
                    _posixshmem.shm_unlink("/" + entry.removeprefix(_NOTE))
    shutil.rmtree(path, ignore_errors=True)
