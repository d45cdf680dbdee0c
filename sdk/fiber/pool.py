"""``Pool``: multiprocessing's pool, in a form that cannot hang.

Signatures, results and errors are multiprocessing's.  Additions are keywords, so code that does not
use them also runs with multiprocessing.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from multiprocessing import util
from multiprocessing.pool import (  # type: ignore[attr-defined]
    CLOSE,
    INIT,
    RUN,
    TERMINATE,
    MaybeEncodingError,
    RemoteTraceback,
    ThreadPool,
)
from typing import Any, Self, TypeVar

from fiber import _logs
from fiber._engine.chunks import default_chunksize
from fiber._exceptions import report_uncaught
from fiber._runtime import options, start_methods
from fiber._runtime import progress as reports
from fiber._runtime.executor import PoolExecutor
from fiber._runtime.options import PoolOptions
from fiber._runtime.state import runtime
from fiber._runtime.work_items import WorkItem
from fiber._runtime.workers import WorkerInfo
from fiber._wire import work
from fiber.errors import FiberError, TimeoutError
from fiber.process import PoolProcess, process_type
from fiber.resources import Resources
from fiber.results import (
    SLICEABLE,
    ApplyResult,
    AsyncResult,
    IMapIterator,
    IMapUnorderedIterator,
    MapResult,
)

__all__ = [
    "ApplyResult",
    "AsyncResult",
    "IMapIterator",
    "IMapUnorderedIterator",
    "MapResult",
    "MaybeEncodingError",
    "Pool",
    "RemoteTraceback",
    "ThreadPool",
    "WorkerInfo",
]

_S = TypeVar("_S")
_T = TypeVar("_T")
_ErrorCallback = Callable[[BaseException], object]


class Pool:
    """A pool of worker processes.

    ``processes`` is their number, by default ``cpu_count()``.  Each calls
    ``initializer(*initargs)`` first, and is replaced after ``maxtasksperchild`` tasks (None:
    never).  ``context`` chooses the start method.  Beyond multiprocessing:

    * ``min_workers`` (by default 1) and ``max_workers`` (by default ``cpu_count()``), in place of
      ``processes``, make the pool follow the work.  A worker above ``min_workers`` ends after
      ``idle_timeout`` idle seconds (None: never).
    * A task whose worker dies runs again elsewhere, at most ``retries`` times (None: as
      configured).  Then it raises ``WorkerDied``.  Other tasks are not affected.  If the cluster
      ends a worker (drained, evicted, preempted, its node lost), its task uses up no retry.  It
      runs again at most ``disruptions`` times (None: as configured; with ``retries=0`` never).
    * A task that raises one of ``retry_exceptions`` (with ``error_handling=True`` any Exception)
      also runs again, up to ``retries`` times, before the exception counts.
    * A task that runs for longer than ``task_timeout`` seconds, or the ``timeout=`` of its call,
      raises TimeoutError, and its worker is killed and replaced.
    * On Kubernetes, ``pool`` names an existing FiberPool, whose pods are used in place of new ones.
      There workers start with the first task, and have the resources that ``fiber.meta`` wishes
      for its function.
    """

    _state = INIT  # until ``__init__`` is through; ``__del__`` looks at it

    def __init__(
        self,
        processes: int | None = None,
        initializer: Callable[..., object] | None = None,
        initargs: Iterable[Any] = (),
        maxtasksperchild: int | None = None,
        context: Any = None,
        *,
        min_workers: int | None = None,
        max_workers: int | None = None,
        retries: int | None = None,
        disruptions: int | None = None,
        retry_exceptions: type[BaseException] | Sequence[type[BaseException]] = (),
        error_handling: bool = False,
        task_timeout: float | None = None,
        idle_timeout: float | None = options.IDLE_TIMEOUT,
        pool: str | None = None,
    ) -> None:
        minimum, maximum = options.sizes(processes, min_workers, max_workers)
        if initializer is not None and not callable(initializer):
            raise TypeError("initializer must be a callable")
        self._processes = maximum
        self._maxtasksperchild = options.max_tasks(maxtasksperchild)
        self._task_timeout = options.seconds("task_timeout", task_timeout)
        self._owner = os.getpid()
        like = process_type(start_methods.settle()) if context is None else context.Process
        self._executor = PoolExecutor(
            PoolOptions(
                new_process=partial(PoolProcess, like=like),
                initializer=initializer,
                initargs=tuple(initargs),
                minimum=minimum,
                maximum=maximum,
                max_tasks=self._maxtasksperchild,
                limits=options.limits(retries, disruptions),
                retryable=(Exception,) if error_handling else options.exceptions(retry_exceptions),
                idle_timeout=options.seconds("idle_timeout", idle_timeout) or math.inf,
                resources=Resources(pool=pool),
            ),
            runtime(),
        )
        # Before the start: if that is interrupted, the caller has no pool to terminate.
        self._terminate = util.Finalize(self, _abandon, args=(self._executor,), exitpriority=15)
        self._executor.start()
        _logs.debug("opened a pool of %d to %d workers", minimum, maximum)
        self._state = RUN

    # Calls

    def apply(
        self,
        func: Callable[..., _T],
        args: Iterable[Any] = (),
        kwds: Mapping[str, Any] = {},
        *,
        timeout: float | None = None,
    ) -> _T:
        """Call ``func(*args, **kwds)`` in a worker and return its result.

        If the call runs for longer than ``timeout`` seconds, its worker is killed, and TimeoutError
        is raised.  None stands for the pool's ``task_timeout``, infinity for no limit.
        """
        self._check_running(func)
        self._check_may_wait()
        result: AsyncResult[_T] = AsyncResult(self)
        limit = self._limit(timeout)
        value: _T = self._executor.call_and_wait(result, func, args, kwds, limit)
        return value

    def apply_async(
        self,
        func: Callable[..., _T],
        args: Iterable[Any] = (),
        kwds: Mapping[str, Any] = {},
        callback: Callable[[_T], object] | None = None,
        error_callback: _ErrorCallback | None = None,
        *,
        timeout: float | None = None,
    ) -> AsyncResult[_T]:
        """Call as ``apply`` does, but return at once with a result to wait for.

        Another thread calls ``callback`` with the result, or ``error_callback`` with the error.
        Both must be quick, since the callbacks of a pool run one after the other.
        """
        self._check_running(func)
        result = AsyncResult(self, callback, error_callback)
        self._executor.call(result, func, args, kwds, self._limit(timeout))
        return result

    def broadcast(self, func: Callable[..., _T], *args: Any) -> list[_T]:
        """Call ``func(*args)`` once in every worker, and return the results of all."""
        self._check_running(func)
        self._check_may_wait()
        result: MapResult[_T] = MapResult(self)
        self._executor.broadcast(result, func, args)
        return result.get()

    # Workers

    def start_workers(self) -> None:
        """Start the workers now, on a cluster, where otherwise the first task would start them.

        They then have the resources for a function without wishes.
        """
        self._check_running()
        self._executor.start_workers()

    def wait_until_workers_up(self, timeout: float | None = None) -> None:
        """Wait until all workers, or ``min_workers`` of them, are ready for tasks.

        TimeoutError after ``timeout`` seconds.  If workers cannot start, the reason is raised.
        """
        self._check_running()
        if not self._executor.wait_until_up(options.seconds("timeout", timeout)):
            infos = self.workers()
            ready = sum(info.state in ("idle", "busy") for info in infos)
            raise TimeoutError(
                f"{ready} of {len(infos)} workers are ready after {timeout:g} s: see workers()"
            )

    def workers(self) -> list[WorkerInfo]:
        """Return the workers that run or start, the oldest first."""
        self._check_owner()
        return self._executor.workers.describe()

    # Maps

    def map(
        self,
        func: Callable[[_S], _T],
        iterable: Iterable[_S],
        chunksize: int | None = None,
        *,
        timeout: float | None = None,
        progress: bool | str | None = None,
    ) -> list[_T]:
        """Return ``[func(x) for x in iterable]``; workers run the calls.

        ``chunksize`` consecutive items go to one worker together.  By default it adapts to the
        duration of the tasks.  An iterator is read as fast as its tasks run.  ``timeout``, as in
        ``apply``, is for each single task.

        ``progress=True`` shows the progress on the standard error stream, and a text names it: by a
        bar of tqdm or rich in a terminal or notebook, by a line every ten seconds elsewhere.  None
        stands for the configuration, which by default shows none.
        """
        return self._map(work.MAP, func, iterable, chunksize, timeout, progress)

    def starmap(
        self,
        func: Callable[..., _T],
        iterable: Iterable[Iterable[Any]],
        chunksize: int | None = None,
        *,
        timeout: float | None = None,
        progress: bool | str | None = None,
    ) -> list[_T]:
        """Return ``[func(*x) for x in iterable]``, otherwise as ``map``."""
        return self._map(work.STAR, func, iterable, chunksize, timeout, progress)

    def map_async(
        self,
        func: Callable[[_S], _T],
        iterable: Iterable[_S],
        chunksize: int | None = None,
        callback: Callable[[list[_T]], object] | None = None,
        error_callback: _ErrorCallback | None = None,
        *,
        timeout: float | None = None,
        progress: bool | str | None = None,
    ) -> MapResult[_T]:
        """Call as ``map`` does, but return a result once ``iterable`` is read.

        Items are pickled later.  Do not change them (an array in place, say) before the result is
        there.

        ``callback`` gets the list of results, ``error_callback`` the first error, as in
        ``apply_async``.
        """
        result = MapResult(self, callback, error_callback)
        self._map_async(work.MAP, func, iterable, chunksize, timeout, progress, result)
        return result

    def starmap_async(
        self,
        func: Callable[..., _T],
        iterable: Iterable[Iterable[Any]],
        chunksize: int | None = None,
        callback: Callable[[list[_T]], object] | None = None,
        error_callback: _ErrorCallback | None = None,
        *,
        timeout: float | None = None,
        progress: bool | str | None = None,
    ) -> MapResult[_T]:
        """Call as ``starmap`` does, but return at once with a result to wait for."""
        result = MapResult(self, callback, error_callback)
        self._map_async(work.STAR, func, iterable, chunksize, timeout, progress, result)
        return result

    def imap(
        self,
        func: Callable[[_S], _T],
        iterable: Iterable[_S],
        chunksize: int = 1,
        *,
        timeout: float | None = None,
        buffersize: int | None = None,
        progress: bool | str | None = None,
    ) -> IMapIterator[_T]:
        """Return an iterator over the results of ``func(x) for x in iterable``, in order.

        Another thread reads ``iterable``, a little faster than its tasks run.  With ``buffersize``
        it reads at most so many items ahead of the results that were taken.  ``timeout`` as in
        ``map``.
        """
        iterator: IMapIterator[_T] = IMapIterator(self)
        return self._imap(iterator, func, iterable, chunksize, timeout, buffersize, progress)

    def imap_unordered(
        self,
        func: Callable[[_S], _T],
        iterable: Iterable[_S],
        chunksize: int = 1,
        *,
        timeout: float | None = None,
        buffersize: int | None = None,
        progress: bool | str | None = None,
    ) -> IMapIterator[_T]:
        """Call as ``imap`` does, and yield results in the order in which they come."""
        iterator: IMapIterator[_T] = IMapUnorderedIterator(self)
        return self._imap(iterator, func, iterable, chunksize, timeout, buffersize, progress)

    # How calls and maps are done

    def _map(
        self,
        kind: int,
        func: Callable[..., _T],
        iterable: Iterable[Any],
        chunksize: int | None,
        timeout: float | None,
        progress: bool | str | None,
    ) -> list[_T]:
        self._check_may_wait()
        result: MapResult[_T] = MapResult(self)
        item = self._item(kind, func, result, chunksize, timeout, progress, iterable)
        if item is not None:
            try:
                if isinstance(iterable, (*SLICEABLE, list)) or self._maxtasksperchild is not None:
                    self._submit(item, iterable, chunksize)
                else:
                    stream = self._executor.open_stream(item)
                    stream.read(iterable)
                    self._executor.finish(item)
                result.wait()
            except BaseException:  # Ctrl-C: no caller waits for the rest
                self._executor.cancel(item)
                raise
            finally:
                reports.reporter.finish(item)
        return result.get()

    def _map_async(
        self,
        kind: int,
        func: Callable[..., _T],
        iterable: Iterable[Any],
        chunksize: int | None,
        timeout: float | None,
        progress: bool | str | None,
        result: MapResult[_T],
    ) -> None:
        item = self._item(kind, func, result, chunksize, timeout, progress, iterable)
        if item is not None:
            result._finish = finish = partial(reports.reporter.finish, item)
            try:
                self._submit(item, iterable, chunksize)
            except BaseException:
                finish()
                raise

    def _imap(
        self,
        iterator: IMapIterator[_T],
        func: Callable[..., _T],
        iterable: Iterable[Any],
        chunksize: int,
        timeout: float | None,
        buffersize: int | None,
        progress: bool | str | None,
    ) -> IMapIterator[_T]:
        buffersize = options.buffersize(buffersize)
        chunksize = options.chunksize(chunksize)
        item = self._item(work.MAP, func, iterator._buffer, chunksize, timeout, progress, iterable)
        if item is not None:
            iterator._begin(self._executor, item, iterable, buffersize)
        return iterator

    def _item(
        self,
        kind: int,
        func: Callable[..., Any],
        future: Any,
        chunksize: int | None,
        timeout: float | None,
        progress: bool | str | None,
        iterable: Iterable[Any],
    ) -> WorkItem | None:
        """Return the work item of a map.

        If the function does not pickle, fail the future and return None.
        """
        self._check_running(func)
        unit = 1 if chunksize is None else options.chunksize(chunksize)
        limit = self._limit(timeout)
        try:
            function = self._executor.function(func)
        except Exception as error:
            self._executor.reject(future, error)
            return None
        item = WorkItem(
            kind,
            function=function,
            future=future,
            unit=unit,
            eager=chunksize == 1,
            timeout=limit,
        )
        reports.follow(item, progress, [iterable], self._executor.workers.busy)
        return item

    def _submit(self, item: WorkItem, iterable: Iterable[Any], chunksize: int | None) -> None:
        try:
            tasks = iterable if isinstance(iterable, SLICEABLE) else tuple(iterable)
        except Exception as error:
            if not hasattr(iterable, "__len__") or item.future is None:
                raise
            # multiprocessing reads what has a length in the background.
            self._executor.reject(item.future, error)
            return
        if chunksize is None and self._maxtasksperchild is not None:
            item.unit = default_chunksize(len(tasks), self._processes)
        self._executor.submit(item, tasks)

    def _limit(self, timeout: float | None) -> float | None:
        """Return the seconds that a task may take; None for no limit."""
        return self._task_timeout if timeout is None else options.seconds("timeout", timeout)

    def _call_back(self, action: Callable[[], None]) -> bool:
        """Run a callback on its thread; False if callbacks are over, or there is no thread."""
        try:
            return self._executor.threads.callbacks.submit(action)
        except RuntimeError:
            report_uncaught()  # no other code would report it
            return False

    def _calls_back_here(self) -> bool:
        """Return whether the caller is a callback."""
        return self._executor.threads.callbacks.runs_here()

    def _check_may_wait(self) -> None:
        self._executor.threads.check_may_wait()

    # The pool itself

    @property
    def _pool(self) -> list[Any]:
        """Processes of the workers."""
        return list(self._executor.workers.processes())

    def _repopulate_pool(self) -> None:
        """Do nothing: workers are replaced when they end."""

    def _check_running(self, func: Callable[..., Any] | None = None) -> None:
        self._check_owner()
        if self._state != RUN:
            raise ValueError("Pool not running")
        if func is not None:
            self._executor.choose_resources(func)

    def _check_owner(self) -> None:
        if os.getpid() != self._owner:
            raise RuntimeError(
                f"this pool belongs to process {self._owner}: its copy in a forked process has no "
                "workers. Make a pool in this process"
            )

    def close(self) -> None:
        """Take no more work.  The workers end once all present tasks are done."""
        self._check_owner()
        _logs.debug("closing pool")
        if self._state == RUN:
            self._state = CLOSE
            self._executor.close()

    def terminate(self) -> None:
        """End the workers at once.  Callers that wait for a result get an error."""
        if os.getpid() != self._owner:
            return  # a copy in a forked process has no workers
        _logs.debug("terminating pool")
        self._state = TERMINATE
        _end(self._executor)
        self._terminate.cancel()  # last: if this is interrupted, it still ends the pool

    def join(self) -> None:
        """Wait until all workers have ended.  Call ``close`` or ``terminate`` first.

        From now on unread results of ``imap(buffersize=)`` do not hold up the remaining tasks.
        """
        self._check_owner()
        _logs.debug("joining pool")
        if self._state == RUN:
            raise ValueError("Pool is still running")
        if self._state not in (CLOSE, TERMINATE):
            raise ValueError("In unknown state")
        self._check_may_wait()
        self._executor.join()
        self._terminate.cancel()

    def __enter__(self) -> Self:
        self._check_running()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.terminate()

    def __reduce__(self) -> str:
        raise NotImplementedError("pool objects cannot be passed between processes or pickled")

    def __repr__(self) -> str:
        cls = type(self)
        size = len(self._pool) if self._state != INIT else 0
        return f"<{cls.__module__}.{cls.__qualname__} state={self._state} pool_size={size}>"

    def __del__(self, _warn: Any = warnings.warn, RUN: str = RUN) -> None:
        if self._state == RUN and self._owner == os.getpid():
            _warn(f"unclosed running multiprocessing pool {self!r}", ResourceWarning, source=self)


def _end(executor: PoolExecutor) -> None:
    executor.terminate(_terminated())
    if not (executor.on_loop() or executor.threads.pickling.runs_here()):
        executor.ended.wait()
        reports.reporter.look()


def _terminated() -> FiberError:
    return FiberError(
        "the pool was terminated before this result was there. To wait for all results, call "
        "close() and join() instead"
    )


def _abandon(executor: PoolExecutor) -> None:
    """End a pool that was not terminated: the program ends, or has dropped the pool."""
    if util.is_exiting():
        _end(executor)
    else:
        # The garbage collector runs on any thread, so this must not wait.
        executor.terminate(_terminated())
