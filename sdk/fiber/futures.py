"""``Executor``: concurrent.futures' executor of processes, run by Fiber.

``from fiber import futures`` instead of ``from concurrent import futures``: signatures, states of
futures and errors are concurrent.futures'.  Additions are keywords, and the method ``options``.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import math
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import (
    ALL_COMPLETED,
    FIRST_COMPLETED,
    FIRST_EXCEPTION,
    BrokenExecutor,
    CancelledError,
    Future,
    InvalidStateError,
    ThreadPoolExecutor,
    TimeoutError,
    as_completed,
    wait,
)
from concurrent.futures._base import CANCELLED, CANCELLED_AND_NOTIFIED, FINISHED, RUNNING
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import TimeoutError as WaitedTooLong
from multiprocessing import util
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any, ParamSpec, TypeVar

from fiber import cpu, errors
from fiber._exceptions import fresh, report_uncaught
from fiber._runtime import options, start_methods
from fiber._runtime import progress as reports
from fiber._runtime.answers import Pickled, TaskFailure
from fiber._runtime.executor import PoolExecutor
from fiber._runtime.executor_group import ExecutorGroup, broken, refusal
from fiber._runtime.jobs import CallQueue
from fiber._runtime.options import PoolOptions
from fiber._runtime.state import runtime
from fiber._runtime.threads import BackgroundThread
from fiber._runtime.work_items import InputClosed, WorkItem
from fiber._wire import work
from fiber.process import PoolProcess, process_type
from fiber.resources import Resources, merged, wished
from fiber.results import SLICEABLE, IMapIterator

__all__ = [
    "ALL_COMPLETED",
    "FIRST_COMPLETED",
    "FIRST_EXCEPTION",
    "BrokenExecutor",
    "BrokenProcessPool",
    "CancelledError",
    "Executor",
    "Future",
    "InvalidStateError",
    "ProcessPoolExecutor",
    "ThreadPoolExecutor",
    "TimeoutError",
    "WorkerDied",
    "as_completed",
    "wait",
]

_P = ParamSpec("_P")
_T = TypeVar("_T")


class WorkerDied(errors.WorkerDied, BrokenProcessPool):
    """``fiber.WorkerDied`` as executors raise it: it is a BrokenProcessPool, too.

    It concerns this task alone.  The executor goes on with another worker.
    """


class Executor(concurrent.futures.Executor):
    """A ``concurrent.futures.ProcessPoolExecutor`` that a worker's death does not break.

    At most ``max_workers`` processes (by default ``cpu_count()``) start as tasks need them.  Each
    calls ``initializer(*initargs)`` first and is replaced after ``max_tasks_per_child`` tasks
    (None: never).  ``mp_context`` chooses the start method.  Beyond concurrent.futures:

    * A task whose worker dies runs again elsewhere, at most ``retries`` times (None: as
      configured).  Then it raises ``WorkerDied``, which is a BrokenProcessPool.  Other tasks are
      not affected.  The executor is broken only when no worker starts.  If the cluster ends a
      worker (drained, evicted, preempted, its node lost), its task uses up no retry.  It runs again
      at most ``disruptions`` times (None: as configured; with ``retries=0`` never).
    * A task that raises one of ``retry_exceptions`` also runs again, up to ``retries`` times,
      before the exception counts.
    * A worker ends after ``idle_timeout`` idle seconds (None: never).
    * On Kubernetes workers have the resources that ``fiber.meta`` or ``options`` wishes for their
      tasks.  ``pool`` names an existing FiberPool, whose pods are used.

    When Ctrl-C ends a ``with`` block, it waits for the running tasks and cancels the others.
    """

    def __init__(
        self,
        max_workers: int | None = None,
        mp_context: Any = None,
        initializer: Callable[..., object] | None = None,
        initargs: Iterable[Any] = (),
        *,
        max_tasks_per_child: int | None = None,
        retries: int | None = None,
        disruptions: int | None = None,
        retry_exceptions: type[BaseException] | Sequence[type[BaseException]] = (),
        idle_timeout: float | None = options.IDLE_TIMEOUT,
        pool: str | None = None,
    ) -> None:
        if initializer is not None and not callable(initializer):
            raise TypeError("initializer must be a callable")
        self._max_workers = options.positive("max_workers", max_workers) or cpu.cpu_count()
        like = process_type(start_methods.settle()) if mp_context is None else _process(mp_context)
        limits = options.limits(retries, disruptions)
        self._group = ExecutorGroup(
            PoolOptions(
                new_process=partial(PoolProcess, like=like),
                initializer=initializer,
                initargs=tuple(initargs),
                minimum=0,
                maximum=self._max_workers,
                max_tasks=options.positive("max_tasks_per_child", max_tasks_per_child),
                limits=limits,
                retryable=options.exceptions(retry_exceptions),
                idle_timeout=options.seconds("idle_timeout", idle_timeout) or math.inf,
                resources=Resources(pool=pool),
                calls_back_at_end=True,
                closes_streams=True,
                refusal=refusal,
            ),
            runtime(),
        )
        self._wishes = Resources()
        self._retries = retries
        self._disruptions = disruptions
        self._limits = limits
        self._timeout: float | None = None
        self._queues: dict[PoolExecutor, CallQueue] = {}

    def options(
        self,
        *,
        cpu: float | str | None = None,
        memory: int | str | None = None,
        gpu: int | None = None,
        resources: Mapping[str, int] | None = None,
        node_selector: Mapping[str, str] | None = None,
        tolerations: Sequence[str | Mapping[str, Any]] | None = None,
        retries: int | None = None,
        disruptions: int | None = None,
        timeout: float | None = None,
    ) -> Executor:
        """Return this executor with options for the tasks that are submitted through the result.

        ``executor.options(memory="8Gi", retries=0).submit(f)``, as in Ray.  The options from
        ``cpu`` to ``tolerations`` are wishes as in ``fiber.meta``.  Tasks with different wishes
        have different workers, ``max_workers`` of each kind.  A task that runs for longer than
        ``timeout`` seconds raises ``fiber.TimeoutError``, and its worker is replaced.  Options that
        are left out keep their values.  ``shutdown`` of one executor shuts down both.
        """
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        wishes = wished(
            "Executor.options",
            cpu,
            memory,
            gpu,
            resources=resources,
            node_selector=node_selector,
            tolerations=tolerations,
        )
        other._wishes = merged(self._wishes, wishes)
        other._retries = self._retries if retries is None else retries
        other._disruptions = self._disruptions if disruptions is None else disruptions
        other._limits = options.limits(other._retries, other._disruptions)
        if timeout is not None:
            other._timeout = options.seconds("timeout", timeout)
        other._queues = {}
        util.Finalize(other, _close_queues, args=(other._queues,))
        return other

    def submit(self, fn: Callable[_P, _T], /, *args: _P.args, **kwargs: _P.kwargs) -> Future[_T]:
        """Call ``fn(*args, **kwargs)`` in a worker; return the future of its result.

        It is a future of concurrent.futures, and coroutines of asyncio can await it.  The arguments
        are pickled at once, so the caller may change them afterwards.
        """
        engine = self._group.executor_for(fn, self._wishes)
        queue = self._queues.get(engine) or self._queue(engine)
        future: CallFuture[_T] = CallFuture(engine, queue)
        engine.call(future, fn, args, kwargs, queue=queue)
        return future

    def map(
        self,
        fn: Callable[..., _T],
        *iterables: Iterable[Any],
        timeout: float | None = None,
        chunksize: int = 1,
        buffersize: int | None = None,
        progress: bool | str | None = None,
    ) -> Iterator[_T]:
        """Return an iterator over ``fn(*items) for items in zip(*iterables)``, in order.

        It raises TimeoutError if a result is not there ``timeout`` seconds after this call.  It
        ends with the first error, and cancels the tasks that have not begun.  ``chunksize`` items
        go to one worker together.  Another thread reads iterators, a little faster than their tasks
        run.  With ``buffersize`` it reads at most so many items ahead of the results taken.  After
        ``shutdown`` it reads none: the results of the items before come, then, if there are further
        items, RuntimeError.  ``progress`` as in ``Pool.map``.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        ahead = options.buffersize(buffersize)
        unit = options.chunksize(chunksize)
        several = len(iterables) != 1
        source = zip(*iterables, strict=False) if several else _iterable(iterables[0])
        rest = iter(source) if ahead is not None else None
        engine = self._group.executor_for(fn, self._wishes)
        results: IMapIterator[Any] = IMapIterator(self._group)
        try:
            item = WorkItem(
                work.STAR if several else work.MAP,
                function=engine.function(fn),
                future=results._buffer,
                unit=unit,
                eager=unit == 1,
                timeout=self._timeout,
                limits=self._limits,
            )
        except Exception as error:  # it does not pickle
            engine.reject(results._buffer, error)
            return _taken(results, engine, None, deadline, None)
        reports.follow(item, progress, iterables, engine.workers.busy)
        results._begin(engine, item, source if rest is None else rest, ahead)
        return _taken(results, engine, item, deadline, rest)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more tasks.  The workers end once the present tasks are done.

        ``wait``: return only then.  ``cancel_futures``: cancel the tasks that have not begun.
        """
        self._group.shut_down(wait, cancel_futures)

    def terminate_workers(self) -> None:
        """End the workers at once and for good; unfinished tasks raise BrokenProcessPool."""
        self._group.terminate()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.shutdown(cancel_futures=isinstance(error, KeyboardInterrupt))

    def __reduce__(self) -> str:
        raise NotImplementedError("executors cannot be passed between processes or pickled")

    def _queue(self, engine: PoolExecutor) -> CallQueue:
        queue = CallQueue(limits=self._limits, timeout=self._timeout, cancellable=True)
        return self._queues.setdefault(engine, queue)  # another thread may call this, too

    # Attributes of concurrent.futures that libraries use

    @property
    def _processes(self) -> dict[int | None, BaseProcess]:
        return {process.pid: process for process in self._group.processes()}

    @property
    def _broken(self) -> bool:
        return any(engine.error is not None for engine in self._group.executors())


ProcessPoolExecutor = Executor
"""Name of the executor for programs that were written for concurrent.futures."""


class CallFuture(Future[_T]):
    """Future of one call, which an executor uses as a ``work_items.CancellableFuture``.

    The user's code, unpicklers and callbacks, does not run on the loop thread.
    """

    def __init__(self, executor: PoolExecutor, queue: CallQueue) -> None:
        super().__init__()
        self._executor = executor
        self._threads = executor.threads
        self._queue = queue
        self._undecided = bytearray(1)  # a type that the garbage collector does not visit
        """Token of a decision.  The side that takes it out runs the call, or cancels it."""
        self._claimed: bool | None = None

    def __await__(self) -> Generator[Any, None, _T]:
        """Await the result.  A task that is cancelled meanwhile cancels the call."""
        import asyncio  # takes long to import; a caller that awaits has imported it

        return asyncio.wrap_future(self).__await__()

    def cancel(self) -> bool:
        """Cancel as in concurrent.futures.  ``wait`` and ``as_completed`` notice it in a moment."""
        if not (self._decide() or self.cancelled()):
            return False
        super().cancel()
        self._executor.calls.drop_cancelled(self._queue)
        return True

    def cancelled(self) -> bool:
        """Tell whether the call was cancelled.  It takes no lock, as the loop asks too."""
        return self._claimed is False or self._state in (CANCELLED, CANCELLED_AND_NOTIFIED)

    def result(self, timeout: float | None = None) -> _T:
        """Return the result as in concurrent.futures.  Each call raises a new exception."""
        error = self._error(timeout)
        if error is not None:
            raise fresh(error)
        result: Any = self._result
        return result  # type: ignore[no-any-return]

    def exception(self, timeout: float | None = None) -> BaseException | None:
        """Return the exception as in concurrent.futures.  Each call returns a new one."""
        error = self._error(timeout)
        return error and fresh(error)

    def _error(self, timeout: float | None) -> BaseException | None:
        """Wait, and return the stored exception."""
        if self._state != FINISHED:
            if (timeout is None or timeout > 0) and not self.done():
                self._threads.check_may_wait()
            return super().exception(timeout)
        return self._exception

    def _decide(self) -> bool:
        try:
            self._undecided.pop()
        except IndexError:
            return False
        return True

    # Reports of the executor, on the loop thread

    def claim(self) -> bool:
        """Claim the call for a worker; return False if it was cancelled."""
        if self._claimed is None:
            self._claimed = self._decide()
            if self._claimed:
                self._state = RUNNING
            else:
                self._locked(self._end_cancelled)
        return self._claimed

    def _end_cancelled(self) -> None:
        super().cancel()  # the caller of ``cancel`` may have been interrupted
        self.set_running_or_notify_cancel()

    def add_results(self, start: int, outcomes: list[Any], mixed: bool, size: int = 0) -> bool:
        """Take the outcome."""
        outcome = outcomes[0]
        if type(outcome) is Pickled:
            self._submit(self._threads.unpickling, partial(self._unpickle, outcome))
        else:
            self._settle(outcome)
        return False

    def set_done(self) -> None:
        """Do nothing: a call is done with its outcome."""

    def has_room(self) -> bool:
        """Return True: one outcome always has room."""
        return True

    def lift_bound(self) -> None:
        """Do nothing: there is no bound."""

    def set_exception(self, exception: BaseException | None) -> None:
        """Set an exception as the outcome, or in place of one."""
        if self.claim() and exception is not None:
            error = translated(exception, self._executor)
            self._locked(partial(super().set_exception, error))

    def _settle(self, outcome: Any) -> None:
        if type(outcome) is TaskFailure:
            self.set_exception(outcome.error)
        else:
            self._locked(partial(self.set_result, outcome))

    def _unpickle(self, outcome: Pickled) -> None:
        try:
            value = outcome.decode()
        except BaseException as error:  # the user's unpickler may raise anything
            value = TaskFailure(error)
        self._settle(value)

    def _locked(self, action: Callable[[], object]) -> None:
        """Run an action that takes the future's lock, which the program's threads take, too.

        The loop does not wait for the lock: a thread that was interrupted just after taking it may
        keep it for any time.
        """
        if not self._executor.on_loop():
            action()
        elif self._condition.acquire(blocking=False):
            try:
                action()
            finally:
                self._condition.release()
        else:
            self._submit(self._threads.unpickling, action)

    def _invoke_callbacks(self) -> None:
        call = super()._invoke_callbacks  # type: ignore[misc]
        here = self._executor.on_loop() or self._threads.unpickling.runs_here()
        if self._done_callbacks and here:  # type: ignore[attr-defined]
            self._submit(self._threads.callbacks, call)
        else:
            call()

    def _submit(self, thread: BackgroundThread, action: Callable[[], object]) -> None:
        with contextlib.suppress(RuntimeError):  # the system has no room for its thread
            if thread.submit(action):
                return
        try:
            action()  # else the outcome, or its callbacks, would be lost
        except BaseException:  # also SystemExit from a callback: the loop must go on
            report_uncaught()


def translated(error: BaseException, executor: PoolExecutor) -> BaseException:
    """Return an executor's error in the class that concurrent.futures would raise."""
    if error is executor.error:
        return broken(error)
    if type(error) is errors.WorkerDied:
        died = errors._rebuild(WorkerDied, error.args)
        vars(died).update(vars(error))
        return died
    return error


