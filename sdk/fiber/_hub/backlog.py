"""How items get from a queue's ``put`` into its channel, and how many there are."""

from __future__ import annotations

import threading
import weakref
from collections import deque
from collections.abc import Callable
from multiprocessing import util
from typing import Any

from fiber._hub.handles import SharedChannel, SharedCounter
from fiber._hub.local import LocalCounter


class Slots:
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


class Tally:
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


class Backlog:
    """What did not fit into the channel when it was put, and the thread that sends it on.

    It ends with its ``owner``, a queue, which it does not hold; nor does it hold the end that
    reads: once nobody can ever read, nothing has to be waited for.
    """

    def __init__(
        self,
        owner: Any,
        outbox: SharedChannel,
        slots: Slots | Tally,
        *,
        on_error: Callable[[Exception, Any], None],
        close: Callable[[], None],
    ) -> None:
        self._owner = weakref.ref(owner)
        self._outbox = outbox
        self._slots = slots
        self._on_error = on_error
        self._close_outbox = close
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
            if self._idle and self._outbox.prompt and self._send_now(payload, buffers):
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
                self._close_outbox()
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
        util.Finalize(self._owner(), self.close, exitpriority=10)
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
            except (BrokenPipeError, EOFError):
                self._items.clear()  # nobody can ever read them
            except OSError as error:
                self._failed(error)
        self._close_outbox()

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
