"""joblib's parallel loops on Fiber.  The import of this module registers the backend ``"fiber"``.

::

    import fiber.joblib
    import joblib

    with joblib.parallel_config(backend="fiber", n_jobs=-1):
        search.fit(X, y)  # of scikit-learn, for instance

The backend makes a ``fiber.Executor`` of ``n_jobs`` workers, with the options beside ``backend=``:
``retries=0``, ``initializer=``.  The next loop with the same options uses the same workers.
``executor=`` is an existing executor to use in its place, perhaps with options:
``parallel_config(backend="fiber", executor=executor.options(memory="4Gi"))``.
"""

from __future__ import annotations

import contextlib
import copy
import os
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from inspect import signature
from typing import Any

from fiber import cpu
from fiber._hub import shared_blocks
from fiber._hub.shared_blocks import SharedBuffer
from fiber._installation import explained_if_missing
from fiber._runtime import progress
from fiber._runtime.progress_views import MapProgress
from fiber._runtime.state import runtime
from fiber.futures import Executor

with explained_if_missing("fiber.joblib"):
    import numpy as np
    from joblib import register_parallel_backend
    from joblib._memmapping_reducer import _get_backing_memmap, _reduce_memmap_backed
    from joblib.parallel import (
        AutoBatchingMixin,
        BatchedCalls,
        FallbackToBackend,
        ParallelBackendBase,
        SequentialBackend,
    )

__all__ = ["FiberBackend"]

_OPTIONS = frozenset(signature(Executor).parameters) - {"max_workers"}

_SHARED_ARRAYS = 64
"""Largest number of shared arrays at a time.  Each needs a descriptor."""


class FiberBackend(AutoBatchingMixin, ParallelBackendBase):  # type: ignore[misc]
    """Runs the tasks of ``joblib.Parallel`` on a ``fiber.Executor``.

    ``n_jobs=-1`` is the number of processors, or that of the executor's workers.  Loops within a
    task run in threads, as with loky.
    """

    supports_retrieve_callback = True
    supports_inner_max_num_threads = True

    def __init__(
        self,
        *,
        executor: Executor | None = None,
        nesting_level: int | None = None,
        inner_max_num_threads: int | None = None,
        **options: Any,
    ) -> None:
        if executor is not None and not isinstance(executor, Executor):
            raise TypeError(f"executor must be a fiber.Executor, not {executor!r}")
        if executor is not None and (options or inner_max_num_threads is not None):
            given = [*options, *(["inner_max_num_threads"] if inner_max_num_threads else [])]
            raise ValueError(
                f"executor= has workers already: give {', '.join(given)} to that executor"
            )
        if unknown := options.keys() - _OPTIONS:
            raise TypeError(
                f"the backend fiber has no {', '.join(sorted(unknown))}: expected executor, or "
                f"options of fiber.Executor, {', '.join(sorted(_OPTIONS))}"
            )
        super().__init__(
            nesting_level=nesting_level, inner_max_num_threads=inner_max_num_threads, **options
        )
        self._given = executor
        self._own: _Own | None = None
        self._workers: Executor | None = None
        """Executor of the loops that run."""
        self._arguments: MemmappedArguments | None = None
        self._loops: deque[None] = deque()
        """An entry for each loop that runs: nested generators share one backend."""
        self._unfinished: set[Future[Any]] = set()
        self._progress: LoopProgress | None = None
        """Progress of the loop that is shown.  Loops inside it are not."""

    def effective_n_jobs(self, n_jobs: int | None) -> int:
        """Return the number of tasks that run at a time."""
        if n_jobs == 0:
            raise ValueError("n_jobs == 0 in Parallel has no meaning")
        if n_jobs is None:
            return 1
        if n_jobs > 0:
            return n_jobs
        workers = cpu.cpu_count() if self._given is None else self._given._max_workers
        return max(workers + 1 + n_jobs, 1)

    def configure(self, n_jobs: int = 1, parallel: Any = None, **options: Any) -> int:
        """Prepare for one more loop; return the number of its jobs."""
        n_jobs = self.effective_n_jobs(n_jobs)
        if n_jobs == 1 and self._given is None:
            raise FallbackToBackend(SequentialBackend(nesting_level=self.nesting_level))
        self.parallel = parallel
        own = {key: value for key, value in options.items() if key in _OPTIONS}
        self._workers = self._given or self._start({**self.backend_kwargs, **own}, n_jobs)
        if not self._loops:
            self._arguments = MemmappedArguments(options, same_host=runtime().backend.same_host)
        self._loops.append(None)
        return n_jobs

    def start_call(self) -> None:
        """Show the progress of a loop if the configuration wants it, and ``verbose`` does not."""
        if self._progress is None and progress.is_configured() and not self.parallel.verbose:
            assert self._workers is not None
            self._progress = LoopProgress(self.parallel, self._workers)
            progress.reporter.show(self._progress, self._progress, late=True)

    def stop_call(self) -> None:
        """Show the last progress of a loop."""
        shown, self._progress = self._progress, None
        progress.reporter.finish(shown)

    def submit(self, func: Callable[[], Any], callback: Any = None) -> Future[Any]:
        """Run a batch of tasks; call ``callback`` with its future at the end."""
        future: Future[Any]
        try:
            assert self._workers is not None
            assert self._arguments is not None
            future = self._workers.submit(self._arguments.of(func))
        except Exception as error:  # joblib would print an error from here, and wait for ever
            future = Future()
            future.set_exception(error)
        else:
            self._unfinished.add(future)
            future.add_done_callback(self._unfinished.discard)
        if callback is not None:
            future.add_done_callback(callback)
        return future

    apply_async = submit
    """Name of ``submit`` before joblib 1.5."""

    def retrieve_result_callback(self, out: Future[Any]) -> Any:
        """Return the results of a batch, or raise its error."""
        return out.result()

    def abort_everything(self, ensure_ready: bool = True) -> None:
        """End a failed loop: cancel waiting batches, and end the workers of its executor."""
        for future in tuple(self._unfinished):
            future.cancel()
        own, self._own = self._own, None
        if own is not None:
            own.executor.terminate_workers()
            if ensure_ready:
                self._workers = self._start(own.options, self.parallel.n_jobs)

    def terminate(self) -> None:
        """End a loop.  The workers stay for the next loop, until ``idle_timeout``."""
        self.reset_batch_stats()
        if self._loops:
            self._loops.pop()
        if not self._loops:
            self._workers = None
            if self._arguments is not None:
                self._arguments.close()
            own, self._own = self._own, None
            if own is not None:
                _keep(own)

    def _start(self, options: dict[str, Any], n_jobs: int) -> Executor:
        """Return an executor with these options: the last one, if it has the same."""
        workers = self.effective_n_jobs(n_jobs)
        threads = self._prepare_worker_env(workers)
        wanted = (workers, threads, options, os.getpid())
        if self._own is None or not self._own.was_made_with(wanted):
            self._own = _take(wanted) or _Own(*wanted)
        return self._own.executor


