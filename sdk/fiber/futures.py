"""``Executor``: concurrent.futures', whose worker processes are Fiber's.

``from fiber import futures`` instead of ``from concurrent import futures``: signatures, states of
futures and errors are concurrent.futures'.  What is more is spelled by keywords and ``options``.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import math
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
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
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import TimeoutError as WaitedTooLong
from multiprocessing import util
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any, ParamSpec, TypeVar

from fiber import cpu, errors
from fiber._runtime import methods, options
from fiber._runtime.calls import CallQueue
from fiber._runtime.executor import Executor as Engine
from fiber._runtime.options import PoolOptions
from fiber._runtime.outcome import Failure, Pickled
from fiber._runtime.state import runtime
from fiber._runtime.work_items import WorkItem
from fiber._wire import work
from fiber.process import PoolProcess, process_type
from fiber.resources import Resources, merged, resources_of, wished
from fiber.results import IMapIterator

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

_EXIT_PRIORITY = 20
"""Before pools are terminated, which its tasks may use."""


class WorkerDied(errors.WorkerDied, BrokenProcessPool):
    """``fiber.WorkerDied``, and what concurrent.futures raises then.

    It concerns this task alone: the executor goes on with another worker.
    """


class Executor(concurrent.futures.Executor):
    """A ``concurrent.futures.ProcessPoolExecutor`` that a worker's death does not break.

    At most ``max_workers`` processes (by default ``cpu_count()``) start as there is work for them.
    Each begins with ``initializer(*initargs)`` and is replaced after ``max_tasks_per_child`` tasks
    (None: never).  ``mp_context`` is that of the start method.  Beyond concurrent.futures:

    * A task whose worker dies runs again elsewhere, at most ``retries`` times (None: as
      configured), then it raises ``WorkerDied``, which is a BrokenProcessPool; other tasks never
      notice.  The executor is broken only when no worker starts.
    * A task that raises one of ``retry_exceptions`` runs again, too, before the exception counts.
    * A worker that has had nothing to do for ``idle_timeout`` seconds (None: for ever) leaves.
    * On Kubernetes workers have what ``fiber.meta`` or ``options`` says that their tasks need;
      ``pool`` is the name of a FiberPool that is there already, whose pods are used.

    Left by Ctrl-C, a ``with`` block waits for the tasks that run and cancels those that do not.
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
        retry_exceptions: type[BaseException] | Sequence[type[BaseException]] = (),
        idle_timeout: float | None = options.IDLE_TIMEOUT,
        pool: str | None = None,
    ) -> None:
        if initializer is not None and not callable(initializer):
            raise TypeError("initializer must be a callable")
        self._max_workers = _worker_count(max_workers)
        like = process_type(methods.settle()) if mp_context is None else mp_context.Process
        self._workers = _Workers(
            PoolOptions(
                new_process=partial(PoolProcess, like=like),
                initializer=initializer,
                initargs=tuple(initargs),
                minimum=0,
                maximum=self._max_workers,
                max_tasks=_max_tasks(max_tasks_per_child),
                retries=options.retries(retries),
                retryable=options.exceptions(retry_exceptions),
                idle_timeout=options.seconds("idle_timeout", idle_timeout) or math.inf,
                resources=Resources(pool=pool),
                calls_back_at_end=True,
            )
        )
        self._wishes = Resources()
        self._retries: int | None = None
        self._timeout: float | None = None
        self._queues: dict[Engine, CallQueue] = {}

    def options(
        self,
        *,
        cpu: float | str | None = None,
        memory: int | str | None = None,
        gpu: int | None = None,
        retries: int | None = None,
        timeout: float | None = None,
    ) -> Executor:
        """This executor, with options for what is submitted through what this returns.

        ``executor.options(memory="8Gi", retries=0).submit(f)``, as Ray spells it.  ``cpu``,
        ``memory`` and ``gpu`` are wishes as in ``fiber.meta``; tasks with different wishes have
        different workers, ``max_workers`` of each kind.  A task that runs for longer than
        ``timeout`` seconds raises ``fiber.TimeoutError``, and its worker is replaced.  What is left
        out is as it was.  To shut down either is to shut down both.
        """
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        other._wishes = merged(self._wishes, wished(cpu, memory, gpu))
        if retries is not None:
            other._retries = options.retries(retries)
        if timeout is not None:
            other._timeout = options.seconds("timeout", timeout)
        other._queues = {}
        util.Finalize(other, _close_queues, args=(other._queues,))
        return other

    def submit(self, fn: Callable[_P, _T], /, *args: _P.args, **kwargs: _P.kwargs) -> Future[_T]:
        """Have ``fn(*args, **kwargs)`` called in a worker; returns the future of its result.

        The arguments are pickled at once: what happens to them later changes nothing.
        """
        engine = self._workers.engine_for(fn, self._wishes)
        queue = self._queues.get(engine) or self._open_queue(engine)
        future = _CallFuture(engine, queue)
        engine.call(future, fn, args, kwargs, queue=queue)
        return future

    def map(
        self,
        fn: Callable[..., _T],
        *iterables: Iterable[Any],
        timeout: float | None = None,
        chunksize: int = 1,
        buffersize: int | None = None,
    ) -> Iterator[_T]:
        """An iterator over ``fn(*items) for items in zip(*iterables)``, in order.

        It raises TimeoutError if a result is not there ``timeout`` seconds after this call, and
        ends with the first error; what has not begun by then is cancelled.  ``chunksize``: so many
        items go to one worker together.  Iterators are read in another thread, little faster than
        they are worked off; with ``buffersize`` also at most so many items ahead of what was taken.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        ahead = options.buffersize(buffersize)
        unit = options.chunksize(chunksize)
        engine = self._workers.engine_for(fn, self._wishes)
        results = IMapIterator(self._workers)
        several = len(iterables) != 1
        try:
            item = WorkItem(
                work.STAR if several else work.MAP,
                function=engine.function(fn),
                future=results._buffer,
                unit=unit,
                exact=unit == 1,
                timeout=self._timeout,
                retries=self._retries,
            )
        except Exception as error:  # it does not pickle
            engine.reject(results._buffer, error)
            return _taken(results, engine, None, deadline)
        source = zip(*iterables, strict=False) if several else iterables[0]
        results._begin(engine, item, source, ahead)
        return _taken(results, engine, item, deadline)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more tasks; the workers leave once those that are there are done.

        ``wait``: return only then.  ``cancel_futures``: cancel those that have not begun.
        """
        self._workers.shut_down(wait, cancel_futures)

    def terminate_workers(self) -> None:
        """End the workers at once and for good; what is not done raises BrokenProcessPool."""
        self._workers.terminate()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.shutdown(cancel_futures=isinstance(error, KeyboardInterrupt))

    def __reduce__(self) -> str:
        raise NotImplementedError("executors cannot be passed between processes or pickled")

    def _open_queue(self, engine: Engine) -> CallQueue:
        queue = CallQueue(retries=self._retries, timeout=self._timeout, cancellable=True)
        kept = self._queues.setdefault(engine, queue)  # another thread may be here as well
        if kept is queue:
            engine.calls.open(queue)
        return kept

    # What libraries look at

    @property
    def _processes(self) -> dict[int | None, BaseProcess]:
        return {process.pid: process for process in self._workers.processes()}

    @property
    def _broken(self) -> bool:
        return any(engine.error is not None for engine in self._workers.engines())


