"""Memory for a user's object, which goes wherever that is pickled to.

On the host where it was made, every process has the memory itself.  On another host they have a
replica, which their hub keeps in step with it (``fiber._hub.replicas``).
"""

from __future__ import annotations

from typing import Any

from fiber._hub import client, heap
from fiber._hub.client import HubStream
from fiber._hub.handles import BlockHandle, HubHandle, handle_for_block, handle_for_remote_block
from fiber._hub.heap import Block, block_of
from fiber._hub.protocol import Extent, ObjectKind, Op, Origin
from fiber._hub.remote import RemoteObject
from fiber._wire.descriptor import own


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


class ReplicaBuffer(SharedBuffer):
    """The same on another host than where it was made."""

    __slots__ = ("_extent", "_original", "_stream")

    def __init__(self, home: HubHandle, extent: Extent) -> None:
        self._extent = extent
        # Keeps the original at its home.
        original = self._original = RemoteObject(*home)
        # Keeps the replica at this host's hub, until this object is forgotten.
        self._stream = HubStream(client.hub_address())
        address, grant, identity = home
        origin = Origin(address.host, identity, extent.size, original.token, grant)
        reply = self._stream.ask(Op.REPLICATE, buffers=[memoryview(origin.encode())])
        (fd,), (offset,) = reply.fds, reply.values
        super().__init__(block_of(own(fd), offset, extent.size))

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (handle_for_remote_block(self._original, self._extent),)


def allocate(size: int) -> SharedBuffer:
    """A new one."""
    return SharedBuffer(heap.allocate(size))


def _rebuild(handle: BlockHandle) -> SharedBuffer:
    home = handle.elsewhere()
    if home is None:
        return SharedBuffer(handle.block())
    return ReplicaBuffer(home, handle.extent)