class LoopProgress:
    """Progress of one loop, from the counts of its ``Parallel``.  A ``ProgressSource``."""

    is_over = False
    """``stop_call`` ends it."""

    def __init__(self, parallel: Any, workers: Executor) -> None:
        self._parallel = parallel
        self._workers = workers
        self._began = time.monotonic()

    def look(self) -> MapProgress:
        """Return the progress now."""
        loop = self._parallel
        total = getattr(loop, "n_tasks", None)
        if total is None and getattr(loop, "_original_iterator", None) is None:  # all dispatched
            total = loop.n_dispatched_tasks
        busy = sum(each.workers.busy() for each in self._workers._group.executors())
        seconds = time.monotonic() - self._began
        return MapProgress("joblib", loop.n_completed_tasks, total, 0, 0, busy, seconds)


class _Own:
    """Executor that the backend has made."""

    def __init__(
        self, workers: int, threads: dict[str, str], options: dict[str, Any], process: int
    ) -> None:
        self.options = options
        self._made_with = (workers, threads, options, process)
        then = options.get("initializer"), options.get("initargs", ())
        prepared = {**options, "initializer": _prepare, "initargs": (threads, *then)}
        self.executor = Executor(workers, **prepared)

    def was_made_with(self, wanted: tuple[Any, ...]) -> bool:
        """Tell whether a new executor with these arguments would be the same."""
        try:
            return bool(self._made_with == wanted)
        except Exception:  # arrays among the options cannot be compared
            return False


_kept: deque[_Own] = deque()
"""Executor of the last loop, kept for the next: starting workers often takes longer than a loop."""


def _take(wanted: tuple[Any, ...]) -> _Own | None:
    with contextlib.suppress(IndexError):  # there is none
        own = _kept.pop()
        if own.was_made_with(wanted):
            return own
        own.executor.shutdown(wait=False)
    return None


