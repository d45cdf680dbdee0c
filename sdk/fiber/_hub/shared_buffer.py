"""Memory for a user's object, which goes wherever that is pickled to.

On the host where it was made, every process has the memory itself.
"""

from __future__ import annotations

from typing import Any

from fiber._hub import heap
from fiber._hub.handles import BlockHandle, handle_for_block
from fiber._hub.heap import Block
from fiber._hub.protocol import ObjectKind


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
        return _rebuild, (handle_for_block(ObjectKind.MEMORY, self._block),)


def allocate(size: int) -> SharedBuffer:
    """A new one."""
    return SharedBuffer(heap.allocate(size))


def _rebuild(handle: BlockHandle) -> SharedBuffer:
    return SharedBuffer(handle.block())
