"""Progress of maps: counts from their results, shown while they run.

A ``ProgressFuture`` stands before the future of a map and counts the results on their way.  So a
map without progress costs nothing.  One thread, ``fiber-progress``, shows all maps of the program.

Calls without ``progress=`` follow the configuration.  Their bar appears once they have run for a
while, so that a loop of short maps shows none.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence, Sized
from typing import Any, Protocol

from fiber import _logs, config
from fiber._runtime import options
from fiber._runtime.answers import is_failure
from fiber._runtime.progress_views import (
    QUIET,
    LateView,
    MapProgress,
    View,
    choose_view,
    is_child,
    is_interactive,
)
from fiber._runtime.work_items import WorkItem

INTERVAL = 0.2
"""Seconds between two looks."""


class ProgressSource(Protocol):
    """Running map, or loop of joblib, whose progress is shown."""

    @property
    def is_over(self) -> bool:
        """True once no result will come."""

    def look(self) -> MapProgress:
        """Return the progress now."""


class ProgressFuture:
    """Future of a map that counts the results, and passes them on.  A ``TaskFuture``."""

    def __init__(
        self,
        item: WorkItem,
        name: str,
        total: int | None,
        busy: Busy,
        on_over: Callable[[], object],
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

    def look(self) -> MapProgress:
        """Return the progress now."""
        job = self.item.job
        total = self._total
        if total is None and job is not None and job.closed:
            total = job.fed
        lost = 0 if job is None else job.charges.lost
        seconds = time.monotonic() - self._began
        return MapProgress(self._name, self._done, total, self._failed, lost, self._busy(), seconds)


Busy = Callable[[], int]
"""Function that returns the number of workers at work."""


class ProgressReporter:
    """Reporter of all maps of the program that are to be shown.  Any thread."""

    def __init__(self, make_view: Callable[[], View] = choose_view) -> None:
        self._make_view = make_view
        self._lock = threading.RLock()
        self._shown: dict[object, tuple[ProgressSource, View]] = {}
        self._thread: threading.Thread | None = None
        self._wake = threading.Event()

    def show(self, key: object, source: ProgressSource, *, late: bool = False) -> None:
        """Show a progress until its source is over.  ``late``: only once it has run for a while.

        The thread draws, so that Ctrl-C cannot leave half a bar.
        """
        with self._lock:
            self._shown[key] = source, LateView(self._make_view, QUIET if late else 0.0)
            with contextlib.suppress(RuntimeError):  # no room for a thread: the end is shown
                self._start()
        if not late:
            self._wake.set()

    def finish(self, key: object) -> None:
        """Show the last state, if it is not shown yet: the caller goes on and may print."""
        if key not in self._shown:
            return
        with self._lock:
            source, view = self._shown.get(key, (None, None))
            if source is None or view is None:
                return
            try:
                self._draw(key, view.finish, source)
            finally:  # not earlier: another thread may wait for the last state
                self._shown.pop(key, None)

    def look(self) -> None:
        """Show the present state of all maps, and finish those that are over."""
        with self._lock:
            for key in list(self._shown):
                self._update(key)

    def wake(self) -> None:
        """Let the thread look now."""
        self._wake.set()

    def close(self) -> None:
        """Finish all maps: the program ends."""
        for key in list(self._shown):
            self.finish(key)

    def _start(self) -> None:
        if self._thread is None:
            thread = threading.Thread(target=self._run, name="fiber-progress", daemon=True)
            thread.start()
            self._thread = thread

    def _run(self) -> None:
        while True:
            woken = self._wake.wait(INTERVAL)
            self._wake.clear()
            with self._lock:
                self.look()
                if not (self._shown or woken):  # not earlier: the next map of a loop uses it, too
                    self._thread = None
                    return

    def _update(self, key: object) -> None:
        source, view = self._shown[key]
        if source.is_over:
            self.finish(key)
        else:
            self._draw(key, view.show, source)

    def _draw(
        self, key: object, draw: Callable[[MapProgress], None], source: ProgressSource
    ) -> None:
        try:
            draw(source.look())
        except Exception as error:  # a closed terminal, say, must not fail the map
            self._shown.pop(key, None)
            _logs.debug("cannot show the progress: %r", error)


reporter = ProgressReporter()


@atexit.register
def _close() -> None:
    reporter.close()


def _forget() -> None:
    global reporter
    reporter = ProgressReporter()


os.register_at_fork(after_in_child=_forget)


def follow(
    item: WorkItem, wanted: bool | str | None, iterables: Sequence[Iterable[Any]], busy: Busy
) -> None:
    """Show the progress of a map, which has not begun, if its call or the configuration wants it.

    ``wanted`` is the call's ``progress=``; None stands for the configuration.
    """
    assert item.function is not None
    label = options.label(wanted, item.function.name)
    if not label and (wanted is not None or not is_configured()):
        return
    name = label or item.function.name
    on_over = reporter.wake if label else bool  # a late view has time until the next look
    item.future = source = ProgressFuture(item, name, _total(iterables), busy, on_over)
    reporter.show(item, source, late=not label)


def is_configured() -> bool:
    """Return whether to show the progress of maps that are called without ``progress=``."""
    wanted = config.current().progress
    return wanted != "never" and not is_child() and (wanted == "always" or is_interactive())


def _total(iterables: Sequence[Iterable[Any]]) -> int | None:
    """Return the number of tasks; None if it is not known."""
    if not all(isinstance(each, Sized) for each in iterables):
        return None
    try:
        return min(map(len, iterables))  # type: ignore[arg-type]
    except Exception:  # of the user's ``__len__``
        return None