def _keep(own: _Own) -> None:
    _kept.append(own)
    while len(_kept) > 1:
        _kept.popleft().executor.shutdown(wait=False)


def _prepare(
    threads: dict[str, str], initializer: Callable[..., object] | None, initargs: Iterable[Any]
) -> None:
    """Limit the threads of this worker to its share; ``threads`` are joblib's variables."""
    os.environ.update(threads)
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        pass  # libraries that are imported later read the variables
    else:
        threadpool_limits(int(threads["OMP_NUM_THREADS"]))
    if initializer is not None:
        initializer(*initargs)


class MemmappedArguments:
    """Large arrays among the arguments of one loop, or of nested loops.

    Workers of this host map them, as loky's do.  The first time an array is pickled, since that is
    faster than sharing it.  An array that is sent again, such as the data of a grid search, is
    copied to shared memory once.  A worker of another host gets a copy with each task.

    ``options`` are ``joblib.Parallel``'s ``max_nbytes`` and ``mmap_mode``.  An array above
    ``max_nbytes`` bytes is large.  Tasks get it in the mode ``mmap_mode``: "r" is read-only.
    Arrays inside of an argument, such as a list or a table, are pickled.
    """

    def __init__(self, options: Mapping[str, Any], *, same_host: bool) -> None:
        self._max_nbytes: int | None = options.get("max_nbytes")
        self._mode: str | None = options.get("mmap_mode")
        self._same_host = same_host
        self._sent: dict[int, weakref.ref[Any]] = {}
        self._shared: dict[int, SharedBuffer] = {}

    def of(self, batch: Any) -> Any:
        """Return the batch in the form to pickle, at once, and send."""
        if not isinstance(batch, BatchedCalls):
            return batch
        sent = copy.copy(batch)
        sent.items = [
            (func, tuple(map(self._one, args)), {key: self._one(kwargs[key]) for key in kwargs})
            for func, args, kwargs in batch.items
        ]
        return sent

    def close(self) -> None:
        """Drop the shared arrays.  Processes that map them keep them."""
        self._sent.clear()
        self._shared.clear()

    def _one(self, value: Any) -> Any:
        if type(value) not in (np.ndarray, np.memmap) or value.dtype.hasobject:
            return value
        mapped = _get_backing_memmap(value) if self._same_host else None
        if isinstance(mapped, np.memmap):  # not anonymous memory
            return _Reduced(*_reduce_memmap_backed(value, mapped))
        if self._max_nbytes is None or self._mode is None or value.nbytes <= self._max_nbytes:
            return value
        buffer = self._buffer(value) if self._same_host else None
        if buffer is None:
            return _Reduced(_read_only, (value,)) if self._mode == "r" else value
        order = "F" if value.flags.fnc else "C"
        return _Reduced(_array, (buffer, value.dtype, value.shape, order, self._mode))

    def _buffer(self, array: Any) -> SharedBuffer | None:
        """Return shared memory with a copy of the array; None if it should be pickled."""
        number = id(array)
        again = number in self._sent
        if number in self._shared:
            return self._shared[number]
        if not again:
            self._sent[number] = weakref.ref(array, lambda _: self._forget(number))
        if not (again or self._mode in ("r+", "w+")) or len(self._shared) >= _SHARED_ARRAYS:
            return None
        buffer = shared_blocks.create_buffer(array.nbytes)
        order = "F" if array.flags.fnc else "C"
        _array(buffer, array.dtype, array.shape, order, "w+")[...] = array
        return self._shared.setdefault(number, buffer)

    def _forget(self, number: int) -> None:
        self._sent.pop(number, None)
        self._shared.pop(number, None)


class _Reduced:
    """Stand-in that unpickles to the object that its arguments describe."""

    def __init__(self, *reduction: Any) -> None:
        self._reduction = reduction

    def __reduce__(self) -> tuple[Any, ...]:
        return self._reduction


def _array(buffer: SharedBuffer, dtype: Any, shape: tuple[int, ...], order: Any, mode: str) -> Any:
    array = np.ndarray(shape, dtype, buffer.view, order=order)
    if mode == "c":  # copy on write: each task gets a copy
        return array.copy(order)
    return _read_only(array) if mode == "r" else array


def _read_only(array: Any) -> Any:
    array.flags.writeable = False
    return array


register_parallel_backend("fiber", FiberBackend)
