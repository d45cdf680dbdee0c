"""Wait lists of conditions, for processes of any host."""

from __future__ import annotations

import copyreg
from contextlib import suppress
from typing import Any, TypeAlias

from fiber._hub import heap
from fiber._hub.client import HubStream, Unreachable
from fiber._hub.handles import (
    BlockHandle,
    HubHandle,
    handle_for_block,
    handle_for_remote_block,
    ring,
)
from fiber._hub.protocol import ONE, SECRET, TWO, Extent, ObjectKind, Op, Status
from fiber._hub.remote import RemoteCounter, RemoteObject
from fiber._sync.wait_list import SIZE, WaitList


class RemoteWaitList(RemoteObject):
    """Wait list of another host.  A place is a stream, so it ends with this process."""

    def __init__(self, handle: HubHandle, extent: Extent) -> None:
        self.extent = extent
        super().__init__(*handle)

    def enter(self) -> HubStream:
        """A place for this thread."""
        stream = self._pop(self._idle)
        try:
            stream.settle()
            stream.ask(Op.ENTER)
        except BaseException:
            with suppress(OSError, Unreachable):
                stream.say(Op.LEAVE)
            self._idle.append(stream)
            raise
        return stream

    def sleep(self, place: HubStream, timeout: float | None) -> None:
        """Wait until that place is notified, for ``timeout`` seconds at most.  Without the lock."""
        place.ask(Op.SLEEP, timeout=timeout)

    def leave(self, place: HubStream) -> bool:
        """Free a place; return whether it was notified."""
        place.settle()
        notified = place.ask(Op.LEAVE).status is Status.OK
        self._idle.append(place)
        return notified

    def dismiss(self, place: HubStream) -> None:
        """Free a place that was taken for longer.  Waits for nothing, and needs no hub."""
        with suppress(OSError, Unreachable):
            place.say(Op.LEAVE)
        place.close()

    def notify(self, n: int) -> None:
        """Wake the ``n`` that have waited for longest; who died meanwhile is passed over."""
        self._ask(Op.NOTIFY, n)

    def waiters(self) -> int:
        """Return the number of waiters."""
        return self._ask(Op.WAITERS, 0)

    def bury(self) -> int:
        """Return how many waiters died since the last call."""
        return self._ask(Op.BURY, 0)

    def hold(self, place: HubStream, number: int) -> None:
        """Note how many things the owner of a place has.  Waits for nothing."""
        place.say(Op.HOLD, number, form=ONE)

    def tally(self, place: HubStream, held: int, total: int) -> None:
        """Note how many things the owner of a place has, and set the user's second word."""
        place.ask(Op.TALLY, held, total, form=TWO)

    def held(self) -> int:
        """Return the number of things that all owners of places have."""
        return self._ask(Op.HELD, 0)

    def reclaim(self, counter: RemoteCounter) -> int:
        """Free the places of dead processes; give ``counter`` what they had and return it."""
        with self.stream() as stream:
            value: int = stream.ask(Op.RECLAIM, counter.known(), form=SECRET).values[0]
        return value

    def get(self, number: int) -> int:
        """Return one of the user's two words."""
        value = self._ask(Op.GET, number)
        return value - (1 << 64) if value >> 63 else value

    def set(self, number: int, value: int) -> None:
        """Set it."""
        with self.stream() as stream:
            stream.ask(Op.SET, number, value & ((1 << 64) - 1), form=TWO)

    def _ask(self, operation: Op, number: int) -> int:
        with self.stream() as stream:
            value: int = stream.ask(operation, number, form=ONE).values[0]
        return value


AnyWaitList: TypeAlias = WaitList | RemoteWaitList


def create() -> WaitList:
    """A new one, with nobody in it."""
    return WaitList(heap.allocate(SIZE), ring)


def _rebuild(handle: BlockHandle) -> AnyWaitList:
    home = handle.elsewhere()
    if home is not None:
        return RemoteWaitList(home, handle.extent)
    return WaitList(handle.block(), ring)


def _reduce(waiters: WaitList) -> tuple[Any, ...]:
    assert isinstance(waiters.block, heap.Block)
    return _rebuild, (handle_for_block(ObjectKind.WAIT_LIST, waiters.block),)


def _reduce_remote(remote: RemoteWaitList) -> tuple[Any, ...]:
    return _rebuild, (handle_for_remote_block(remote, remote.extent),)


copyreg.pickle(WaitList, _reduce)
copyreg.pickle(RemoteWaitList, _reduce_remote)