ProcessPoolExecutor = Executor
"""What concurrent.futures' users look for."""


class _Workers:
    """The workers of an executor and of all that its ``options`` return.

    Where hosts are made for them, one set of them for each kind of wishes.
    """

    def __init__(self, template: PoolOptions) -> None:
        self._template = template
        self._runtime = runtime()
        self._owner = os.getpid()
        self._engines: dict[Resources, Engine] = {}
        self._lock = threading.RLock()  # a finalizer may come back here
        self._closed = False
        # Forgotten with tasks under way, it ends after them.
        util.Finalize(self, _close_engines, args=(self._engines,))

    def engine_for(self, function: Callable[..., Any], wishes: Resources) -> Engine:
        """What runs ``function``; an error if nothing does any more."""
        if os.getpid() != self._owner:
            raise RuntimeError(
                f"this executor belongs to process {self._owner}: a copy of it that came here by a "
                "fork has no workers; make an executor in this process"
            )
        if self._closed or util.is_exiting():
            when = "shutdown" if self._closed else "interpreter shutdown"
            raise RuntimeError(f"cannot schedule new futures after {when}")
        kind = self._template.resources
        if self._runtime.elastic:
            kind = merged(kind, merged(resources_of(function), wishes))
        engine = self._engines.get(kind) or self._start(kind)
        if engine.error is not None:
            raise _broken(engine.error)
        return engine

    def _start(self, kind: Resources) -> Engine:
        with self._lock:
            engine = self._engines.get(kind)
            if engine is None:
                engine = Engine(self._template._replace(resources=kind), self._runtime)
                util.Finalize(engine, _finish, (weakref.ref(engine),), exitpriority=_EXIT_PRIORITY)
                engine.start()
                self._engines[kind] = engine
            return engine

    def processes(self) -> list[BaseProcess]:
        """Those of all workers."""
        return [process for engine in self.engines() for process in engine.workers.processes()]

    def engines(self) -> list[Engine]:
        """What runs them."""
        return list(self._engines.values())

    def shut_down(self, wait: bool, cancel: bool) -> None:
        """See ``Executor.shutdown``."""
        for engine in self._close():
            if cancel:
                engine.cancel_all(CancelledError())
            engine.close()
        if wait:
            self._check_may_wait()
            for engine in self._close():
                engine.join()

    def terminate(self) -> None:
        """See ``Executor.terminate_workers``."""
        for engine in self._close():
            engine.terminate(BrokenProcessPool("terminate_workers() ended its worker"))

    def _close(self) -> list[Engine]:
        if os.getpid() != self._owner:
            return []  # a copy that came here by a fork: nothing is here to end
        with self._lock:
            self._closed = True
            return self.engines()

    def _check_may_wait(self) -> None:
        for engine in self.engines():
            engine.check_may_wait()


