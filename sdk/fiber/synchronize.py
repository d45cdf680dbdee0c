"""Locks, semaphores and events: multiprocessing's, released when who holds them dies.

::

    with lock as acquired:
        if isinstance(acquired, Abandoned):
            repair(what_it_guards)  # a process died in the middle of changing it
"""

from __future__ import annotations

import threading
import time
from multiprocessing import current_process
from typing import TYPE_CHECKING, Any

from fiber._hub import shared_semaphores
from fiber._hub.local import LocalCounter
from fiber._hub.unsupported import Unsupported
from fiber._sync.abandonment import Abandoned
from fiber._sync.semaphore import COUNTING, RECURSIVE, SEM_VALUE_MAX

if TYPE_CHECKING:
    from types import TracebackType

    from fiber._sync.semaphore import SharedSemaphore
    from fiber._transport.base import SharedCounter

__all__ = [
    "SEM_VALUE_MAX",
    "Abandoned",
    "Barrier",
    "BoundedSemaphore",
    "Condition",
    "Event",
    "Lock",
    "RLock",
    "Semaphore",
]

RECHECK = 1.0
"""Seconds after which whoever waits for a bell looks for itself: its ringer may have died."""


class Condition(Unsupported):
    pass


class Barrier(Unsupported):
    pass


class SemLock:
    """What all locks and semaphores are: tokens that are acquired and released.

    They pickle at any time and not only while a process is started: through a queue, as a task's
    argument.  What a process has when it dies is released for it, with a RuntimeWarning that names
    it; whoever acquires it then gets an ``Abandoned`` in place of True.
    """

    def __init__(self, kind: int, value: int, maximum: int) -> None:
        self._semlock = shared_semaphores.create(kind, value, maximum)

    def acquire(self, block: bool = True, timeout: float | None = None) -> bool | Abandoned:
        """Take a token; False if there is none, nor within ``timeout`` seconds."""
        return self._semlock.acquire(block, timeout)

    def release(self) -> None:
        """Give a token back; ValueError if there would be more than there can be."""
        self._semlock.release()

    def __enter__(self) -> bool | Abandoned:
        return self._semlock.acquire()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._semlock.release()

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (type(self), self._semlock)

    def _owner(self) -> str:
        semlock = self._semlock
        if semlock._is_mine():
            name = current_process().name
            thread = threading.current_thread().name
            return name if thread == "MainThread" else f"{name}|{thread}"
        if semlock._get_value() == 1:
            return "None"
        return "SomeOtherThread" if semlock._count() > 0 else "SomeOtherProcess"


def _rebuild(cls: type[SemLock], semlock: SharedSemaphore) -> SemLock:
    new = cls.__new__(cls)
    new._semlock = semlock
    return new


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


class Lock(SemLock):
    """A mutex that any thread of any process may release."""

    def __init__(self, *, ctx: Any = None) -> None:
        super().__init__(COUNTING, 1, 1)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}(owner={self._owner()})>"


class RLock(SemLock):
    """A mutex that its thread may acquire again, and that only its thread may release.

    ``release`` raises AssertionError in any other.
    """

    def __init__(self, *, ctx: Any = None) -> None:
        super().__init__(RECURSIVE, 1, 1)

    def __repr__(self) -> str:
        count = self._semlock._count()
        owner = self._owner()
        if owner.startswith("Some"):
            return f"<{type(self).__name__}({owner}, nonzero)>"
        return f"<{type(self).__name__}({owner}, {count})>"


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
