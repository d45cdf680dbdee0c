"""Executors behind one ``fiber.Executor``: one for each kind of worker that its tasks need."""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import util
from multiprocessing.process import BaseProcess
from typing import Any

from fiber._runtime import start_methods
from fiber._runtime.executor import PoolExecutor
from fiber._runtime.options import PoolOptions
from fiber._runtime.state import Runtime
from fiber.resources import Resources, merged, resources_of

_EXIT_PRIORITY = 20
"""Priority above that of pools, which its tasks may use: it ends first."""


class ExecutorGroup:
    """Group of executors that start as tasks come, and end together.

    Where hosts are made for workers, tasks with different wishes have different executors.
    Elsewhere there is one executor.
    """

    def __init__(self, template: PoolOptions, runtime: Runtime) -> None:
        self._template = template
        self._runtime = runtime
        self._owner = os.getpid()
        self._executors: dict[Resources, PoolExecutor] = {}
        self._lock = threading.RLock()  # a finalizer may start an executor while one is started
        self._closed = False
        # If the user drops the group while tasks run, it ends after these tasks.
        util.Finalize(self, _close_all, args=(self._executors,))

    def executor_for(self, function: Callable[..., Any], wishes: Resources) -> PoolExecutor:
        """Return the executor for ``function``; raise an error after shutdown."""
        if os.getpid() != self._owner:
            raise RuntimeError(
                f"this executor belongs to process {self._owner}: its copy in a forked process has "
                "no workers. Make an executor in this process"
            )
        if self._closed:
            raise refusal()
        if util.is_exiting():
            raise RuntimeError("cannot schedule new futures after interpreter shutdown")
        kind = self._template.resources
        if self._runtime.elastic:
            kind = merged(kind, merged(resources_of(function), wishes))
        executor = self._executors.get(kind) or self._start(kind)
        if executor.error is not None:
            raise broken(executor.error)
        return executor

    def _start(self, kind: Resources) -> PoolExecutor:
        start_methods.check_main()
        with self._lock:
            if self._closed:  # by another thread, just now
                raise refusal()
            executor = self._executors.get(kind)
            if executor is None:
                executor = PoolExecutor(self._template._replace(resources=kind), self._runtime)
                reference = weakref.ref(executor)
                util.Finalize(executor, _finish, (reference,), exitpriority=_EXIT_PRIORITY)
                try:
                    executor.start()
                    self._executors[kind] = executor
                finally:
                    if kind not in self._executors:  # interrupted: the group does not know it
                        executor.close()
            return executor

    def executors(self) -> list[PoolExecutor]:
        """Return the present executors."""
        return list(self._executors.values())

    def processes(self) -> list[BaseProcess]:
        """Return the processes of all workers but those that were asked to end."""
        views = [each.workers for each in self.executors()]
        return [process for view in views for process in view.processes(leaving=False)]

    def shut_down(self, wait: bool, cancel: bool) -> None:
        """Take no more tasks; ``cancel`` those that have not begun, ``wait`` for the rest."""
        for executor in self._close():
            if cancel:
                executor.cancel_all(CancelledError())
            executor.close()
        if wait:
            self._check_may_wait()
            for executor in self._close():
                executor.join()

    def terminate(self) -> None:
        """End the workers at once.  Callers that wait for a result get BrokenProcessPool."""
        for executor in self._close():
            executor.terminate(BrokenProcessPool("terminate_workers() ended its worker"))

    def _close(self) -> list[PoolExecutor]:
        if os.getpid() != self._owner:
            return []  # a copy from a fork has no workers
        with self._lock:
            self._closed = True
            return self.executors()

    def _check_may_wait(self) -> None:
        for executor in self.executors():
            executor.threads.check_may_wait()


def _close_all(executors: dict[Resources, PoolExecutor]) -> None:
    for executor in executors.values():
        executor.close()


def _finish(reference: weakref.ref[PoolExecutor]) -> None:
    """Wait for the tasks when the program ends, as concurrent.futures does."""
    executor = reference()
    if executor is not None:
        executor.close()
        executor.join()


def refusal() -> RuntimeError:
    """Return the error of concurrent.futures for a call after ``shutdown``."""
    return RuntimeError("cannot schedule new futures after shutdown")


def broken(error: BaseException) -> BrokenProcessPool:
    """Return the exception of calls that no worker will run, because of ``error``."""
    raised = BrokenProcessPool(f"the executor is broken: {error}")
    raised.__cause__ = error
    return raised
