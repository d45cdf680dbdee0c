"""Memory that the processes of one host share."""

from __future__ import annotations

from typing import Any

from fiber._hub import client, handles, heap
from fiber._hub.handles import BlockHandle
from fiber._hub.protocol import ObjectKind


class SharedMemory:
    """A block of the heap that goes to other processes of this host."""

    def __init__(self, block: heap.Block) -> None:
        self._block = block
        self.view = block.view
        self.host = client.host()

    @classmethod
    def allocate(cls, size: int) -> SharedMemory:
        """Memory of ``size`` bytes, all zero."""
        return cls(heap.allocate(size))

    def __reduce__(self) -> tuple[Any, ...]:
        return _attach, (handles.handle_for_block(ObjectKind.MEMORY, self._block),)


def _attach(handle: BlockHandle) -> SharedMemory:
    return SharedMemory(handle.block())
