"""``Queue``, ``JoinableQueue`` and ``SimpleQueue``: multiprocessing's, over one message channel.

::

    put ── a slot ── pickle ─┬─ room in the channel ─────────► channel ──► get ── the slot is free
                             └─ no room: backlog ─► feeder ──►

There is no lock between processes: an item is one message, which the kernel gives to exactly one
reader.  A process that dies while it waits takes nothing; one that dies later takes its own item.

Differs from multiprocessing in that an item is pickled when it is put, not some time later.
"""

from __future__ import annotations

import threading
import time
import types
import weakref
from collections import deque
from multiprocessing import util
from queue import Empty, Full
from typing import Any

from fiber import reduction
from fiber._hub.handles import SharedChannel, SharedCounter
from fiber._hub.local import LocalChannel, LocalCounter
from fiber._wire import packet
from fiber._wire.packet import Message
from fiber.connection import Connection
from fiber.synchronize import RECHECK

__all__ = ["Empty", "Full", "JoinableQueue", "Queue", "SimpleQueue"]


class Queue:
    """A first-in first-out queue for any number of processes and threads."""

    def __init__(self, maxsize: int = 0, *, ctx: Any = None) -> None:
        self._slots: _Slots | _Tally = _Slots(maxsize) if maxsize > 0 else _Tally()
        self._inbox, self._outbox = LocalChannel.pair()
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
        self._new_backlog()
        util.register_after_fork(self, Queue._new_backlog)

    def _new_backlog(self) -> None:
        # What the parent of a fork has not sent yet, the parent sends.
        self._backlog = _Backlog(self, self._outbox, self._writer)

    def put(self, obj: Any, block: bool = True, timeout: float | None = None) -> None:
        """Put an item; Full if no slot is free, nor within ``timeout`` seconds.

        An item that does not pickle is given to ``_on_queue_feeder_error``.
        """
        if self._closed:
            raise ValueError(f"Queue {self!r} is closed")
        if not self._slots.take(timeout if block else 0):
            raise Full
        try:
            payload, buffers = reduction.encode(obj)
        except Exception as error:
            self._slots.give_back()
            self._on_queue_feeder_error(error, obj)
        except BaseException:
            self._slots.give_back()
            raise
        else:
            self._send(payload, buffers)

    def _send(self, payload: bytes, buffers: list[memoryview]) -> None:
        self._backlog.put(payload, buffers)

    def get(self, block: bool = True, timeout: float | None = None) -> Any:
        """The next item; Empty if there is none, nor within ``timeout`` seconds."""
        if self._closed:
            raise ValueError(f"Queue {self!r} is closed")
        if not block:
            timeout = 0
        message = self._inbox.recv() if timeout is None else self._receive_within(timeout)
        self._slots.free()
        return packet.loads(message)

    def _receive_within(self, timeout: float) -> Message:
        deadline = time.monotonic() + timeout
        while (message := self._inbox.try_recv()) is None:
            left = deadline - time.monotonic()
            if left <= 0 or not self._inbox.poll(left):
                raise Empty
        return message

    def put_nowait(self, obj: Any) -> None:
        """Put an item; Full if no slot is free."""
        self.put(obj, False)

    def get_nowait(self) -> Any:
        """The next item; Empty if there is none."""
        return self.get(False)

    def qsize(self) -> int:
        """How many items were put and not yet gotten."""
        return self._slots.used(self._backlog.waiting)

    def empty(self) -> bool:
        """Whether ``get`` would wait."""
        return not self._inbox.poll(0)

    def full(self) -> bool:
        """Whether ``put`` would wait."""
        return self._slots.full()

    def close(self) -> None:
        """This process puts and gets no more.  What it has put still gets sent."""
        self._closed = True
        self._reader.close()
        self._backlog.close()

    def join_thread(self) -> None:
        """After ``close``: wait until everything that this process put is sent."""
        assert self._closed, f"Queue {self!r} not closed"
        self._backlog.join()

    def cancel_join_thread(self) -> None:
        """Let this process end even if not all that it put is sent."""
        self._backlog.cancel_join()

    @staticmethod
    def _on_queue_feeder_error(e: Exception, obj: Any) -> None:
        """Hook for an item that could not be sent; ``obj`` is None if it was already pickled."""
        import traceback

        traceback.print_exception(e)

    def __class_getitem__(cls, item: Any) -> types.GenericAlias:
        return types.GenericAlias(cls, item)


class JoinableQueue(Queue):
    """A queue that counts items until ``task_done`` was called for each."""

    def __init__(self, maxsize: int = 0, *, ctx: Any = None) -> None:
        super().__init__(maxsize, ctx=ctx)
        self._unfinished: SharedCounter = LocalCounter.create()
        # Counts how often the count of unfinished items came down to zero.
        self._bell: SharedCounter = LocalCounter.create()

    def __getstate__(self) -> tuple[Any, ...]:
        return super().__getstate__(), self._unfinished, self._bell

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        queue, self._unfinished, self._bell = state
        super().__setstate__(queue)

    def _send(self, payload: bytes, buffers: list[memoryview]) -> None:
        self._unfinished.add(1)
        super()._send(payload, buffers)

    def task_done(self) -> None:
        """One item is dealt with; ValueError if all were before."""
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


class SimpleQueue:
    """A queue whose ``put`` waits until the item is in the pipe."""

    def __init__(self, *, ctx: Any = None) -> None:
        inbox, outbox = LocalChannel.pair()
        self._reader = Connection(inbox, writable=False)
        self._writer = Connection(outbox, readable=False)

    def put(self, obj: Any) -> None:
        """Put an item."""
        self._writer.send(obj)

    def get(self) -> Any:
        """The next item."""
        return self._reader.recv()

    def empty(self) -> bool:
        """Whether ``get`` would wait."""
        return not self._reader.poll()

    def close(self) -> None:
        """This process puts and gets no more."""
        self._reader.close()
        self._writer.close()

    def __getstate__(self) -> tuple[Connection, Connection]:
        return self._reader, self._writer

    def __setstate__(self, state: tuple[Connection, Connection]) -> None:
        self._reader, self._writer = state

    def __class_getitem__(cls, item: Any) -> types.GenericAlias:
        return types.GenericAlias(cls, item)


