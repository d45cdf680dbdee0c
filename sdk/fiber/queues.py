"""``Queue``, ``JoinableQueue`` and ``SimpleQueue``: multiprocessing's, over one message channel.

::

    put ── pickle ── a slot ─┬─ room in the channel ─────────► channel ──► get ── the slot is free
                             └─ no room: feeder ────────────►

Processes share no lock.  An item is one message, which the kernel gives to exactly one reader.  If
a process dies while it waits, no item is lost.  If it dies later, the item that it has taken is.

Ctrl-C in ``put`` or ``get`` never costs a slot, so others can always put.  While either waits, it
costs no item.  If it strikes just as the item moves, an interrupted ``get`` may lose its item, and
an interrupted ``put`` may have put it.

Differs from multiprocessing: ``put`` pickles the item at once, and not some time later.
"""

from __future__ import annotations

import operator
import threading
import time
import types
from collections.abc import Callable
from multiprocessing import util
from queue import Empty, Full
from typing import Any, Generic, TypeVar

from fiber import reduction
from fiber._hub import one_way
from fiber._hub.local import LocalChannel, LocalCounter
from fiber._hub.protocol import RECHECK
from fiber._hub.queue_delivery import Dealer, Feeder, ItemCount, QueueSlots, become_reader
from fiber._transport.channels import SharedCounter
from fiber._wire import packet
from fiber._wire.packet import Message
from fiber.connection import Connection
from fiber.connection import Pipe as Pipe  # noqa: PLC0414  # exported: the original has it here

__all__ = ["Empty", "Full", "JoinableQueue", "Queue", "SimpleQueue", "SimpleQueuePush"]

_T = TypeVar("_T")


class Queue(Generic[_T]):
    """A first-in first-out queue for any number of processes and threads."""

    def __init__(self, maxsize: int = 0, *, ctx: Any = None) -> None:
        self._slots: QueueSlots | ItemCount = (
            ItemCount() if maxsize <= 0 else QueueSlots(operator.index(maxsize))
        )
        self._inbox, self._outbox = one_way.pair()
        self._open()

    def __getstate__(self) -> tuple[Any, ...]:
        if self._closed:
            raise ValueError(f"Queue {self!r} is closed")
        return self._slots, self._inbox, self._outbox

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self._slots, self._inbox, self._outbox = state
        self._open()

    def _open(self) -> None:
        self._reader = Connection(self._inbox, writable=False)
        self._writer = Connection(self._outbox, readable=False)
        self._closed = False
        self._new_feeder()
        util.register_after_fork(self, Queue._new_feeder)

    def _new_feeder(self) -> None:
        # After a fork, the parent sends the items that it has put.
        self._feeder = Feeder(
            self,
            self._outbox,
            self._slots,
            on_error=self._on_queue_feeder_error,
            close=self._writer.close,
        )

    def put(self, obj: _T, block: bool = True, timeout: float | None = None) -> None:
        """Put an item; Full if no slot becomes free within ``timeout`` seconds.

        An item that does not pickle is passed to ``_on_queue_feeder_error``.
        """
        if self._closed:
            raise ValueError(f"Queue {self!r} is closed")
        if not block and self._slots.full():
            raise Full
        # Pickle before taking a slot: a process that dies meanwhile keeps no slot.
        message = _encode(obj)
        if isinstance(message, Exception):
            self._on_queue_feeder_error(message, obj)
            return
        payload, buffers, revoke = message
        taken: list[Any] = []
        try:
            if not self._slots.take(timeout if block else 0, taken):
                raise Full
            self._send(payload, buffers)
        except BaseException:
            if taken:  # the item may be put all the same: a surplus slot is removed later
                self._slots.give_back()
            else:
                revoke()
            raise

    def _send(self, payload: bytes, buffers: list[memoryview]) -> None:
        self._feeder.put(payload, buffers)

    def get(self, block: bool = True, timeout: float | None = None) -> _T:
        """Return the next item; Empty if none comes within ``timeout`` seconds."""
        if self._closed:
            raise ValueError(f"Queue {self!r} is closed")
        if not block:
            timeout = 0
        item: _T = packet.loads(self._receive_within(timeout))
        return item

    def _receive_within(self, timeout: float | None) -> Message:
        deadline = 0.0 if timeout is None else time.monotonic() + timeout
        while (message := self._slots.receive(self._inbox, wait=timeout is None)) is None:
            left = deadline - time.monotonic()
            if left <= 0 or not self._inbox.poll(left):
                raise Empty
        return message

    def put_nowait(self, obj: _T) -> None:
        """Put an item; Full if no slot is free."""
        self.put(obj, False)

    def get_nowait(self) -> _T:
        """Return the next item; Empty if there is none."""
        return self.get(False)

    def qsize(self) -> int:
        """Return the number of items that were put and not yet gotten.

        In a queue without a maximum, items that wait in another process for room do not count.
        """
        return self._feeder.size()

    def empty(self) -> bool:
        """Tell whether ``get`` would wait."""
        return not self._inbox.poll(0)

    def full(self) -> bool:
        """Tell whether ``put`` would wait."""
        return self._slots.full()

    def close(self) -> None:
        """Close the queue for this process.  Items that it has put are still sent."""
        self._closed = True
        self._reader.close()
        self._feeder.close()

    def join_thread(self) -> None:
        """Wait until all items that this process put are sent.  Call ``close`` first."""
        assert self._closed, f"Queue {self!r} not closed"
        self._feeder.join()

    def cancel_join_thread(self) -> None:
        """Let this process end even if some of its items are not sent."""
        self._feeder.cancel_join()

    @staticmethod
    def _on_queue_feeder_error(e: Exception, obj: Any) -> None:
        """Hook for an item that could not be sent; ``obj`` is None if it was already pickled."""
        import traceback

        traceback.print_exception(e)

    def __class_getitem__(cls, item: Any) -> types.GenericAlias:
        return types.GenericAlias(cls, item)


