"""Starting the processes of a pool's workers, and ending them by force."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from fiber._agent import worker
from fiber._exceptions import fresh
from fiber._runtime.background import BackgroundThread
from fiber._runtime.host import Loop, Timer
from fiber._runtime.latch import Latch
from fiber._runtime.options import PoolOptions
from fiber._runtime.shared_arguments import SharedArguments
from fiber._runtime.worker_handle import WorkerHandle
from fiber._runtime.worker_resources import WorkerResources
from fiber.resources import with_resources

KILL_AFTER = 2.0
"""Seconds between SIGTERM and SIGKILL for workers that are to end at once."""


class Launcher:
    """Starts workers of one pool, and ends them by force.

    Not on the loop's thread: the user's initializer and its arguments are pickled, and agents may
    need the loop.  ``on_failed`` is called, on the loop's thread, with workers whose processes
    there will never be, and why, if that was tried.
    """

    def __init__(
        self,
        options: PoolOptions,
        resources: WorkerResources,
        loop: Loop,
        background: BackgroundThread,
        *,
        on_failed: Callable[[Sequence[WorkerHandle], BaseException | None], None],
    ) -> None:
        self._options = options
        self._arguments = SharedArguments(
            (options.initializer, options.initargs, options.retryable)
        )
        self._resources = resources
        self._loop = loop
        self._background = background
        self._on_failed = on_failed
        self._ending: list[WorkerHandle] = []
        self._kill: Timer | None = None

    def launch_now(self, handles: Sequence[WorkerHandle], timeout: float) -> None:
        """Start some on the calling thread; raises what stands in the way of one."""
        for handle in handles:
            self._start(handle)
        self._raise_start_error(handles, timeout)

    def give_up(self, handles: Sequence[WorkerHandle]) -> None:
        """Starting them was interrupted; on the loop's thread, which knows whose child begins."""
        self._on_failed([handle for handle in handles if handle.child is None], None)

    def _raise_start_error(self, handles: Sequence[WorkerHandle], timeout: float) -> None:
        """Wait until their agent has looked at them: the system may have no room for them."""
        looked_at = Latch()
        self._loop.call_soon(looked_at.set)
        if not self._loop.on_thread():
            looked_at.wait(timeout)
        for handle in handles:
            if handle.child is not None and handle.child.start_error is not None:
                raise fresh(handle.child.start_error)

    def _start(self, handle: WorkerHandle) -> None:
        handle.shared = self._arguments
        process = self._options.new_process(
            handle,
            target=with_resources(worker.run, self._resources.chosen),
            args=self._arguments.args,
        )
        process.start()
        handle.process = process

    def launch_soon(self, handles: Sequence[WorkerHandle]) -> None:
        """Start some on the background thread; called on the loop's."""
        for handle in handles:
            try:
                self._background.submit(self._launch, handle)
            except RuntimeError as error:  # the system has no room for its thread
                self._loop.call_soon(self._on_failed, (handle,), error)

    def end(self, handles: Iterable[Any]) -> None:
        """End these at once, and by force if that is of no use.  On the loop's thread."""
        for handle in handles:
            handle.terminate()
            self._ending.append(handle)
        if self._ending and self._kill is None:
            self._kill = self._loop.call_later(KILL_AFTER, self._kill_all)

    def _kill_all(self) -> None:
        for handle in self._ending:
            handle.kill()

    def close(self) -> None:
        """Cancel timers: the last worker has ended."""
        self._ending.clear()
        if self._kill is not None:
            self._kill.cancel()

    def _launch(self, handle: WorkerHandle) -> None:
        error = None
        if not handle.leaving:
            try:
                self._start(handle)
                return
            except BaseException as raised:  # want of descriptors; or the user's pickler's own
                error = raised
        self._loop.call_soon(self._on_failed, (handle,), error)
