"""joblib's parallel loops on Fiber: importing this registers the backend ``"fiber"``.

::

    import fiber.joblib
    import joblib

    with joblib.parallel_config(backend="fiber", n_jobs=-1):
        search.fit(X, y)  # of scikit-learn, for instance

``parallel_config(backend="fiber", executor=executor)`` uses a ``fiber.Executor`` of yours, with its
options: ``executor.options(memory="4Gi", retries=0)``.  Without, the backend makes one of ``n_jobs``
workers, which leave when nothing was to be done for a minute or the backend is forgotten.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from joblib import register_parallel_backend
from joblib.parallel import AutoBatchingMixin, FallbackToBackend, ParallelBackendBase

from fiber import cpu
from fiber.futures import Executor

__all__ = ["FiberBackend"]


class FiberBackend(AutoBatchingMixin, ParallelBackendBase):  # type: ignore[misc]
    """Runs the tasks of ``joblib.Parallel`` on a ``fiber.Executor``.

    ``n_jobs=-1`` is the number of this machine's processors, or that of the executor's workers.
    Within a task joblib's loops run in threads, as with loky.
    """

    supports_retrieve_callback = True
    supports_inner_max_num_threads = True

    def __init__(
        self,
        *,
        executor: Executor | None = None,
        nesting_level: int | None = None,
        inner_max_num_threads: int | None = None,
    ) -> None:
        if executor is not None and not isinstance(executor, Executor):
            raise TypeError(f"executor must be a fiber.Executor, not {executor!r}")
        if executor is not None and inner_max_num_threads is not None:
            raise ValueError(
                "inner_max_num_threads concerns workers that the backend starts: with executor= "
                "give that one an initializer"
            )
        super().__init__(nesting_level=nesting_level, inner_max_num_threads=inner_max_num_threads)
        self._given = executor
        self._executor = executor
        self._n_jobs = 0
        self._unfinished: set[Future[Any]] = set()

    # What joblib asks for

    def effective_n_jobs(self, n_jobs: int | None) -> int:
        """How many tasks run at a time."""
        if n_jobs == 0:
            raise ValueError("n_jobs == 0 in Parallel has no meaning")
        if n_jobs is None:
            return 1
        if n_jobs > 0:
            return n_jobs
        workers = cpu.cpu_count() if self._given is None else self._given._max_workers
        return max(workers + 1 + n_jobs, 1)

    def configure(self, n_jobs: int = 1, parallel: Any = None, **_: Any) -> int:
        """Be ready for one more loop."""
        n_jobs = self.effective_n_jobs(n_jobs)
        self.parallel = parallel
        if self._given is None:
            if n_jobs == 1:
                raise FallbackToBackend(SequentialBackend(nesting_level=self.nesting_level))
            self._have_own(n_jobs)
        return n_jobs

    def submit(self, func: Callable[[], Any], callback: Any = None) -> Future[Any]:
        """Have a batch of tasks run, and ``callback`` called with its future then."""
        assert self._executor is not None
        future = self._executor.submit(func)
        self._unfinished.add(future)
        future.add_done_callback(self._unfinished.discard)
        if callback is not None:
            future.add_done_callback(callback)
        return future

    apply_async = submit
    """Before joblib 1.5."""

    def retrieve_result_callback(self, out: Future[Any]) -> Any:
        """What became of a batch."""
        return out.result()

    def abort_everything(self, ensure_ready: bool = True) -> None:
        """The loop has failed: what has not begun is cancelled, what runs in own workers ended."""
        for future in tuple(self._unfinished):
            future.cancel()
        if self._given is None and self._executor is not None:
            self._executor.terminate_workers()
            self._executor = None
            if ensure_ready:
                self._have_own(self._n_jobs)

    def terminate(self) -> None:
        """The loop is over; the workers stay for the next one."""
        self.reset_batch_stats()

    def _have_own(self, n_jobs: int) -> None:
        if self._executor is not None and self._n_jobs != n_jobs:
            self._executor.shutdown(wait=False)
            self._executor = None
        if self._executor is None:
            variables = self._prepare_worker_env(n_jobs)
            self._executor = Executor(n_jobs, initializer=limit_threads, initargs=(variables,))
            self._n_jobs = n_jobs


def limit_threads(variables: dict[str, str]) -> None:
    """In a worker: leave its neighbours their processors; ``variables`` are joblib's."""
    os.environ.update(variables)
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        return  # then nothing is loaded that is told otherwise than by its environment
    threadpool_limits(int(variables["OMP_NUM_THREADS"]))


register_parallel_backend("fiber", FiberBackend)
