"""Waiting for something that happens once, with signals and finalizers about.

``threading.Event`` has a lock that all who wait and whoever sets it share.  A signal handler that
raises while one is between taking and releasing it leaves it in a state that nobody can wait at any
more, and one that itself waits or sets finds it taken, by its own thread.  Here each who waits has
a lock of its own, which nobody else waits for.  A finalizer on the loop's thread may set it, and is
refused if it waits.

CPython notes a signal and runs its handler between two instructions.  One that strikes after the
last of them and before the kernel has put the thread to sleep on a lock is noted, and then slept
over: Ctrl-C seems to do nothing.  A busy machine makes that likely, since a thread that lets go of
the interpreter is interrupted just there.  So nobody sleeps for longer than ``DOZE``.
"""

from __future__ import annotations

import contextlib
import threading
import time

from fiber._transport import loop
from fiber._transport.loop import DOZE


class Waiters:
    """Waiters, each with its own lock."""

    __slots__ = ("_locks",)

    def __init__(self) -> None:
        self._locks: list[threading.Lock] = []

    def join(self) -> threading.Lock:
        """A lock that ``wake`` will release.  Look after this whether there is still a need."""
        lock = threading.Lock()
        lock.acquire()
        self._locks.append(lock)
        return lock

    def leave(self, lock: threading.Lock) -> None:
        """Stop waiting with ``lock``."""
        with contextlib.suppress(ValueError):  # it is being released this very moment
            self._locks.remove(lock)

    def wake(self) -> None:
        """Let all go on; on any thread."""
        locks = self._locks
        while locks:
            try:
                lock = locks.pop()
            except IndexError:  # another thread wakes them as well
                return
            lock.release()


class Latch:
    """Something that happens once."""

    __slots__ = ("_set", "_waiters")

    def __init__(self) -> None:
        self._set = False
        self._waiters = Waiters()

    def is_set(self) -> bool:
        """Tell whether the event has happened."""
        return self._set

    def set(self) -> None:
        """Set the event.  On any thread, also in a finalizer or a signal handler."""
        self._set = True  # noted first: who joins later sees it
        self._waiters.wake()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for it; False if ``timeout`` seconds are over first."""
        if self.is_set():
            return True
        lock = self._waiters.join()
        if not self.is_set() and not acquire(lock, timeout):
            self._waiters.leave(lock)
        return self.is_set()


def check_may_wait() -> None:
    """Raise RuntimeError on a loop's thread: what it waited for would come through that thread."""
    if loop.runs_here():
        raise RuntimeError(
            "a finalizer that the garbage collector runs in Fiber's own thread cannot wait for "
            "what comes through that thread: use apply_async(), or wait in a thread of its own"
        )


def acquire(lock: threading.Lock, timeout: float | None) -> bool:
    """Wait until ``lock`` is released; False if ``timeout`` seconds are over first."""
    if timeout is None or timeout > 0:
        check_may_wait()
    longest = threading.TIMEOUT_MAX
    deadline = time.monotonic() + (longest if timeout is None else min(timeout, longest))
    while not lock.acquire(True, max(0.0, min(DOZE, deadline - time.monotonic()))):
        if time.monotonic() >= deadline:
            return False
    return True