def _close_engines(engines: dict[Resources, Engine]) -> None:
    for engine in engines.values():
        engine.close()


def _close_queues(queues: dict[Engine, CallQueue]) -> None:
    for engine, queue in queues.items():
        engine.calls.close(queue)


def _finish(reference: weakref.ref[Engine]) -> None:
    """The program ends: once its tasks are done, as in concurrent.futures."""
    engine = reference()
    if engine is not None:
        engine.close()
        engine.join()


class _CallFuture(Future[Any]):
    """The future of one call, as an engine sees it: ``work_items.Cancellable``.

    What runs the user's code, unpicklers and callbacks, does not run on the loop's thread.
    """

    def __init__(self, engine: Engine, queue: CallQueue) -> None:
        super().__init__()
        self._engine = engine
        self._queue = queue
        self._claimed: bool | None = None

    def cancel(self) -> bool:
        """As in concurrent.futures, but that ``wait`` and ``as_completed`` hear of it at once."""
        if not super().cancel():
            return False
        self.claim()
        self._engine.calls.drop_cancelled(self._queue)
        return True

    # What the engine says, on the loop's thread

    def claim(self) -> bool:
        """It is about to run, unless it was cancelled."""
        if self._claimed is None:
            with self._condition:  # who cancels may be here as well
                if self._claimed is None:
                    self._claimed = self.set_running_or_notify_cancel()
        return bool(self._claimed)

    def add_results(self, start: int, outcomes: list[Any], mixed: bool, size: int = 0) -> bool:
        """Take the outcome."""
        outcome = outcomes[0]
        if type(outcome) is Pickled:
            self._elsewhere(partial(self._unpickle, outcome))
        elif type(outcome) is Failure:
            self.set_exception(outcome.error)
        else:
            self.set_result(outcome)
        return False

    def set_done(self) -> None:
        """It was with its outcome."""

    def has_room(self) -> bool:
        """Always: whoever wants it wants all of it."""
        return True

    def lift_bound(self) -> None:
        """There is none."""

    def set_exception(self, exception: BaseException | None) -> None:
        """There will be no outcome, or this is it."""
        if self.claim() and exception is not None:
            super().set_exception(_translated(exception, self._engine))

    def _unpickle(self, outcome: Pickled) -> None:
        try:
            value = outcome.decode()
        except BaseException as error:  # whatever the user's unpickler raises
            value = Failure(error)
        if type(value) is Failure:
            self.set_exception(value.error)
        else:
            self.set_result(value)

    def _invoke_callbacks(self) -> None:
        call = super()._invoke_callbacks  # type: ignore[misc]
        if self._done_callbacks and self._engine.on_loop():  # type: ignore[attr-defined]
            self._elsewhere(call)
        else:
            call()

    def _elsewhere(self, action: Callable[[], None]) -> None:
        with contextlib.suppress(RuntimeError):  # the system has no room for its thread
            if self._engine.callbacks.submit(action):
                return
        action()  # else nobody would hear of it


def _taken(
    results: IMapIterator, engine: Engine, item: WorkItem | None, deadline: float | None
) -> Iterator[Any]:
    """The results of a map, up to the first error."""
    try:
        while True:
            left = None if deadline is None else deadline - time.monotonic()
            try:
                outcome = results._take(left)
            except StopIteration:
                return
            except WaitedTooLong:
                raise TimeoutError("the next result of the map was not there in time") from None
            if type(outcome) is Failure:
                raise _translated(outcome.error, engine)
            yield outcome
    finally:
        if item is not None:
            engine.cancel(item)


def _translated(error: BaseException, engine: Engine) -> BaseException:
    """An error of the engine's as concurrent.futures' users know it."""
    if error is engine.error:
        return _broken(error)
    if type(error) is errors.WorkerDied:
        died = errors._rebuild(WorkerDied, error.args)
        vars(died).update(vars(error))
        return died
    return error


def _broken(error: BaseException) -> BrokenProcessPool:
    broken = BrokenProcessPool(f"the executor is broken: {error}")
    broken.__cause__ = error
    return broken


def _worker_count(number: int | None) -> int:
    if number is None:
        return cpu.cpu_count()
    count = options.whole("max_workers", number)
    if count < 1:
        raise ValueError(f"max_workers must be greater than 0, not {count}")
    return count


def _max_tasks(number: int | None) -> int | None:
    if number is None:
        return None
    count = options.whole("max_tasks_per_child", number)
    if count < 1:
        raise ValueError(f"max_tasks_per_child must be >= 1, not {count}")
    return count
