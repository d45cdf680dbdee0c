"""``Event``, ``Semaphore`` and ``BoundedSemaphore``: multiprocessing's, over counting events.

A process that dies while it waits leaves nothing behind.  One that dies while it holds a semaphore
does: what it acquired stays acquired, as in multiprocessing.
"""

from __future__ import annotations

import os
import threading
import time
from typing import TYPE_CHECKING, Any

from fiber._hub.local import LocalCounter
from fiber._hub.unsupported import Unsupported

if TYPE_CHECKING:
    from types import TracebackType

    from fiber._transport.base import SharedCounter

__all__ = [
    "Barrier",
    "BoundedSemaphore",
    "Condition",
    "Event",
    "Lock",
    "RLock",
    "Semaphore",
]

SEM_VALUE_MAX = 2**31 - 1

RECHECK = 1.0
"""Seconds after which whoever waits for a bell looks for itself: its ringer may have died."""


class Condition(Unsupported):
    pass


class Barrier(Unsupported):
    pass


class Semaphore:
    """A count that ``acquire`` lowers, waiting while it is zero, and ``release`` raises."""

    def __init__(self, value: int = 1, *, ctx: Any = None) -> None:
        if not 0 <= value <= SEM_VALUE_MAX:
            raise ValueError(f"a semaphore's value is from 0 to {SEM_VALUE_MAX}, not {value}")
        self._counter: SharedCounter = LocalCounter.create(value)

    def acquire(self, block: bool = True, timeout: float | None = None) -> bool:
        """Lower the count; False if it is zero and stays so for ``timeout`` seconds."""
        taken: list[Any] = []
        try:
            return self._counter.take(timeout if block else 0, taken)
        except BaseException:
            if taken:  # interrupted on the way back
                self._counter.add(1)
            raise

    def release(self) -> None:
        """Raise the count, and wake one who waits."""
        self._counter.add(1)

    def get_value(self) -> int:
        """The count now."""
        return self._counter.value()

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.release()

    def __repr__(self) -> str:
        return f"<{type(self).__name__}(value={self.get_value()})>"


class BoundedSemaphore(Semaphore):
    """A semaphore whose count never rises above where it started."""

    def __init__(self, value: int = 1, *, ctx: Any = None) -> None:
        super().__init__(value, ctx=ctx)
        self._maximum = value

    def release(self) -> None:
        """Raise the count; ValueError if it was not acquired that often."""
        if self._counter.value() >= self._maximum:
            raise ValueError("semaphore or lock released too many times")
        self._counter.add(1)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}(value={self.get_value()}, maxvalue={self._maximum})>"


class Lock(BoundedSemaphore):
    """A mutex that any thread of any process may release."""

    def __init__(self, *, ctx: Any = None) -> None:
        super().__init__(1, ctx=ctx)


class RLock:
    """A mutex that its holder, a thread, may acquire again."""

    def __init__(self, *, ctx: Any = None) -> None:
        self._lock = Lock()
        self._holder: tuple[int, int] | None = None
        self._depth = 0

    def acquire(self, block: bool = True, timeout: float | None = None) -> bool:
        """Take it; False if another thread keeps it for ``timeout`` seconds."""
        me = os.getpid(), threading.get_ident()
        if self._holder != me:
            if not self._lock.acquire(block, timeout):
                return False
            self._holder = me
        self._depth += 1
        return True

    def release(self) -> None:
        """Let go of it once; AssertionError if this thread does not have it."""
        if self._holder != (os.getpid(), threading.get_ident()):
            raise AssertionError("attempt to release recursive lock not owned by thread")
        self._depth -= 1
        if not self._depth:
            self._holder = None
            self._lock.release()

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild_rlock, (self._lock,)

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()


def _rebuild_rlock(lock: Lock) -> RLock:
    rlock = RLock.__new__(RLock)
    rlock._lock, rlock._holder, rlock._depth = lock, None, 0
    return rlock


class Event:
    """A flag to wait for.

    Who waits is woken by ``set`` even if ``clear`` follows at once; ``wait`` says True then, as in
    ``threading``.
    """

    def __init__(self, *, ctx: Any = None) -> None:
        self._flag: SharedCounter = LocalCounter.create()
        # Counts the calls of ``set``: whoever finds it changed was woken, whatever the flag says.
        self._bell: SharedCounter = LocalCounter.create()

    def is_set(self) -> bool:
        """Whether the flag is set."""
        return self._flag.wait(0)

    def set(self) -> None:
        """Set the flag and wake all who wait."""
        if not self._flag.wait(0):
            self._flag.add(1)
        self._bell.add(1)

    def clear(self) -> None:
        """Unset the flag."""
        self._flag.clear()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the flag is set; False when ``timeout`` seconds are over."""
        if self._flag.wait(0):
            return True
        rung = self._bell.value()
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._flag.wait(0):
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0:
                return False
            if self._bell.changed(rung, RECHECK if left is None else min(left, RECHECK)):
                break
        return True

    def __repr__(self) -> str:
        status = "set" if self.is_set() else "unset"
        return f"<{type(self).__qualname__} at {id(self):#x} {status}>"
