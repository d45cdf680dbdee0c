"""Event loop: a thread that waits for descriptors and timers, and runs callbacks.

In a program this is the daemon thread ``fiber-io``; in an agent it is the main thread.  Callbacks
run one at a time and must not block.  An exception in a callback is reported, and the loop goes on.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import os
import select
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

from fiber._exceptions import fresh, report_uncaught
from fiber._wire.descriptor import own
from fiber.errors import FiberError

Callback = Callable[[], object]

LONGEST_POLL = 60.0
"""Limit of the seconds of one wait in the kernel.

The kernel takes at most 2**31 milliseconds.  If the program closed the descriptors, a longer wait
would not end by itself.
"""

DOZE = 0.2
"""Limit of the seconds for which another thread waits for the loop at a time.

A signal that comes just before the wait may wait so long for its handler
(``fiber._runtime.threads`` says why).
"""

_EVENTS = 128
"""Limit of the descriptors in one turn.

If more are ready, the kernel returns the others in the next turn.  In between the loop serves
timers and the calls of other threads.
"""

_MANY_TIMERS = 1024

_this_thread = threading.local()


def runs_here() -> bool:
    """Tell whether a loop runs on the calling thread, which then must not wait."""
    return getattr(_this_thread, "runs_a_loop", False)


class Dependent(Protocol):
    """Object that waits for something that only a loop can bring."""

    def broken(self, error: FiberError) -> None:
        """Note that the loop has failed.  Called once, on the loop thread."""


class ScheduledCall(Protocol):
    """Call that the loop makes later."""

    def cancel(self) -> None:
        """Cancel the call."""


class EventLoop(Protocol):
    """Part of a loop that links and backends use: its clock and its calls.

    ``Loop`` implements it.  Tests implement it with simulated time.
    """

    def now(self) -> float:
        """Return the time in seconds of a monotonic clock."""

    def call_soon(self, callback: Callable[..., None], *args: Any) -> None:
        """Call ``callback`` on the loop thread.  Any thread."""

    def call_later(
        self, seconds: float, callback: Callable[..., None], *args: Any
    ) -> ScheduledCall:
        """Call ``callback`` once, after ``seconds``."""


class LoopTimer:
    """Call that the loop makes later, unless it is cancelled."""

    __slots__ = ("callback", "due")

    def __init__(self, due: float, callback: Callback) -> None:
        self.due = due
        self.callback: Callback | None = callback

    def cancel(self) -> None:
        """Cancel the call."""
        self.callback = None


class Wakeup:
    """Eventfd that stays open while a caller may still write to it."""

    __slots__ = ("_owner", "fd")

    def __init__(self) -> None:
        self._owner = own(os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK))
        self.fd = self._owner.fileno()

    def set(self) -> None:
        """Make the eventfd readable."""
        os.eventfd_write(self.fd, 1)


class Loop:
    """Event loop over epoll.  ``register`` and ``unregister`` may be called from any thread.

    ``call_soon`` may be called from anywhere: from another thread, from a signal handler, or from a
    finalizer, which the garbage collector may run in the middle of this module.  It takes no lock,
    and each of its changes is a single step.
    """

    def __init__(self) -> None:
        self._epoll = select.epoll()
        wakeup = Wakeup()
        self._wakeup: Wakeup | None = wakeup
        self._epoll.register(wakeup.fd, select.EPOLLIN)
        self._asleep = False
        self._readers: dict[int, Callback] = {wakeup.fd: partial(os.eventfd_read, wakeup.fd)}
        self._writers: dict[int, Callback] = {}
        self._paused: set[int] = set()
        self._ready: deque[tuple[Callable[..., object], tuple[Any, ...]]] = deque()
        self._timers: list[tuple[float, int, LoopTimer]] = []
        self._sequence = itertools.count()
        self._sweep_at = _MANY_TIMERS
        self._dependents: weakref.WeakSet[Dependent] = weakref.WeakSet()
        self._failure: FiberError | None = None
        self._thread: threading.Thread | None = None
        self._ident: int | None = None
        self._running = False
        self._closed = False

    def start_thread(self, name: str) -> None:
        """Run on a daemon thread of this process."""
        self._thread = threading.Thread(target=self.run, name=name, daemon=True)
        self._thread.start()

    def on_thread(self) -> bool:
        """Tell whether the caller runs on the loop thread."""
        return threading.get_ident() == self._ident

    @property
    def broken(self) -> bool:
        """True if the loop has failed.  Then it runs no callback."""
        return self._failure is not None

    @property
    def running(self) -> bool:
        """True while the loop runs callbacks."""
        return self._running

    def depend(self, dependent: Dependent) -> None:
        """Call ``dependent.broken`` if the loop fails; raise at once if it has failed already.

        The loop holds ``dependent`` weakly.
        """
        # Both sides first write and then read, so at least one of them sees the other.
        self._dependents.add(dependent)
        if self._failure is not None:
            raise fresh(self._failure)

    @staticmethod
    def now() -> float:
        """Return the time of the loop's clock, in monotonic seconds."""
        return time.monotonic()

    def call_soon(self, callback: Callable[..., object], *args: Any) -> None:
        """Call ``callback`` on the loop thread, after all earlier calls.  From anywhere."""
        self._ready.append((callback, args))
        # The loop notes that it goes to sleep, and then looks for calls.  Only the loop takes that
        # note back, so a caller that a signal interrupts here has changed nothing.
        wakeup = self._wakeup  # keeps its descriptor from being closed and reused
        if self._asleep and wakeup is not None:
            wakeup.set()

    def call_later(self, seconds: float, callback: Callable[..., object], *args: Any) -> LoopTimer:
        """Call ``callback`` once, ``seconds`` from now, on the loop thread."""
        timer = LoopTimer(self.now() + seconds, partial(callback, *args) if args else callback)
        if self.on_thread():
            self._add_timer(timer)
        else:
            self.call_soon(self._add_timer, timer)
        return timer

    def register(self, fd: int, callback: Callback) -> None:
        """Call back whenever ``fd`` is readable or at its end, until unregistered."""
        self._readers[fd] = callback
        self._epoll.register(fd, select.EPOLLIN)

    def unregister(self, fd: int) -> None:
        """Forget ``fd``.  Call it before the descriptor is closed."""
        self._writers.pop(fd, None)
        self._paused.discard(fd)
        if self._readers.pop(fd, None) is not None and not self._closed:
            self._epoll.unregister(fd)

    def pause(self, fd: int) -> None:
        """Do not call back when the registered ``fd`` is readable, until ``resume``."""
        self._paused.add(fd)
        self._epoll.modify(fd, self._interest(fd))

    def resume(self, fd: int) -> None:
        """Watch ``fd`` again."""
        self._paused.discard(fd)
        if fd in self._readers:
            self._epoll.modify(fd, self._interest(fd))

    def _interest(self, fd: int) -> int:
        reads = 0 if fd in self._paused else select.EPOLLIN
        return reads | (select.EPOLLOUT if fd in self._writers else 0)

    def want_write(self, fd: int, callback: Callback | None) -> None:
        """Also call back when the registered ``fd`` is writable; None ends it."""
        if callback is None:
            self._writers.pop(fd, None)
        else:
            self._writers[fd] = callback
        if fd in self._readers:
            self._epoll.modify(fd, self._interest(fd))

    def run(self) -> None:
        """Run callbacks until ``stop``."""
        self._ident = threading.get_ident()
        self._running = _this_thread.runs_a_loop = True
        try:
            while self._running:
                self._run_once()
        except BaseException as error:
            self._break(error)
            raise
        finally:
            _this_thread.runs_a_loop = False
        self._close()

    def _run_once(self) -> None:
        timeout = self._timeout()
        if timeout:
            self._asleep = True
            if self._ready:
                timeout = 0.0
        try:
            events = self._epoll.poll(timeout, _EVENTS)
        except InterruptedError:
            return
        finally:
            self._asleep = False
        self._run_ready()  # calls that were requested before an event run before its callback
        self._dispatch(events)
        self._run_ready()
        self._run_timers()

    def _break(self, error: BaseException) -> None:
        """Call ``broken`` of all dependents, so that none waits for ever."""
        failure = FiberError(
            f"the thread of Fiber's event loop has ended by {error!r}: no answer can arrive. Check "
            "whether the program closes descriptors that it did not open, as os.closerange() "
            "does, and start it again"
        )
        failure.__cause__ = error
        self._running = False
        self._failure = failure
        for dependent in list(self._dependents):
            _call(dependent.broken, failure)
        with contextlib.suppress(OSError):  # closed descriptors may be the reason for the failure
            self._close()

    def stop(self) -> None:
        """End the loop after the present callbacks; from another thread, wait for its end."""
        if self._closed:
            return
        if self._ident is None and (self._thread is None or self._thread.ident is None):
            # It never ran.
            self._close()
            return
        self.call_soon(self._stop)
        if self._thread is not None and not self.on_thread():
            self._thread.join()

    def _stop(self) -> None:
        self._running = False

    def _timeout(self) -> float:
        if self._ready:
            return 0
        while self._timers and self._timers[0][2].callback is None:
            heapq.heappop(self._timers)
        if not self._timers:
            return LONGEST_POLL
        return min(LONGEST_POLL, max(0.0, self._timers[0][0] - self.now()))

    def _dispatch(self, events: list[tuple[int, int]]) -> None:
        for fd, event in events:
            if event & ~select.EPOLLOUT:
                reader = self._readers.get(fd)
                if reader is not None:
                    _call(reader)
            if event & select.EPOLLOUT:
                writer = self._writers.get(fd)
                if writer is not None:
                    _call(writer)

    def _run_ready(self) -> None:
        for _ in range(len(self._ready)):
            callback, args = self._ready.popleft()
            _call(callback, *args)

    def _run_timers(self) -> None:
        now = self.now()
        while self._timers and self._timers[0][0] <= now:
            timer = heapq.heappop(self._timers)[2]
            if timer.callback is not None:
                _call(timer.callback)

    def _add_timer(self, timer: LoopTimer) -> None:
        if len(self._timers) >= self._sweep_at:
            # Cancelled timers that are due late would pile up.
            self._timers = [entry for entry in self._timers if entry[2].callback is not None]
            heapq.heapify(self._timers)
            self._sweep_at = max(_MANY_TIMERS, 2 * len(self._timers))
        heapq.heappush(self._timers, (timer.due, next(self._sequence), timer))

    def _close(self) -> None:
        self._closed = True
        self._epoll.close()
        self._wakeup = None
        self._readers.clear()
        self._writers.clear()


def _call(callback: Callable[..., object], *args: Any) -> None:
    try:
        callback(*args)
    except Exception:
        # An error in one callback must be reported and must not stop the others.
        report_uncaught()
