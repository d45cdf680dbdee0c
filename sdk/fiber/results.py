"""Results of a pool's calls: objects to wait for, and iterators.

As in ``multiprocessing.pool``, with one more promise: if the pool is terminated or cannot go on,
its results raise an error.  In multiprocessing they may wait for ever.
"""

from __future__ import annotations

import contextlib
import threading
import time
import types
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from multiprocessing import TimeoutError
from typing import Any, Generic, Protocol, Self, TypeVar

from fiber._exceptions import fresh
from fiber._runtime import progress
from fiber._runtime.answers import Pickled, TaskFailure, decode, is_failure
from fiber._runtime.executor import PoolExecutor
from fiber._runtime.threads import Latch, Waiters, acquire
from fiber._runtime.work_items import InputStream, WorkItem

__all__ = ["ApplyResult", "AsyncResult", "IMapIterator", "IMapUnorderedIterator", "MapResult"]

SLICEABLE = (tuple, range, str, bytes)
"""Types that are mapped without a copy: they do not change, and slices of them are cheap."""

_T = TypeVar("_T")
_ErrorCallback = Callable[[BaseException], object]


class Keeper(Protocol):
    """Part of a pool or executor that an iterator needs, and keeps alive until its last result."""

    def _check_may_wait(self) -> None:
        """Raise RuntimeError on a thread that must not wait for a result."""


class ResultPool(Keeper, Protocol):
    """Part of a pool that a result needs."""

    def _calls_back_here(self) -> bool:
        """Return whether the caller runs on the thread of the callbacks."""

    def _call_back(self, action: Callable[[], None]) -> bool:
        """Run a callback on its thread; return False if callbacks are over."""


class ApplyResult(Generic[_T]):
    """Result of one call, as ``apply_async`` returns it."""

    def __init__(
        self,
        pool: ResultPool,
        callback: Callable[[_T], object] | None = None,
        error_callback: _ErrorCallback | None = None,
    ) -> None:
        # As in multiprocessing, a result keeps its pool alive until it is there.
        self._pool: ResultPool | None = pool
        self._callback = callback
        self._error_callback = error_callback
        self._outcome: Any = None
        self._mixed = False
        self._done = Latch()
        """Set once the outcome is there and the callback has run."""
        calls_back = callback is not None or error_callback is not None
        self._arrived = Latch() if calls_back else self._done
        """Set once the outcome is there."""
        # Reentrant: unpickling runs the user's code, which may ask for this result.
        self._settling = threading.RLock()

    def ready(self) -> bool:
        """Tell whether the call has completed."""
        return self._awaited().is_set()

    def successful(self) -> bool:
        """Tell whether the call completed without raising; ValueError if it has not completed."""
        if not self.ready():
            raise ValueError(f"{self!r} not ready")
        return type(self._settled()) is not TaskFailure

    def wait(self, timeout: float | None = None) -> None:
        """Wait until the result is there or ``timeout`` seconds are over."""
        awaited = self._awaited()
        if not awaited.is_set():
            _check_may_wait(self._pool, timeout)
            awaited.wait(timeout)

    def get(self, timeout: float | None = None) -> _T:
        """Return the result or raise the call's exception; TimeoutError if neither is there."""
        self.wait(timeout)
        if not self.ready():
            raise _too_late(timeout)
        outcome = self._settled()
        if type(outcome) is TaskFailure:
            raise fresh(outcome.error)
        value: _T = outcome
        return value

    # Called by the executor, on the loop thread

    def add_results(self, start: int, outcomes: list[Any], mixed: bool, size: int = 0) -> bool:
        """Take the outcome."""
        self._outcome = outcomes[0]
        self._mixed = mixed
        return False

    def has_room(self) -> bool:
        """Return True: the caller wants all results at once."""
        return True

    def lift_bound(self) -> None:
        """Do nothing: there is no bound."""

    def set_done(self) -> None:
        """Run the callback, then wake the waiters: all outcomes are there."""
        pool = self._pool
        if self._arrived is self._done or pool is None:
            self._complete()
            return
        self._arrived.set()
        if not pool._call_back(self._run_callback):
            self._complete()

    def set_exception(self, error: BaseException) -> None:
        """Fail the call with ``error``."""
        self._outcome = TaskFailure(error)
        self._mixed = False
        self.set_done()

    def _run_callback(self) -> None:
        try:
            self._settle()
            failed = type(self._outcome) is TaskFailure
            callback = self._error_callback if failed else self._callback
            if callback is not None:
                callback(fresh(self._outcome.error) if failed else self._outcome)
        finally:
            self._complete()

    def _awaited(self) -> Latch:
        """Return the latch that the calling thread waits for.

        Callbacks run one after the other.  So a callback that waits for a result does not wait for
        the callback of that result.
        """
        pool = self._pool
        if self._arrived is self._done or pool is None or not pool._calls_back_here():
            return self._done
        return self._arrived

    def _complete(self) -> None:
        self._pool = None
        self._done.set()

    def _settled(self) -> Any:
        if self._mixed:
            with self._settling:
                self._settle()
        return self._outcome

    def _settle(self) -> None:
        """Unpickle the outcome, if it is still pickled.  One thread at a time calls this."""
        if self._mixed:
            self._outcome = decode(self._outcome)
            self._mixed = False

    def __class_getitem__(cls, item: Any, /) -> types.GenericAlias:
        return types.GenericAlias(cls, item)


