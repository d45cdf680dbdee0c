"""Waits for an event that happens once, safe with signal handlers and finalizers.

``threading.Event`` has one lock, which waiters and setters share.  Suppose that a signal handler
runs while its thread holds this lock.  If the handler raises, the lock may stay locked for ever.
If the handler waits or sets, it waits for the thread that it interrupted: a deadlock.  Here each
waiter has a separate lock, for which no other thread waits.  A finalizer on the loop thread may set
the event; if it waits, it gets an error.

CPython notes a signal, and runs the handler between two instructions.  A signal may arrive after
the last instruction and before the kernel puts the thread to sleep on a lock.  Then the handler
runs only after the sleep: Ctrl-C seems to have no effect.  On a busy machine that is likely, since
threads are often suspended at this point.  So no wait lasts longer than ``DOZE`` at a time.
"""

from __future__ import annotations

import contextlib
import threading
import time

from fiber._transport import loop
from fiber._transport.loop import DOZE


class Waiters:
    """Waiters, each with a separate lock."""

    __slots__ = ("_locks",)

    def __init__(self) -> None:
        self._locks: list[threading.Lock] = []

    def join(self) -> threading.Lock:
        """Return a lock that ``wake`` will release.  Check the condition again after this."""
        lock = threading.Lock()
        lock.acquire()
        self._locks.append(lock)
        return lock

    def leave(self, lock: threading.Lock) -> None:
        """Stop waiting with ``lock``."""
        with contextlib.suppress(ValueError):  # ``wake`` releases it at this moment
            self._locks.remove(lock)

    def wake(self) -> None:
        """Wake all waiters.  Runs on any thread."""
        locks = self._locks
        while locks:
            try:
                lock = locks.pop()
            except IndexError:  # another thread wakes the waiters, too
                return
            lock.release()


class Latch:
    """Event that happens once."""

    __slots__ = ("_set", "_waiters")

    def __init__(self) -> None:
        self._set = False
        self._waiters = Waiters()

    def is_set(self) -> bool:
        """Tell whether the event has happened."""
        return self._set

    def set(self) -> None:
        """Set the event.  On any thread, also in a finalizer or a signal handler."""
        self._set = True  # first: a waiter that joins later sees it
        self._waiters.wake()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for the event; return False if ``timeout`` seconds are over first."""
        if self.is_set():
            return True
        lock = self._waiters.join()
        if not self.is_set() and not acquire(lock, timeout):
            self._waiters.leave(lock)
        return self.is_set()


def check_may_wait() -> None:
    """Raise RuntimeError on a loop thread, which would wait for itself."""
    if loop.runs_here():
        raise RuntimeError(
            "a finalizer cannot wait for a result here: the garbage collector runs it on Fiber's "
            "own thread, which receives the results. Use apply_async(), or wait in another thread"
        )


def acquire(lock: threading.Lock, timeout: float | None) -> bool:
    """Wait until ``lock`` is released; return False if ``timeout`` seconds are over first."""
    if timeout is None or timeout > 0:
        check_may_wait()
    longest = threading.TIMEOUT_MAX
    deadline = time.monotonic() + (longest if timeout is None else min(timeout, longest))
    while not lock.acquire(True, max(0.0, min(DOZE, deadline - time.monotonic()))):
        if time.monotonic() >= deadline:
            return False
    return True