class _Slots:
    """The places of a queue with a maximum size: a count of those that are free."""

    def __init__(self, maximum: int) -> None:
        self._maximum = maximum
        self._free: SharedCounter = LocalCounter.create(maximum)

    def take(self, timeout: float | None) -> bool:
        """Take a place for an item; False if none gets free in time."""
        return self._free.take(timeout)

    def give_back(self) -> None:
        """The item is not sent after all."""
        self._free.add(1)

    def sending(self) -> None:
        """The item leaves this process."""

    def not_sent(self) -> None:
        """It did not, but will."""

    def free(self) -> None:
        """An item was received."""
        self._free.add(1)

    def used(self, waiting: int) -> int:
        """How many items there are; so many of them wait in this process."""
        return self._maximum - self._free.value()

    def full(self) -> bool:
        """Whether there is no place."""
        return not self._free.wait(0)


class _Tally:
    """The places of a queue without a maximum: only items that have left their process count.

    Its operations while a feeder runs are none: a system call lets go of the interpreter, and two
    threads that take it from each other at every item are several times slower than one.
    """

    def __init__(self) -> None:
        self._sent: SharedCounter = LocalCounter.create()

    def take(self, timeout: float | None) -> bool:
        """There is always a place."""
        return True

    def give_back(self) -> None:
        """The item is not sent after all."""

    def sending(self) -> None:
        """The item leaves this process.  Before it does: its receiver takes off the count."""
        self._sent.add(1)

    def not_sent(self) -> None:
        """It did not, but will."""
        self._sent.take(0)

    def free(self) -> None:
        """An item was received."""
        self._sent.take(0)

    def used(self, waiting: int) -> int:
        """How many items there are; so many of them wait in this process."""
        return self._sent.value() + waiting

    def full(self) -> bool:
        """Never."""
        return False


class _Backlog:
    """What did not fit into the channel when it was put, and the thread that sends it on.

    It does not hold the queue, so that the queue's end can end the thread, nor the end that reads:
    once nobody can ever read, nothing has to be waited for.
    """

    def __init__(self, queue: Queue, outbox: SharedChannel, writer: Connection) -> None:
        self._queue = weakref.ref(queue)
        self._outbox = outbox
        self._writer = writer
        self._slots = queue._slots
        self._on_error = queue._on_queue_feeder_error
        self._items: deque[tuple[bytes, list[memoryview]]] = deque()
        self._changed = threading.Condition(threading.Lock())
        self._thread: threading.Thread | None = None
        self._idle = True
        self._closing = False
        self._join: util.Finalize | None = None
        self._join_cancelled = False

    def put(self, payload: bytes, buffers: list[memoryview]) -> None:
        """Send a message now if it is its turn and there is room, otherwise later."""
        with self._changed:
            if self._idle and self._send_now(payload, buffers):
                return
            # The arrays behind the buffers are their owner's to change once ``put`` has returned.
            self._items.append((payload, [memoryview(bytearray(view)) for view in buffers]))
            if self._idle:
                self._idle = False
                self._wake_feeder()

    @property
    def waiting(self) -> int:
        """How many messages wait."""
        return len(self._items)

    def _send_now(self, payload: bytes, buffers: list[memoryview]) -> bool:
        self._slots.sending()
        try:
            if self._outbox.try_send(payload, buffers):
                return True
        except OSError:
            self._slots.not_sent()
            self._slots.give_back()
            raise
        self._slots.not_sent()
        return False

    def close(self) -> None:
        """Take no more; let go of the channel once everything is sent."""
        with self._changed:
            self._closing = True
            if self._thread is None:
                self._writer.close()
            self._changed.notify()

    def join(self) -> None:
        """Wait until everything is sent."""
        if self._join is not None:
            self._join()

    def cancel_join(self) -> None:
        """Do not wait for it when the process ends."""
        self._join_cancelled = True
        if self._join is not None:
            self._join.cancel()

    def _wake_feeder(self) -> None:
        if self._thread is not None:
            self._changed.notify()
            return
        self._thread = threading.Thread(target=self._feed, name="QueueFeederThread", daemon=True)
        self._thread.start()
        util.Finalize(self._queue(), self.close, exitpriority=10)
        if not self._join_cancelled:
            thread = weakref.ref(self._thread)
            self._join = util.Finalize(self._thread, _join, [thread], exitpriority=-5)

    def _feed(self) -> None:
        while self._has_items():
            try:
                while self._items:
                    item = self._items.popleft()
                    self._slots.sending()
                    self._outbox.post(*item)
            except BrokenPipeError:
                self._items.clear()
            except OSError as error:
                self._failed(error)
        self._writer.close()

    def _has_items(self) -> bool:
        """Wait for items; False once there will be none."""
        with self._changed:
            while not self._items:
                if self._closing:
                    return False
                # From here on ``put`` may send by itself again: nothing is left to overtake.
                self._idle = True
                self._changed.wait()
            return True

    def _failed(self, error: OSError) -> None:
        self._slots.not_sent()
        self._slots.give_back()
        if util.is_exiting():
            util.info("error in queue thread: %s", error)
        else:
            self._on_error(error, None)


def _join(thread: weakref.ref[threading.Thread]) -> None:
    running = thread()
    if running is not None:
        running.join()
