"""Memory for a user's object, which goes wherever that is pickled to.

On the host where it was made, every process has the memory itself.
"""

from __future__ import annotations

import pickle
from multiprocessing import context as mp_context
from typing import Any

from fiber._hub import client, heap
from fiber._hub.handles import BlockHandle, handle_for_block
from fiber._hub.heap import Block
from fiber._hub.protocol import ObjectKind

_ONE_HOST = (
    "memory is shared by the processes of one host. Send the data through a Pipe or Queue, or keep "
    "it in a manager"
)


class SharedBuffer:
    """Some bytes of shared memory, zero at first."""

    __slots__ = ("__weakref__", "_block")

    def __init__(self, block: Block) -> None:
        self._block = block

    @property
    def view(self) -> memoryview:
        """The bytes; to be used while this object is kept."""
        return self._block.view

    def __reduce__(self) -> tuple[Any, ...]:
        spawning: Any = mp_context.get_spawning_popen()
        if getattr(spawning, "other_host", False):
            raise pickle.PicklingError(f"the process runs on another host, and {_ONE_HOST}")
        return _rebuild, (handle_for_block(ObjectKind.MEMORY, self._block),)


def allocate(size: int) -> SharedBuffer:
    """A new one."""
    return SharedBuffer(heap.allocate(size))


def _rebuild(handle: BlockHandle) -> SharedBuffer:
    elsewhere = handle.elsewhere()
    if elsewhere is not None:
        raise pickle.UnpicklingError(
            f"a Value or Array of {handle.extent.size} bytes was made on host "
            f"{elsewhere.home.host!r} and came to {client.host()!r}: {_ONE_HOST}"
        )
    return SharedBuffer(handle.block())
