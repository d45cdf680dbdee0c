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
    are for the loop's thread only, so nothing here needs a lock.
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
        """Whether it runs the caller, who then must not wait for what it would do next."""
        return threading.current_thread() is self._thread

    def stop(self) -> None:
        """End once everything submitted is done."""
        self._stopped = True
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