def _close_queues(queues: dict[PoolExecutor, CallQueue]) -> None:
    for engine, queue in queues.items():
        engine.calls.close(queue)


def _process(context: Any) -> Any:
    try:
        return context.Process
    except AttributeError:
        raise TypeError(
            f"mp_context must be what fiber.get_context() returns, not {context!r}"
        ) from None


def _iterable(given: Any) -> Iterable[Any]:
    """Return sequences that are taken whole unchanged; return an iterator of anything else."""
    return given if isinstance(given, (*SLICEABLE, list)) else iter(given)


def _taken(
    results: IMapIterator[Any],
    engine: PoolExecutor,
    item: WorkItem | None,
    deadline: float | None,
    rest: Iterator[Any] | None,
) -> Iterator[Any]:
    """Yield the results of a map, up to the first error.

    ``rest`` is the input of a map with ``buffersize``.
    """
    try:
        # In a list, so that this frame keeps no result that the user has dropped.
        while held := _next(results, engine, deadline):
            yield held.pop()
    except InputClosed:
        # As in Python 3.14: only the user reads input after the shutdown, one item at most.
        if rest is not None and next(rest, _END) is not _END:
            raise refusal() from None
    finally:
        if item is not None:
            engine.cancel(item)
            reports.reporter.finish(item)


_END = object()


def _next(results: IMapIterator[Any], engine: PoolExecutor, deadline: float | None) -> list[Any]:
    """Return the next result of a map in a list, which is empty at the end."""
    left = None if deadline is None else deadline - time.monotonic()
    try:
        outcome = results._take(left)
    except StopIteration:
        return []
    except WaitedTooLong:
        raise TimeoutError("the next result of the map was not there in time") from None
    if type(outcome) is TaskFailure:
        raise fresh(translated(outcome.error, engine))
    return [outcome]
