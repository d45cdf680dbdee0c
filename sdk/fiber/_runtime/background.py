"""A thread for what the loop must not do: run the user's code, start processes."""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable
from typing import Any

from fiber._exceptions import report_uncaught


class BackgroundThread:
    """Does one thing after the other on a thread of its own, which starts when first needed.

    As ``ThreadPoolExecutor(1)``, with two differences: the thread is a daemon, so that what hangs
    in it cannot keep the program from ending, and ``stop`` does not wait.  ``submit`` and ``stop``
    are for the loop's thread, so nothing here needs a lock.  Other threads may ``submit`` once the
    thread has been started.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._queue: queue.SimpleQueue[tuple[Callable[..., object], tuple[Any, ...]] | None]
        self._queue = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._stopped = False

    def start(self) -> None:
        """Have the thread now, before anything is submitted.

        From Python 3.12 on none starts any more once the program ends.
        """
        thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        thread.start()
        self._thread = thread

    def submit(self, action: Callable[..., object], *args: Any) -> bool:
        """Have it done, after what came before; False: it has been stopped, and drops it.

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
        """End once everything submitted is done, and call ``then`` at the end."""
        self._stopped = True
        if then is not None and self._thread is None:
            then()
        elif then is not None:
            self._queue.put((then, ()))
        self._queue.put(None)

    def join(self) -> None:
        """Wait until it has ended; nothing when called by what it is doing."""
        thread = self._thread
        if thread is not None and not self.runs_here():
            thread.join()

    def _run(self) -> None:
        while (entry := self._queue.get()) is not None:
            action, args = entry
            try:
                action(*args)
            except BaseException:
                # Mostly a callback of the user's: it must be seen, and must not end the others.
                report_uncaught()
            del entry, action, args


def say(news: str) -> None:
    """Print it.  On a background thread: a slow terminal must not hold up the loop."""
    print(f"fiber: {news}", file=sys.stderr, flush=True)


class UserThreads:
    """The threads of one pool that run the user's code, by the kind of that code.

    None of them waits for another one: a callback may wait for a result that is to be unpickled.
    """

    def __init__(self, thread: Callable[[str], BackgroundThread]) -> None:
        self.pickling = thread("fiber-pool")
        """Pickles tasks, and starts workers."""
        self.unpickling = thread("fiber-pool-results")
        """Unpickles results that are not unpickled where they are asked for."""
        self.callbacks = thread("fiber-pool-callbacks")
        """Runs the callbacks of results."""

    def start(self) -> None:
        """Start all of them now."""
        for thread in (self.pickling, self.unpickling, self.callbacks):
            thread.start()

    def stop(self) -> None:
        """End all of them once everything submitted is done."""
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
                "what a pool pickles for its workers cannot wait for the same pool, which would "
                "wait for the pickle: get the result before the map, or in the task"
            )
        if self.unpickling.runs_here():
            raise RuntimeError(
                "what unpickles a result cannot wait for another result of the same executor, "
                "which would be unpickled later: get that result where this one is used"
            )