AsyncResult = ApplyResult


def _check_may_wait(pool: Keeper | None, timeout: float | None) -> None:
    if pool is not None and (timeout is None or timeout > 0):
        pool._check_may_wait()


def _too_late(timeout: float | None) -> TimeoutError:
    return TimeoutError(
        f"no result within {timeout} s. The task goes on: call again to wait for its result"
    )


class MapResult(ApplyResult[list[_T]]):
    """Results of a map, as ``map_async`` returns them.

    If tasks raised, ``get`` raises the exception that came first in time, once all tasks are done.
    """

    def __init__(
        self,
        pool: ResultPool,
        callback: Callable[[list[_T]], object] | None = None,
        error_callback: _ErrorCallback | None = None,
    ) -> None:
        super().__init__(pool, callback, error_callback)
        self._outcome = []
        self._first: Any = None
        self._finish: Callable[[], None] | None = None
        """Function that shows the last progress of the map."""

    def wait(self, timeout: float | None = None) -> None:
        """Wait until the results are there or ``timeout`` seconds are over."""
        super().wait(timeout)
        if self._finish is not None and self.ready():
            self._finish()

    def add_results(self, start: int, outcomes: list[Any], mixed: bool, size: int = 0) -> bool:
        """Take outcomes."""
        values = self._outcome
        if start > len(values):
            values.extend([None] * (start - len(values)))
        values[start : start + len(outcomes)] = outcomes
        if mixed:
            self._mixed = True
            if self._first is None:
                self._first = next(filter(is_failure, outcomes), None)
        return False

    def _settle(self) -> None:
        if not self._mixed:
            return
        # In this order: after an interruption at any line, the next call does what is left.
        if self._first is None:
            self._first = _unpickle(self._outcome)
        if self._first is not None:
            self._outcome = decode(self._first)
        self._mixed = False


def _unpickle(outcomes: list[Any]) -> TaskFailure | None:
    """Unpickle outcomes in place, up to the first failure, which stays pickled there."""
    for at, outcome in enumerate(outcomes):
        if type(outcome) is Pickled:
            value = outcome.decode()
            if type(value) is TaskFailure:
                return value
            outcomes[at] = value
    return None


HELD = 64 << 20
"""Bytes of unread results, as workers sent them, from which on an iterator pauses its tasks until
half of the results are read."""