def _encode(obj: Any) -> tuple[bytes, list[memoryview], Callable[[], None]] | Exception:
    """Pickle an item; return it with a function that revokes its grants, or return the error."""
    try:
        return reduction.encode_revocable(obj)
    except Exception as error:
        return reduction.blame({"the item": obj}, error)


class JoinableQueue(Queue[_T]):
    """A queue that counts items until ``task_done`` was called for each."""

    def __init__(self, maxsize: int = 0, *, ctx: Any = None) -> None:
        super().__init__(maxsize, ctx=ctx)
        self._unfinished: SharedCounter = LocalCounter.create()
        # Number of times that the count of unfinished items has become zero.
        self._bell: SharedCounter = LocalCounter.create()

    def __getstate__(self) -> tuple[Any, ...]:
        return super().__getstate__(), self._unfinished, self._bell

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        queue, self._unfinished, self._bell = state
        super().__setstate__(queue)

    def _send(self, payload: bytes, buffers: list[memoryview]) -> None:
        try:
            self._unfinished.add(1)
            super()._send(payload, buffers)
        except BaseException:  # ``join`` would wait for ever for an item that was not put
            self._unfinished.take(0)
            raise

    def task_done(self) -> None:
        """Note that an item is done; ValueError if all were done before."""
        if not self._unfinished.take(0):
            raise ValueError("task_done() called too many times")
        if not self._unfinished.wait(0):
            self._bell.add(1)

    def join(self) -> None:
        """Wait until no item is unfinished."""
        while True:
            rung = self._bell.value()
            if not self._unfinished.wait(0):
                return
            self._bell.changed(rung, RECHECK)


class SimpleQueue(Generic[_T]):
    """A queue without a thread that sends: ``put`` sends the item itself, and waits for room.

    On another host it waits for room once 64 KiB are on the way.
    """

    def __init__(self, *, ctx: Any = None) -> None:
        inbox, outbox = one_way.pair()
        self._reader = Connection(inbox, writable=False)
        self._writer = Connection(outbox, readable=False)

    def put(self, obj: _T) -> None:
        """Put an item."""
        self._writer.send(obj)

    def get(self) -> _T:
        """Return the next item; wait until there is one."""
        item: _T = self._reader.recv()
        return item

    def empty(self) -> bool:
        """Tell whether ``get`` would wait."""
        return not self._poll()

    def _poll(self, timeout: float | None = 0.0) -> bool:
        """Wait up to ``timeout`` seconds for an item.  Some libraries call this method."""
        return self._reader.poll(timeout)

    def close(self) -> None:
        """Close the queue for this process."""
        self._reader.close()
        self._writer.close()

    def __getstate__(self) -> tuple[Connection, Connection]:
        return self._reader, self._writer

    def __setstate__(self, state: tuple[Connection, Connection]) -> None:
        self._reader, self._writer = state

    def __class_getitem__(cls, item: Any) -> types.GenericAlias:
        return types.GenericAlias(cls, item)


class SimpleQueuePush(Generic[_T]):
    """A queue that sends its items to the readers in turn, before they ask for them.

    A process is a reader from its first ``get`` on, until it closes the queue or ends.  If a reader
    has no room, the item goes to the next one.  Use it for items that take equally long.  Items
    that were sent to a reader are lost when it ends.  If that matters, or if items differ, use
    ``SimpleQueue``: there each reader takes an item when it is ready for it.

    A thread of the process that makes the queue sends the items.
    """

    _writer: Connection
    _reader: Connection | None

    def __init__(self, *, ctx: Any = None) -> None:
        inbox, outbox = one_way.pair()
        arrivals, registration = LocalChannel.pair()
        Dealer(inbox, arrivals).start()
        self.__setstate__((Connection(outbox, readable=False), registration))

    def put(self, obj: _T) -> None:
        """Put an item; wait while no reader has room."""
        self._writer.send(obj)

    def get(self) -> _T:
        """Return the next item that was sent to this process."""
        item: _T = self._joined().recv()
        return item

    def empty(self) -> bool:
        """Tell whether ``get`` would wait."""
        return not self._joined().poll()

    def close(self) -> None:
        """Close the queue for this process."""
        self._writer.close()
        self._registration.close()
        if self._reader is not None:
            self._reader.close()

    def _joined(self) -> Connection:
        with self._joining:  # two threads would make two readers, one of which never reads
            if self._reader is None:
                self._reader = Connection(become_reader(self._registration), writable=False)
        return self._reader

    def __getstate__(self) -> tuple[Any, ...]:
        return self._writer, self._registration

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self._writer, self._registration = state
        self._reader = None
        self._joining = threading.Lock()
        util.register_after_fork(self, SimpleQueuePush._after_fork)

    def _after_fork(self) -> None:
        self._reader = None  # it is the parent's
        self._joining = threading.Lock()
