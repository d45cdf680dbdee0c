"""Progress of maps: counts from their results, shown while they run.

A ``ProgressFuture`` stands before the future of a map and counts the results on their way.  So a
map without progress costs nothing.  One thread, ``fiber-progress``, shows all maps of the program.
"""

from __future__ import annotations

import atexit
import os
import threading
import time
from collections.abc import Callable, Iterable, Sized
from typing import Any, NamedTuple

from fiber._runtime.answers import is_failure
from fiber._runtime.progress_views import View, choose_view
from fiber._runtime.work_items import WorkItem

INTERVAL = 0.2
"""Seconds between two looks."""


class Progress(NamedTuple):
    """Progress of a map at one moment."""

    name: str
    """Label of the map: the user's, or the name of the function."""
    done: int
    total: int | None
    """Number of tasks; None while the input is being read."""
    failed: int
    lost: int
    """Runs that were lost with their workers."""
    busy: int
    """Workers at work in the pool."""
    seconds: float
    """Seconds since the map began."""

    @property
    def rate(self) -> float:
        """Tasks a second since the map began."""
        return self.done / self.seconds if self.seconds > 0 else 0.0

    @property
    def left(self) -> float | None:
        """Seconds until the end at this rate; None if that is not known."""
        if self.total is None or not self.done:
            return None
        return (self.total - self.done) / self.rate


class ProgressFuture:
    """Future of a map that counts the results, and passes them on.  A ``TaskFuture``."""

    def __init__(
        self,
        item: WorkItem,
        name: str,
        total: int | None,
        busy: Busy,
        on_over: Callable[[], None] = lambda: None,
    ) -> None:
        """``on_over`` is called, on the loop thread, when the map is over."""
        assert item.future is not None
        self._on_over = on_over
        self.item = item
        self._future = future = item.future
        self._name = name
        self._total = total
        self._busy = busy
        self._began = time.monotonic()
        self._done = self._failed = 0
        self._is_over = False
        self.has_room = future.has_room
        self.lift_bound = future.lift_bound

    def add_results(self, start: int, outcomes: list[Any], mixed: bool, size: int = 0) -> bool:
        """Count outcomes, and pass them on."""
        self._done += len(outcomes)
        if mixed:
            self._failed += sum(map(is_failure, outcomes))
        return self._future.add_results(start, outcomes, mixed, size)

    def set_done(self) -> None:
        """Note that the map is over, and pass that on."""
        self._is_over = True
        self._total = self._done
        self._on_over()
        self._future.set_done()

    def set_exception(self, error: BaseException) -> None:
        """Note that the map is over, and pass the error on."""
        self._is_over = True
        self._on_over()
        self._future.set_exception(error)

    @property
    def is_over(self) -> bool:
        """True once no result will come: the map has its results, has failed, or is cancelled."""
        return self._is_over or (self.item.job is not None and self.item.future is None)

    def look(self) -> Progress:
        """Return the progress now."""
        job = self.item.job
        total = self._total
        if total is None and job is not None and job.closed:
            total = job.fed
        lost = 0 if job is None else job.charges.lost
        seconds = time.monotonic() - self._began
        return Progress(self._name, self._done, total, self._failed, lost, self._busy(), seconds)


Busy = Callable[[], int]
"""Function that returns the number of workers at work."""


class ProgressReporter:
    """Reporter of all maps of the program that are to be shown.  Any thread."""

    def __init__(self, make_view: Callable[[], View] = choose_view) -> None:
        self._make_view = make_view
        self._lock = threading.RLock()
        self._shown: dict[WorkItem, tuple[ProgressFuture, View]] = {}
        self._thread: threading.Thread | None = None
        self._wake = threading.Event()

    def show(self, item: WorkItem, name: str, iterable: Iterable[Any], busy: Busy) -> None:
        """Show the progress of a map, which has not begun, until it is over."""
        total = len(iterable) if isinstance(iterable, Sized) else None
        item.future = future = ProgressFuture(item, name, total, busy, self._wake.set)
        with self._lock:
            self._shown[item] = future, self._make_view()
            self._update(item)
            if self._thread is None:
                thread = threading.Thread(target=self._run, name="fiber-progress", daemon=True)
                thread.start()
                self._thread = thread

    def finish(self, item: WorkItem) -> None:
        """Show the last state of a map now: its caller goes on and may print."""
        with self._lock:
            future, view = self._shown.pop(item, (None, None))
            if future is not None and view is not None:
                view.finish(future.look())
        self._wake.set()

    def close(self) -> None:
        """Finish all maps: the program ends."""
        for item in list(self._shown):
            self.finish(item)

    def _run(self) -> None:
        while True:
            self._wake.wait(INTERVAL)
            self._wake.clear()
            with self._lock:
                for item in list(self._shown):
                    self._update(item)
                if not self._shown:
                    self._thread = None
                    return

    def _update(self, item: WorkItem) -> None:
        future, view = self._shown[item]
        if future.is_over:
            self.finish(item)
        else:
            view.show(future.look())


reporter = ProgressReporter()


@atexit.register
def _close() -> None:
    reporter.close()


def _forget() -> None:
    global reporter
    reporter = ProgressReporter()


os.register_at_fork(after_in_child=_forget)
