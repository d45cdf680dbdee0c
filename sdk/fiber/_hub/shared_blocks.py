"""Objects that are blocks of shared memory, and their way into processes of any host.

* A ``SharedBuffer`` is memory for a user's object.  On the host where it was made, every process
  has the memory itself.  Another host has a replica, which its hub keeps in step
  (``fiber._hub.replicas``).
* A semaphore of another host is a ``RemoteSemaphore``.  The hub there holds tokens for this
  process, and a stream keeps each token.  The hub gives the token back when the stream ends.
  When this process dies, the kernel closes its socket, and this host's hub ends the stream.
* A wait list of another host is a ``RemoteWaitList``.  A stream keeps each place in it.
"""

from __future__ import annotations

import copyreg
import os
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import current_process
from typing import Any, TypeAlias

from fiber._hub import client, heap
from fiber._hub.client import HubStream, ObjectUnreachable, Reply
from fiber._hub.handles import (
    BlockHandle,
    HubHandle,
    handle_for_block,
    handle_for_remote_block,
    ring_doorbell,
)
from fiber._hub.heap import Block, block_of
from fiber._hub.protocol import (
    ENDLESS,
    MEETING,
    ONE,
    SECRET,
    TWO,
    Breach,
    Extent,
    ObjectKind,
    Op,
    Origin,
    Status,
    microseconds,
)
from fiber._hub.remote import RemoteCounter, RemoteObject
from fiber._sync.semaphore import RECURSIVE, SEMAPHORE_SIZE, Abandoned, SharedSemaphore
from fiber._sync.wait_list import WAIT_LIST_SIZE, WaitList
from fiber._unconfirmed import flush_all
from fiber._wire.descriptor import own

# Buffers


class SharedBuffer:
    """Bytes of shared memory, zero at first."""

    __slots__ = ("__weakref__", "_block")

    def __init__(self, block: Block) -> None:
        self._block = block

    @property
    def view(self) -> memoryview:
        """View of the bytes.  Keep this object while you use it."""
        return self._block.view

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild_buffer, (handle_for_block(ObjectKind.MEMORY, self._block),)


class ReplicaBuffer(SharedBuffer):
    """Shared memory of another host, with a replica on this host."""

    __slots__ = ("_extent", "_original", "_stream")

    def __init__(self, home: HubHandle, extent: Extent) -> None:
        self._extent = extent
        # Keeps the original block at its home.
        original = self._original = RemoteObject(*home)
        # Keeps the replica at this host's hub as long as this object exists.
        self._stream = HubStream(client.hub_address())
        address, grant, identity = home
        origin = Origin(address.host, identity, extent.size, original.token, grant)
        reply = self._stream.ask(Op.REPLICATE, buffers=[memoryview(origin.encode())])
        (fd,), (offset,) = reply.fds, reply.values
        super().__init__(block_of(own(fd), offset, extent.size))

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild_buffer, (handle_for_remote_block(self._original, self._extent),)


def create_buffer(size: int) -> SharedBuffer:
    """Return a new buffer of ``size`` bytes."""
    return SharedBuffer(heap.allocate(size))


def _rebuild_buffer(handle: BlockHandle) -> SharedBuffer:
    home = handle.remote_handle()
    if home is None:
        return SharedBuffer(handle.block())
    return ReplicaBuffer(home, handle.extent)


