"""Results of a pool's calls: objects to wait for, and iterators.

As in ``multiprocessing.pool``, with what that leaves open promised: a result of a pool that is
terminated or cannot go on raises an error instead of waiting for ever.
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
from fiber._runtime.answers import Pickled, TaskFailure, decode, is_failure
from fiber._runtime.executor import PoolExecutor
from fiber._runtime.latch import Latch, Waiters, acquire
from fiber._runtime.work_items import InputStream, WorkItem

__all__ = ["ApplyResult", "AsyncResult", "IMapIterator", "IMapUnorderedIterator", "MapResult"]

SLICEABLE = (tuple, range, str, bytes)
"""Types that are mapped without a copy: they do not change, and slices of them are cheap."""

_T = TypeVar("_T")
_ErrorCallback = Callable[[BaseException], object]


class Keeper(Protocol):
    """Part of a pool that an iterator needs.  It keeps the pool while results are to come."""

    def _check_may_wait(self) -> None:
        """Raise RuntimeError on a thread that must not wait for a result."""


class ResultPool(Keeper, Protocol):
    """Part of a pool that a result needs."""

    def _calls_back_here(self) -> bool:
        """Return whether the caller is a callback, on the thread of all callbacks."""

    def _call_back(self, action: Callable[[], None]) -> bool:
        """Have a callback run; False if none runs any more."""


class ApplyResult(Generic[_T]):
    """The result of one call, as ``apply_async`` returns it."""

    def __init__(
        self,
        pool: ResultPool,
        callback: Callable[[_T], object] | None = None,
        error_callback: _ErrorCallback | None = None,
    ) -> None:
        # Keeps the pool while there is something to wait for, as in multiprocessing.
        self._pool: ResultPool | None = pool
        self._callback = callback
        self._error_callback = error_callback
        self._outcome: Any = None
        self._mixed = False
        self._done = Latch()
        """The outcome is there, and the callback has run."""
        calls_back = callback is not None or error_callback is not None
        self._arrived = Latch() if calls_back else self._done
        """The outcome is there."""
        # Reentrant: unpickling runs the user's code, which may ask for this very result.
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
        """The result, or the exception that the call raised; TimeoutError if there is neither."""
        self.wait(timeout)
        if not self.ready():
            raise _too_late(timeout)
        outcome = self._settled()
        if type(outcome) is TaskFailure:
            raise fresh(outcome.error)
        value: _T = outcome
        return value

    # What the executor says

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
        """All outcomes are there: call back, then let those go on who wait."""
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
        """Return what the calling thread waits for.

        Callbacks run one after the other: one that waits for a result cannot wait for the callback
        of that result, too.
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
        """Unpickle what still is; on one thread."""
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
        f"no result within {timeout} s; its task goes on, and its result can still be waited for"
    )


