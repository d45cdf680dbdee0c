"""Locks and semaphores, and how they get into other processes: of this host and of others."""

from __future__ import annotations

import copyreg
import weakref
from typing import Any, TypeAlias

from fiber._hub import heap
from fiber._hub.handles import BlockHandle, handle_for_block, handle_for_remote_block, ring
from fiber._hub.protocol import ObjectKind
from fiber._hub.remote_semaphore import RemoteSemaphore
from fiber._sync.semaphore import SIZE, SharedSemaphore

AnySemaphore: TypeAlias = SharedSemaphore | RemoteSemaphore

# One object for each in a process: only so a recursive one knows its thread again, however often it
# was unpickled.  By the identity of its block, or by the one that its hub elsewhere gave it.
_known: weakref.WeakValueDictionary[tuple[object, ...], AnySemaphore] = (
    weakref.WeakValueDictionary()
)


def create(kind: int, value: int, maximum: int) -> SharedSemaphore:
    """A new one, with ``value`` of at most ``maximum`` tokens."""
    block = heap.allocate(SIZE)
    new = _known[block.identity] = SharedSemaphore.create(block, kind, value, maximum, ring)
    return new


def _rebuild(handle: BlockHandle, kind: int, maximum: int) -> AnySemaphore:
    home = handle.elsewhere()
    if home is not None:
        remote = RemoteSemaphore(home, handle.extent, kind, maximum)
        return _known.setdefault((home.identity,), remote)
    block = handle.block()
    known = _known.get(block.identity)
    if known is None:
        known = _known.setdefault(block.identity, SharedSemaphore(block, kind, ring))
    return known


def _reduce(semaphore: SharedSemaphore) -> tuple[Any, ...]:
    assert isinstance(semaphore.block, heap.Block)
    handle = handle_for_block(ObjectKind.SEMAPHORE, semaphore.block)
    return _rebuild, (handle, semaphore.kind, semaphore.maximum)


def _reduce_remote(remote: RemoteSemaphore) -> tuple[Any, ...]:
    handle = handle_for_remote_block(remote, remote.extent)
    return _rebuild, (handle, remote.kind, remote.maximum)


copyreg.pickle(SharedSemaphore, _reduce)
copyreg.pickle(RemoteSemaphore, _reduce_remote)