# Locks and semaphores


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
        """Take a token; False if there is none within ``timeout`` seconds."""
        if self.kind == RECURSIVE and self._is_mine():
            self._depth += 1
            return True
        stream = self._pop(self._idle)
        try:
            stream.settle()
            name = memoryview(_process_name().encode())
            reply = stream.ask(Op.ACQUIRE, timeout=timeout if block else 0, buffers=[name])
        except ObjectUnreachable:
            self._idle.append(stream)
            raise
        except BaseException:
            stream.give_up()
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
        """Return a token; ValueError if the semaphore is at its maximum.

        AssertionError if it is recursive and this thread has not acquired it.
        """
        if self.kind == RECURSIVE:
            if not self._is_mine():
                raise AssertionError("attempt to release recursive lock not owned by thread")
            if self._depth > 1:
                self._depth -= 1
                return
        self._check()
        try:
            flush_all()
        finally:  # also after an interrupt: the caller does not hold the token any longer
            self._release()

    def _release(self) -> None:
        if not self._holding:
            with self.stream() as stream:
                self._give(stream)
            return
        stream = self._holding.pop()
        try:
            self._give(stream)
        finally:
            self._idle.append(stream)

    def disown(self) -> None:
        """Leave the tokens of this process taken when it ends, for another process to release.

        A process of the semaphore's host that ends does the same.
        """
        while self._holding:
            stream = self._holding.pop()
            with suppress(OSError, ObjectUnreachable):
                stream.say(Op.DISOWN)
            self._idle.append(stream)

    @contextmanager
    def kept_elsewhere(self) -> Iterator[None]:
        """Let this thread acquire it again, as a stream of another object keeps its token."""
        self._owner, self._depth = threading.get_ident(), 1
        try:
            yield
        finally:
            self._owner, self._depth = None, 0

    def _is_mine(self) -> bool:
        """Tell whether this thread holds it, and was the last of this process to acquire it."""
        return self._depth > 0 and self._owner == threading.get_ident()

    def _count(self) -> int:
        """Return how often this process has acquired it and not released it."""
        return self._depth

    def _get_value(self) -> int:
        """Return the number of tokens that are available."""
        with self.stream() as stream:
            value: int = stream.ask(Op.TOKENS).values[0]
        return value

    def _is_zero(self) -> bool:
        """Tell whether it cannot be acquired now."""
        return not self._get_value()

    def close(self) -> None:
        """Drop the semaphore, and the tokens that this process holds."""
        super().close()
        self._holding.clear()

    def _give(self, stream: HubStream) -> None:
        self._depth -= 1  # before another thread can acquire it
        if stream.ask(Op.RETURN_TOKEN).status is Status.NO:
            self._depth += 1
            raise ValueError("semaphore or lock released too many times")

    def _forked(self) -> None:
        super()._forked()
        self._holding.clear()
        self._owner, self._depth = None, 0


def _process_name() -> str:
    return f"{current_process().name} (pid {os.getpid()} on {client.host()})"


AnySemaphore: TypeAlias = SharedSemaphore | RemoteSemaphore

# A process has one object for each semaphore, so that a recursive one knows its holder, however
# often it was unpickled.  The key is the identity of its block, or the identity from its hub.
_semaphores: weakref.WeakValueDictionary[tuple[object, ...], AnySemaphore] = (
    weakref.WeakValueDictionary()
)


def create_semaphore(
    kind: int, value: int, maximum: int, *, silent: bool = False
) -> SharedSemaphore:
    """Return a new semaphore with ``value`` of at most ``maximum`` tokens.

    With ``silent`` nobody is told when a process ends with a token: what the token guards is never
    half changed.
    """
    block = heap.allocate(SEMAPHORE_SIZE)
    new = _semaphores[block.identity] = SharedSemaphore.create(
        block, kind, value, maximum, ring_doorbell, silent=silent
    )
    return new


def _rebuild_semaphore(handle: BlockHandle, kind: int, maximum: int) -> AnySemaphore:
    home = handle.remote_handle()
    if home is not None:
        remote = RemoteSemaphore(home, handle.extent, kind, maximum)
        return _semaphores.setdefault((home.identity,), remote)
    block = handle.block()
    known = _semaphores.get(block.identity)
    if known is None:
        known = _semaphores.setdefault(block.identity, SharedSemaphore(block, kind, ring_doorbell))
    return known


def _reduce_semaphore(semaphore: SharedSemaphore) -> tuple[Any, ...]:
    assert isinstance(semaphore.block, heap.Block)
    handle = handle_for_block(ObjectKind.SEMAPHORE, semaphore.block)
    return _rebuild_semaphore, (handle, semaphore.kind, semaphore.maximum)


def _reduce_remote_semaphore(remote: RemoteSemaphore) -> tuple[Any, ...]:
    handle = handle_for_remote_block(remote, remote.extent)
    return _rebuild_semaphore, (handle, remote.kind, remote.maximum)


copyreg.pickle(SharedSemaphore, _reduce_semaphore)
copyreg.pickle(RemoteSemaphore, _reduce_remote_semaphore)


# Wait lists of conditions


