"""Starting the processes of a pool's workers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from fiber._agent import worker
from fiber._runtime.background import BackgroundThread
from fiber._runtime.host import Loop
from fiber._runtime.options import PoolOptions
from fiber._runtime.worker_handle import WorkerHandle


class Launcher:
    """Starts workers of one pool.

    Not on the loop's thread: the user's initializer and its arguments are pickled for each, and
    agents may need the loop.  ``on_failed`` is called, on the loop's thread, with workers whose
    processes there will never be, and why, if that was tried.
    """

    def __init__(
        self,
        options: PoolOptions,
        loop: Loop,
        background: BackgroundThread,
        *,
        on_failed: Callable[[Sequence[WorkerHandle], Exception | None], None],
    ) -> None:
        self._options = options
        self._loop = loop
        self._background = background
        self._on_failed = on_failed

    def launch(self, handle: WorkerHandle) -> None:
        """Start one now, on the calling thread; raises what stands in the way."""
        options = self._options
        process = options.new_process(
            handle,
            target=worker.run,
            args=(options.initializer, options.initargs, options.retryable),
        )
        process.start()
        handle.process = process
        if handle.leaving:  # it was told to before it could be reached
            self._loop.call_soon(handle.dismiss)
            if handle.unwanted:
                handle.kill()

    def launch_soon(self, handles: Sequence[WorkerHandle]) -> None:
        """Start some on the background thread; called on the loop's."""
        for handle in handles:
            self._background.submit(self._launch, handle)

    def _launch(self, handle: WorkerHandle) -> None:
        error = None
        if not handle.leaving:
            try:
                self.launch(handle)
                return
            except Exception as raised:  # want of descriptors or memory, mostly
                error = raised
        self._loop.call_soon(self._on_failed, (handle,), error)