class _ResultBuffer:
    """Results on their way to an iterator: the executor adds them, the iterator takes them."""

    def __init__(self, pool: Keeper) -> None:
        self.items: deque[Any] = deque()
        self.finished = False
        self.stream: InputStream | None = None
        """Input of an ``imap`` with ``buffersize``, which reads on as results are consumed."""
        self.pool: Keeper | None = pool
        self.resume: Callable[[], None] | None = None
        """Function that ends the pause of the job that ``add_results`` asked for."""
        self._waiters = Waiters()
        self._abandoned = False
        self._bounded = True
        self._passed = 0  # results that were put into ``items``
        self._held = 0  # bytes; some of them may have been taken since the last count
        self._sizes: deque[tuple[int, int]] = deque()
        """Pairs: number of results passed on so far, and bytes of those since the pair before."""
        self._resume_at = -1  # unread results at which the pause ends; -1: no pause

    def add_results(self, start: int, outcomes: list[Any], mixed: bool, size: int = 0) -> bool:
        """Take outcomes."""
        if self._abandoned:
            return False
        self._held += size
        self._keep(start, outcomes, size)
        self._waiters.wake()
        return self._is_full()

    def _keep(self, start: int, outcomes: list[Any], size: int) -> None:
        self._pass_on(outcomes, size)

    def _pass_on(self, outcomes: list[Any], size: int) -> None:
        self.items.extend(outcomes)
        self._passed += len(outcomes)
        if self._sizes and self._sizes[-1][1] < HELD >> 10:  # keeps the pairs few
            size += self._sizes.pop()[1]
        self._sizes.append((self._passed, size))

    def consumed(self) -> int:
        """Return the number of results that the user took.  On the loop thread."""
        return self._passed - len(self.items)

    def _is_full(self) -> bool:
        if self._held < HELD or not self._bounded:
            return False
        held_back = self._resume_at >= 0
        # Set before the count: a reader that takes results during the count ends the pause.
        self._resume_at = max(self._resume_at, len(self.items) // 2)
        if held_back:
            return True  # the pause goes on until half of them are read
        consumed = self.consumed()
        while self._sizes and self._sizes[0][0] <= consumed:
            self._held -= self._sizes.popleft()[1]
        if self._held < HELD:
            self._resume_at = -1
        return self._held >= HELD

    def has_room(self) -> bool:
        """Tell whether half of the held results were read, or the reader has gone."""
        if self._abandoned:
            self._drop()
        elif self._resume_at < len(self.items):
            return False
        self._resume_at = -1
        return True

    def lift_bound(self) -> None:
        """Ask for no pause from now on."""
        self._bounded = False
        self._resume_at = -1

    def abandon(self) -> None:
        """Drop the results and end the pause: the reader has gone.  Runs on any thread."""
        self._abandoned = True
        if self.resume is not None:
            self.resume()

    def _drop(self) -> None:
        self.items.clear()
        self._sizes.clear()

    def ask(self) -> None:
        """Ask the executor to go on, if it waits until results are read.

        This changes no state, and runs after each result and before each wait.  If a reader is
        interrupted in the first call, the second makes up for it.
        """
        stream = self.stream
        if stream is not None:
            stream.ask()
        if self._resume_at >= len(self.items) and self.resume is not None:
            self.resume()

    def set_done(self) -> None:
        """Note that all outcomes are there, and wake the readers."""
        self.finished = True
        self.pool = None
        self.stream = None  # it has ended, too
        self._waiters.wake()

    def set_exception(self, error: BaseException) -> None:
        """End the results with ``error``."""
        self.items.append(TaskFailure(error))
        self.set_done()

    def wait(self, timeout: float | None) -> Any:
        """Return the next outcome; StopIteration at the end, TimeoutError after ``timeout``."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            waiter = self._waiters.join()
            finished = self.finished  # read before the items: the last items come before it
            with contextlib.suppress(IndexError):  # other threads take them, too
                outcome = self.items.popleft()
                self._waiters.leave(waiter)
                return outcome
            if finished:
                self._waiters.leave(waiter)
                raise StopIteration
            self.ask()
            left = None if deadline is None else deadline - time.monotonic()
            _check_may_wait(self.pool, left)
            if not acquire(waiter, left):
                self._waiters.leave(waiter)
                raise _too_late(timeout)


class _OrderedResultBuffer(_ResultBuffer):
    def __init__(self, pool: Keeper) -> None:
        super().__init__(pool)
        self._out_of_order: dict[int, tuple[list[Any], int]] = {}

    def _keep(self, start: int, outcomes: list[Any], size: int) -> None:
        """Pass on the outcomes that are next in order."""
        self._out_of_order[start] = outcomes, size
        while (ready := self._out_of_order.pop(self._passed, None)) is not None:
            self._pass_on(*ready)

    def _drop(self) -> None:
        super()._drop()
        self._out_of_order.clear()


class IMapIterator(Iterator[_T]):
    """Iterator over the results of ``imap``, in the order of their tasks."""

    _buffer_type: type[_ResultBuffer] = _OrderedResultBuffer
    _cancel: Callable[[], None] | None = None
    _item: WorkItem | None = None
    """Work item of the map, once it has begun."""

    def __init__(self, pool: Keeper) -> None:
        self._buffer = self._buffer_type(pool)

    def __iter__(self) -> Self:
        return self

    def next(self, timeout: float | None = None) -> _T:
        """Return the next result; TimeoutError if it takes longer than ``timeout`` seconds."""
        outcome = self._take(timeout)
        if type(outcome) is TaskFailure:
            raise fresh(outcome.error)
        value: _T = outcome
        return value

    __next__ = next

    def _take(self, timeout: float | None) -> Any:
        """Return the next result or TaskFailure; errors of tasks are not raised here."""
        buffer = self._buffer
        try:
            outcome = buffer.items.popleft()
        except IndexError:
            outcome = self._wait(timeout)
        buffer.ask()
        return outcome.decode() if type(outcome) is Pickled else outcome

    def _wait(self, timeout: float | None) -> Any:
        try:
            return self._buffer.wait(timeout)
        except StopIteration:
            progress.reporter.finish(self._item)  # now, as the reader may print
            raise

    def _begin(
        self,
        executor: PoolExecutor,
        item: WorkItem,
        iterable: Iterable[Any],
        buffersize: int | None,
    ) -> None:
        """Start the map of ``iterable``: ``item`` has this buffer as its future."""
        buffer = self._buffer
        buffer.resume = partial(executor.resume, item)
        self._item = item
        try:
            if buffersize is None and isinstance(iterable, (*SLICEABLE, list)):
                tasks = tuple(iterable) if isinstance(iterable, list) else iterable
                executor.submit(item, tasks)
                return
            stream = executor.open_stream(item, buffersize, buffer.consumed)
            if buffersize is not None:
                buffer.stream = stream
                self._cancel = partial(executor.cancel, item)
            executor.read(item, iterable)
        except BaseException:  # the executor would wait for a stream without a reader
            executor.cancel(item)
            progress.reporter.finish(item)
            raise

    def __del__(self) -> None:
        buffer: _ResultBuffer | None = getattr(self, "_buffer", None)
        if buffer is None or buffer.finished:  # None: ``__init__`` was interrupted
            return
        if self._cancel is None:
            buffer.abandon()
        else:  # without a reader there will be no room for the unread input
            self._cancel()
            buffer.stream = None


class IMapUnorderedIterator(IMapIterator[_T]):
    """Iterator over the results of ``imap_unordered``, as they come."""

    _buffer_type = _ResultBuffer