class MapResult(ApplyResult[list[_T]]):
    """The results of a map, as ``map_async`` returns it.

    If tasks raised, it raises what the first of them, in time, did; once all are done.
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
        # In this order: whoever is interrupted at any line begins again here, with what is left.
        if self._first is None:
            self._first = _unpickle(self._outcome)
        if self._first is not None:
            self._outcome = decode(self._first)
        self._mixed = False


def _unpickle(outcomes: list[Any]) -> TaskFailure | None:
    """Unpickle in place what is pickled, up to the first failure, which stays pickled there."""
    for at, outcome in enumerate(outcomes):
        if type(outcome) is Pickled:
            value = outcome.decode()
            if type(value) is TaskFailure:
                return value
            outcomes[at] = value
    return None


HELD = 64 << 20
"""Bytes of results, as workers sent them, that an iterator holds for somebody who does not read
them.  Then no more tasks are begun until half of the results are read."""


class _ResultBuffer:
    """Results on their way to an iterator: what the executor fills and the iterator empties."""

    def __init__(self, pool: Keeper) -> None:
        self.items: deque[Any] = deque()
        self.finished = False
        self.stream: InputStream | None = None
        """Reader that reads no more than is consumed, if that was asked for."""
        self.pool: Keeper | None = pool
        self.resume: Callable[[], None] | None = None
        """Function that asks the executor for more, after ``add_results`` asked for no more."""
        self._waiters = Waiters()
        self._abandoned = False
        self._bounded = True
        self._passed = 0  # results that were put into ``items``
        self._held = 0  # bytes, of which some may have been taken since it was last looked
        self._sizes: deque[tuple[int, int]] = deque()
        """Pairs: number of results passed on so far, and bytes of those since the pair before."""
        self._resume_at = -1  # results that are left then; -1: nothing is held back

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
        if self._sizes and self._sizes[-1][1] < HELD >> 10:  # else they take more than the results
            size += self._sizes.pop()[1]
        self._sizes.append((self._passed, size))

    def consumed(self) -> int:
        """Return the number of results that the user took.  On the loop's thread."""
        return self._passed - len(self.items)

    def _is_full(self) -> bool:
        if self._held < HELD or not self._bounded:
            return False
        held_back = self._resume_at >= 0
        # Noted first: whoever takes results while they are counted asks for more.
        self._resume_at = max(self._resume_at, len(self.items) // 2)
        if held_back:
            return True  # until half of them are read, and not before
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
        """Take all that comes."""
        self._bounded = False
        self._resume_at = -1

    def abandon(self) -> None:
        """Drop the results, and hold back no task for them: the reader has gone.  From anywhere."""
        self._abandoned = True
        if self.resume is not None:
            self.resume()

    def _drop(self) -> None:
        self.items.clear()
        self._sizes.clear()

    def ask(self) -> None:
        """Have the executor go on, if it waits until results are read.

        Changes nothing here, and is called after each result and before each wait: whoever is
        interrupted after the one makes up for it before the other.
        """
        stream = self.stream
        if stream is not None:
            stream.ask()
        if self._resume_at >= len(self.items) and self.resume is not None:
            self.resume()

    def set_done(self) -> None:
        """All outcomes are there."""
        self.finished = True
        self.pool = None
        self.stream = None  # which knows this, too
        self._waiters.wake()

    def set_exception(self, error: BaseException) -> None:
        """End the results with ``error``."""
        self.items.append(TaskFailure(error))
        self.set_done()

    def wait(self, timeout: float | None) -> Any:
        """The next outcome; StopIteration at the end, TimeoutError if it takes too long."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            waiter = self._waiters.join()
            finished = self.finished  # the last items come before it
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
        self._early: dict[int, tuple[list[Any], int]] = {}

    def _keep(self, start: int, outcomes: list[Any], size: int) -> None:
        """Pass on what is next in order."""
        self._early[start] = outcomes, size
        while (ready := self._early.pop(self._passed, None)) is not None:
            self._pass_on(*ready)

    def _drop(self) -> None:
        super()._drop()
        self._early.clear()


class IMapIterator(Iterator[_T]):
    """Iterator over the results of ``imap``, in order."""

    _buffer_type: type[_ResultBuffer] = _OrderedResultBuffer
    _cancel: Callable[[], None] | None = None

    def __init__(self, pool: Keeper) -> None:
        self._buffer = self._buffer_type(pool)

    def __iter__(self) -> Self:
        return self

    def next(self, timeout: float | None = None) -> _T:
        """The next result; TimeoutError if it takes longer than ``timeout`` seconds."""
        outcome = self._take(timeout)
        if type(outcome) is TaskFailure:
            raise fresh(outcome.error)
        value: _T = outcome
        return value

    __next__ = next

    def _take(self, timeout: float | None) -> Any:
        """The next result or Failure; what is raised is not a task's."""
        buffer = self._buffer
        try:
            outcome = buffer.items.popleft()
        except IndexError:
            outcome = buffer.wait(timeout)
        buffer.ask()
        return outcome.decode() if type(outcome) is Pickled else outcome

    def _begin(
        self,
        executor: PoolExecutor,
        item: WorkItem,
        iterable: Iterable[Any],
        buffersize: int | None,
    ) -> None:
        """Have ``item``, whose future the buffer is, map ``iterable``."""
        buffer = self._buffer
        buffer.resume = partial(executor.resume, item)
        if buffersize is None and isinstance(iterable, (*SLICEABLE, list)):
            tasks = tuple(iterable) if isinstance(iterable, list) else iterable
            executor.submit(item, tasks)
            return
        try:
            stream = executor.open_stream(item, buffersize, buffer.consumed)
            if buffersize is not None:
                buffer.stream = stream
                self._cancel = partial(executor.cancel, item)
            executor.read(item, iterable)
        except BaseException:  # a stream that nobody reads would be waited for
            executor.cancel(item)
            raise

    def __del__(self) -> None:
        buffer: _ResultBuffer | None = getattr(self, "_buffer", None)
        if buffer is None or buffer.finished:  # None: ``__init__`` was interrupted
            return
        if self._cancel is None:
            buffer.abandon()
        else:  # nobody can make room any more for what was not read yet
            self._cancel()
            buffer.stream = None


class IMapUnorderedIterator(IMapIterator[_T]):
    """Iterator over the results of ``imap_unordered``, as they come."""

    _buffer_type = _ResultBuffer
