"""Named shared memory as in multiprocessing, between the processes of one host.

In multiprocessing a separate process, the resource tracker, removes memory that was not unlinked.
Here the agent of the host does that at the program's end, or the zygote if the agent is killed.
"""

from __future__ import annotations

import _posixshmem
import mmap
import os
import pickle
import types
from multiprocessing import context as mp_context
from multiprocessing import shared_memory as mp_shared_memory
from typing import TYPE_CHECKING, Any, TypeVar

from fiber._hub import client
from fiber._hub.directory import forget_memory, note_memory
from fiber._runtime.state import runtime
from fiber._transport.channels import naming_the_limit

__all__ = ["ShareableList", "SharedMemory"]

_INSTEAD = (
    "named shared memory is for the processes of one host. Use fiber.Array or fiber.RawArray, or "
    "send the data through a Pipe or Queue"
)


_T = TypeVar("_T", int, float, bool, str, bytes, None)

_mp: Any = mp_shared_memory


class SharedMemory(mp_shared_memory.SharedMemory):
    """A block of memory that processes of this host find by its name.

    ``create``: make the block, with ``size`` bytes; FileExistsError if the name is taken.  Without
    it the block must exist, or FileNotFoundError is raised.  A block stays until ``unlink``.  With
    ``track`` it is removed at the program's end at the latest.
    """

    _track = False  # by multiprocessing

    def __init__(
        self, name: str | None = None, create: bool = False, size: int = 0, *, track: bool = True
    ) -> None:
        if size < 0:
            raise ValueError("'size' must be a positive integer")
        if create and not size:
            raise ValueError("'size' must be a positive number different from zero")
        if name is None and not create:
            raise ValueError("'name' can only be None if create=True")
        if not isinstance(name, str | None):
            raise TypeError(f"'name' must be a string, not {name!r}")
        if create:
            self._create(name, size, track)
        else:
            self._open(name or "", 0)
        self._size = os.fstat(self._fd).st_size
        self._mmap = mmap.mmap(self._fd, self._size)
        self._buf = memoryview(self._mmap)

    def _create(self, name: str | None, size: int, track: bool) -> None:
        while self._fd < 0:
            try:
                self._open(name or _mp._make_filename(), os.O_CREAT | os.O_EXCL)
            except FileExistsError:
                if name is not None:
                    raise
        try:
            if track:
                note_memory(_directory(), self.name)
            os.ftruncate(self._fd, size)
        except BaseException:
            self.unlink()
            raise

    def _open(self, name: str, flags: int) -> None:
        path = "/" + name.removeprefix("/")
        with naming_the_limit("sharing memory"):
            try:
                self._fd = _posixshmem.shm_open(path, os.O_RDWR | flags, mode=0o600)
            except FileNotFoundError as error:
                error.strerror = f"no shared memory of this name is on this host, and {_INSTEAD}"
                raise
        self._name = path

    def unlink(self) -> None:
        """Remove the name.  The memory is freed when the last process has closed it."""
        if self._name:
            _posixshmem.shm_unlink(self._name)
            forget_memory(_directory(), self.name)

    def __reduce__(self) -> tuple[Any, ...]:
        spawning: Any = mp_context.get_spawning_popen()
        if getattr(spawning, "other_host", False):
            raise pickle.PicklingError(f"the process runs on another host, and {_INSTEAD}")
        return _attach, (type(self), self.name, client.host())


class ShareableList(mp_shared_memory.ShareableList[_T]):
    """A list of fixed length in a ``SharedMemory``, of numbers, strings, bytes and None."""

    if not TYPE_CHECKING:  # its types are those of the base

        def __init__(self, sequence=None, *, name=None):
            _init_list(self, sequence, name=name)

    def __reduce__(self) -> tuple[Any, ...]:
        return _attach_list, (type(self), self.shm)


# multiprocessing's initializer, with Fiber's class for the memory that it makes.
_init_list = types.FunctionType(
    mp_shared_memory.ShareableList.__init__.__code__,
    {**vars(mp_shared_memory), "SharedMemory": SharedMemory},
    argdefs=mp_shared_memory.ShareableList.__init__.__defaults__,
)
_init_list.__kwdefaults__ = mp_shared_memory.ShareableList.__init__.__kwdefaults__


def _directory() -> str:
    if client.inherited_address() is None:
        runtime()  # has the hub
    return os.path.dirname(client.hub_address().path)


def _attach(cls: type[SharedMemory], name: str, host: str) -> SharedMemory:
    if client.host() != host:
        raise pickle.UnpicklingError(
            f"the shared memory {name!r} of host {host!r} came to {client.host()!r}: {_INSTEAD}"
        )
    return cls(name)


def _attach_list(cls: type[ShareableList[Any]], memory: SharedMemory) -> ShareableList[Any]:
    return cls(name=memory.name)
