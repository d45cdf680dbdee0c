"""Locks and semaphores of this host and of others, and their way into other processes.

The hub of another host has tokens for this process.  A stream keeps each token.  The hub gives it
back when the stream ends, and the kernel ends it when this process dies.  A semaphore that carries
signals has no such streams.
"""

from __future__ import annotations

import copyreg
import os
import threading
import weakref
from multiprocessing import current_process
from typing import Any, TypeAlias

from fiber._hub import client, heap
from fiber._hub.client import HubStream, Unreachable
from fiber._hub.handles import (
    BlockHandle,
    HubHandle,
    handle_for_block,
    handle_for_remote_block,
    ring,
)
from fiber._hub.protocol import Extent, ObjectKind, Op, Status
from fiber._hub.remote import RemoteObject
from fiber._sync.semaphore import RECURSIVE, SIZE, Abandoned, SharedSemaphore


class RemoteSemaphore(RemoteObject):
    """Semaphore of another host, with the methods of multiprocessing's ``SemLock``."""

    def __init__(self, handle: HubHandle, extent: Extent, kind: int, maximum: int) -> None:
        self.extent = extent
        self.kind = kind
        self.maximum = maximum
        self._holding: list[HubStream] = []
        self._owner: int | None = None
        self._depth = 0
        super().__init__(*handle)

    def acquire(self, block: bool = True, timeout: float | None = None) -> bool | Abandoned:
        """Take a token; False if there is none, nor within ``timeout`` seconds."""
        if self.kind == RECURSIVE and self._is_mine():
            self._depth += 1
            return True
        stream = self._pop(self._idle)
        try:
            stream.settle()
            name = memoryview(self._name().encode())
            reply = stream.ask(Op.ACQUIRE, timeout=timeout if block else 0, buffers=[name])
        except Unreachable:
            self._idle.append(stream)
            raise
        except BaseException:
            stream.give_up(Op.ACQUIRE)
            self._idle.append(stream)
            raise
        if reply.status is not Status.OK:
            self._idle.append(stream)
            return False
        self._owner = threading.get_ident()
        self._depth = 1 if self.kind == RECURSIVE else self._depth + 1
        (is_kept,) = reply.values
        (self._holding if is_kept else self._idle).append(stream)
        return Abandoned(str(reply.parts[0], "utf-8", "replace")) if reply.parts else True

    def release(self) -> None:
        """Give a token back; ValueError if there are as many as there can be.

        AssertionError if it is recursive and this thread has not acquired it.
        """
        if self.kind == RECURSIVE:
            if not self._is_mine():
                raise AssertionError("attempt to release recursive lock not owned by thread")
            if self._depth > 1:
                self._depth -= 1
                return
        self._check()
        if not self._holding:
            with self.stream() as stream:
                self._give(stream)
            return
        stream = self._holding.pop()
        try:
            self._give(stream)
        finally:
            self._idle.append(stream)

    def _is_mine(self) -> bool:
        """Tell whether this thread was the last of this process to acquire it, and holds it."""
        return self._depth > 0 and self._owner == threading.get_ident()

    def _count(self) -> int:
        """Return how often this process has acquired it and not released it."""
        return self._depth

    def _get_value(self) -> int:
        """Return how often it can be acquired now."""
        with self.stream() as stream:
            value: int = stream.ask(Op.TOKENS).values[0]
        return value

    def _is_zero(self) -> bool:
        """Tell whether it cannot be acquired now."""
        return not self._get_value()

    def close(self) -> None:
        """Let go of it, and of what this process has of it."""
        super().close()
        self._holding.clear()

    def _give(self, stream: HubStream) -> None:
        self._depth -= 1  # before another thread can have it
        if stream.ask(Op.POST).status is Status.NO:
            self._depth += 1
            raise ValueError("semaphore or lock released too many times")

    def _forked(self) -> None:
        super()._forked()
        self._holding.clear()
        self._owner, self._depth = None, 0

    def _name(self) -> str:
        return f"{current_process().name} (pid {os.getpid()} on {client.host()})"


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
