"""Locks and semaphores of this host, and how they get into other processes."""

from __future__ import annotations

import copyreg
import pickle
import weakref
from multiprocessing import context as mp_context
from typing import Any

from fiber._hub import heap
from fiber._hub.handles import BlockHandle, handle_for_block
from fiber._hub.protocol import ObjectKind
from fiber._sync.semaphore import SIZE, SharedSemaphore
from fiber.errors import NotInFiber

_ONE_HOST = (
    "a lock or semaphore cannot be used on another host than the one that it was made on yet. "
    "Please coordinate hosts by a Queue, an Event or the Lock of a manager"
)

# One object for each in a process, by the identity of its block: only so a recursive one knows
# its thread again, however often it was unpickled.
_known: weakref.WeakValueDictionary[tuple[int, int], SharedSemaphore] = (
    weakref.WeakValueDictionary()
)


def create(kind: int, value: int, maximum: int) -> SharedSemaphore:
    """A new one, with ``value`` of at most ``maximum`` tokens."""
    block = heap.allocate(SIZE)
    new = _known[block.identity] = SharedSemaphore.create(block, kind, value, maximum)
    return new


def _rebuild(handle: BlockHandle, kind: int, maximum: int) -> SharedSemaphore:
    if handle.elsewhere() is not None:
        raise NotInFiber(_ONE_HOST)
    block = handle.block()
    known = _known.get(block.identity)
    if known is None:
        known = _known.setdefault(block.identity, SharedSemaphore(block, kind, maximum))
    return known


def _reduce(semaphore: SharedSemaphore) -> tuple[Any, ...]:
    assert isinstance(semaphore.block, heap.Block)
    spawning: Any = mp_context.get_spawning_popen()
    if getattr(spawning, "other_host", False):
        raise pickle.PicklingError(f"the process runs on another host, and {_ONE_HOST}")
    handle = handle_for_block(ObjectKind.SEMAPHORE, semaphore.block)
    return _rebuild, (handle, semaphore.kind, semaphore.maximum)


copyreg.pickle(SharedSemaphore, _reduce)
