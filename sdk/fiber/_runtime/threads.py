"""Threads of a pool for work that the loop must not do, and waits that signals do not break.

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
import queue
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from fiber._exceptions import report_uncaught
from fiber._transport import loop
from fiber._transport.loop import DOZE


class BackgroundThread:
    """Thread that does one action after the other.  It starts with the first action.

    As ``ThreadPoolExecutor(1)``, with two differences.  The thread is a daemon, so an action that
    hangs does not keep the program from ending.  And ``stop`` does not wait.  The loop thread calls
    ``submit`` and ``stop``, so they need no lock.  Other threads may ``submit`` once the thread has
    started.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._queue: queue.SimpleQueue[tuple[Callable[..., object], tuple[Any, ...]] | None]
        self._queue = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._stopped = False

    def start(self) -> None:
        """Start the thread now, before the first action.

        From Python 3.12 on no thread starts once the program ends.
        """
        thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        thread.start()
        self._thread = thread

    def submit(self, action: Callable[..., object], *args: Any) -> bool:
        """Run ``action`` on the thread, after earlier ones; return False if the thread was stopped.

        RuntimeError if the system has no room for the thread; the next call tries again.
        """
        if self._stopped:
            return False
        if self._thread is None:
            self.start()
        self._queue.put((action, args))
        return True

    def runs_here(self) -> bool:
        """Tell whether the caller runs on this thread, and so must not wait for it."""
        return threading.current_thread() is self._thread

    def stop(self, then: Callable[[], object] | None = None) -> None:
        """End once all submitted actions are done, and call ``then`` at the end."""
        self._stopped = True
        if then is not None and self._thread is None:
            then()
        elif then is not None:
            self._queue.put((then, ()))
        self._queue.put(None)

    def join(self) -> None:
        """Wait until the thread has ended.  Return at once if the caller runs on it."""
        thread = self._thread
        if thread is not None and not self.runs_here():
            thread.join()

    def _run(self) -> None:
        while (entry := self._queue.get()) is not None:
            action, args = entry
            try:
                action(*args)
            except BaseException:
                # Mostly a callback of the user's: its error is reported, and the others still run.
                report_uncaught()
            del entry, action, args


def say(news: str) -> None:
    """Print news for the user.  Runs on a background thread: a terminal may be slow."""
    print(f"fiber: {news}", file=sys.stderr, flush=True)


class UserThreads:
    """Threads of one pool that run the user's code: one thread for each kind of code.

    They are separate because a callback may wait for a result that another thread unpickles.
    """

    def __init__(self, thread: Callable[[str], BackgroundThread]) -> None:
        self.pickling = thread("fiber-pool")
        """Pickles tasks, and starts workers."""
        self.unpickling = thread("fiber-pool-results")
        """Unpickles results that no caller unpickles on its thread."""
        self.callbacks = thread("fiber-pool-callbacks")
        """Runs the callbacks of results."""

    def start(self) -> None:
        """Start all of them now."""
        for thread in (self.pickling, self.unpickling, self.callbacks):
            thread.start()

    def stop(self) -> None:
        """End all of them once all submitted actions are done."""
        self.pickling.stop()
        self.unpickling.stop(then=self.callbacks.stop)  # unpickled results have callbacks

    def join(self) -> None:
        """Wait until all of them have ended."""
        for thread in (self.pickling, self.unpickling, self.callbacks):
            thread.join()

    def check_may_wait(self) -> None:
        """Raise RuntimeError where a result would wait for the calling thread."""
        if self.pickling.runs_here():
            raise RuntimeError(
                "code that pickles a task cannot wait for a result of the same pool, which waits "
                "for the pickle. Get the result before the map, or in the task"
            )
        if self.unpickling.runs_here():
            raise RuntimeError(
                "code that unpickles a result cannot wait for another result of the same executor, "
                "which is unpickled later. Get that result where this one is used"
            )


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
    """Raise RuntimeError where a wait would never end.

    A loop thread would wait for itself.  While the interpreter ends, the loop thread is stopped.
    """
    if sys.is_finalizing():
        raise RuntimeError("the interpreter is ending, and has stopped Fiber's own thread")
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