class RemoteWaitList(RemoteObject):
    """Wait list of another host.  A stream keeps each place, which ends with this process."""

    def __init__(self, handle: HubHandle, extent: Extent) -> None:
        self.extent = extent
        super().__init__(*handle)

    def enter(self) -> HubStream:
        """Take a place for this thread."""
        stream = self._pop(self._idle)
        try:
            stream.settle()
            stream.ask(Op.ENTER)
        except BaseException:
            with suppress(OSError, ObjectUnreachable):
                stream.say(Op.LEAVE)
            self._idle.append(stream)
            raise
        return stream

    def sleep(self, place: HubStream, timeout: float | None) -> None:
        """Wait without the lock until ``place`` is notified, at most ``timeout`` seconds."""
        place.ask(Op.SLEEP, timeout=timeout)

    def leave(self, place: HubStream) -> bool:
        """Free a place; return whether it was notified."""
        place.settle()
        notified = place.ask(Op.LEAVE).status is Status.OK
        self._idle.append(place)
        return notified

    def dismiss(self, place: HubStream) -> None:
        """Free a place that was kept over several waits.  Never waits; the hub may have ended."""
        with suppress(OSError, ObjectUnreachable):
            place.say(Op.LEAVE)
        place.close()

    def notify(self, n: int) -> None:
        """Wake the ``n`` threads that have waited longest.  Skip dead ones."""
        self._ask(Op.NOTIFY, n)

    def waiters(self) -> int:
        """Return the number of waiters."""
        return self._ask(Op.WAITERS, 0)

    def remove_dead(self) -> int:
        """Free the places of dead waiters; return their number."""
        return self._ask(Op.REMOVE_DEAD, 0)

    def hold(self, place: HubStream, number: int) -> None:
        """Note how many things the process at ``place`` has.  Never waits."""
        place.say(Op.HOLD, number, form=ONE)

    def held(self) -> int:
        """Return the number of things that the processes of all places have."""
        return self._ask(Op.HELD, 0)

    def reclaim(self, counter: RemoteCounter) -> int:
        """Free the places of dead processes, add their things to ``counter``, and count these."""
        with self.stream() as stream:
            value: int = stream.ask(Op.RECLAIM, counter.known(), form=SECRET).values[0]
        return value

    def get(self, number: int) -> int:
        """Return one of the user's two words."""
        value = self._ask(Op.GET, number)
        return value - (1 << 64) if value >> 63 else value

    def set(self, number: int, value: int) -> None:
        """Set one of the user's two words."""
        with self.stream() as stream:
            stream.ask(Op.SET, number, value & ((1 << 64) - 1), form=TWO)

    def meet(
        self,
        condition: RemoteWaitList,
        lock: RemoteSemaphore,
        parties: int,
        action: Callable[[], object] | None,
        timeout: float | None,
    ) -> int | Breach:
        """Wait at the barrier of which this wait list has the members; return the index.

        The hub takes all steps, and this process calls the action.
        """
        known = condition.known(), lock.known()
        acts, within = action is not None, microseconds(timeout)
        name = [memoryview(_process_name().encode())] if acts else []
        with self._interruptible() as stream:
            numbers = min(parties, ENDLESS), acts, within
            reply = stream.ask(Op.MEET, *known, *numbers, form=MEETING, buffers=name)
            if reply.status is Status.ACT:
                assert action is not None
                with lock.kept_elsewhere():
                    action()
                reply = stream.ask(Op.ACTED)
        return _index_or_breach(reply)

    @contextmanager
    def _interruptible(self) -> Iterator[HubStream]:
        """Yield a stream; after an error the hub undoes what the last request began."""
        with self.stream() as stream:
            try:
                yield stream
            except ObjectUnreachable:
                raise
            except BaseException:
                with suppress(OSError, ObjectUnreachable):
                    stream.give_up()
                    stream.settle()
                raise

    def dismiss_all(self) -> None:
        """Free the places of all streams, as this process ends in good order.  Never waits."""
        for stream in tuple(self._streams):
            with suppress(OSError, ObjectUnreachable):
                stream.say(Op.LEAVE)

    def _ask(self, operation: Op, number: int) -> int:
        with self.stream() as stream:
            value: int = stream.ask(operation, number, form=ONE).values[0]
        return value


def _index_or_breach(reply: Reply) -> int | Breach:
    if reply.status is Status.NO:
        raise OSError("more than a thousand threads wait at one barrier")
    (value,) = reply.values
    return value if reply.status is Status.OK else Breach(value)


AnyWaitList: TypeAlias = WaitList | RemoteWaitList


def create_wait_list() -> WaitList:
    """Return a new, empty wait list."""
    return WaitList(heap.allocate(WAIT_LIST_SIZE), ring_doorbell)


def _rebuild_wait_list(handle: BlockHandle) -> AnyWaitList:
    home = handle.remote_handle()
    if home is not None:
        return RemoteWaitList(home, handle.extent)
    return WaitList(handle.block(), ring_doorbell)


def _reduce_wait_list(waiters: WaitList) -> tuple[Any, ...]:
    assert isinstance(waiters.block, heap.Block)
    return _rebuild_wait_list, (handle_for_block(ObjectKind.WAIT_LIST, waiters.block),)


def _reduce_remote_wait_list(remote: RemoteWaitList) -> tuple[Any, ...]:
    return _rebuild_wait_list, (handle_for_remote_block(remote, remote.extent),)


copyreg.pickle(WaitList, _reduce_wait_list)
copyreg.pickle(RemoteWaitList, _reduce_remote_wait_list)
