"""The future of one call, as concurrent.futures has it, and the errors that its users know."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator
from concurrent.futures import Future
from concurrent.futures._base import CANCELLED, CANCELLED_AND_NOTIFIED, FINISHED, RUNNING
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from typing import Any, TypeVar

from fiber import errors
from fiber._exceptions import fresh, report_uncaught
from fiber._runtime.background import BackgroundThread
from fiber._runtime.calls import CallQueue
from fiber._runtime.executor import Executor
from fiber._runtime.outcome import Failure, Pickled

_T = TypeVar("_T")


class WorkerDied(errors.WorkerDied, BrokenProcessPool):
    """``fiber.WorkerDied``, and what concurrent.futures raises then.

    It concerns this task alone: the executor goes on with another worker.
    """


WorkerDied.__module__ = "fiber.futures"  # where its users have it from


class CallFuture(Future[_T]):
    """The future of one call, as an executor sees it: ``work_items.Cancellable``.

    What runs the user's code, unpicklers and callbacks, does not run on the loop's thread.
    """

    def __init__(self, executor: Executor, queue: CallQueue) -> None:
        super().__init__()
        self._executor = executor
        self._threads = executor.threads
        self._queue = queue
        self._undecided = bytearray(1)  # which the collector has no work with
        """Token of a decision.  The side that takes it out runs the call, or cancels it."""
        self._claimed: bool | None = None

    def __await__(self) -> Generator[Any, None, _T]:
        """Await the result.  A task that is cancelled meanwhile cancels the call."""
        import asyncio  # who awaits has it already, and it takes long to import

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

    # What the executor says, on the loop's thread

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
        super().cancel()  # whoever did may have been interrupted
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
        if type(outcome) is Failure:
            self.set_exception(outcome.error)
        else:
            self._locked(partial(self.set_result, outcome))

    def _unpickle(self, outcome: Pickled) -> None:
        try:
            value = outcome.decode()
        except BaseException as error:  # whatever the user's unpickler raises
            value = Failure(error)
        self._settle(value)

    def _locked(self, action: Callable[[], object]) -> None:
        """Do what takes the lock that the program's threads take, too.

        The loop does not wait for it: one who was interrupted between taking it and the ``with``
        block has it for as long as it likes.
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
        except BaseException:  # of a callback that exits: the loop has to go on
            report_uncaught()


def translated(error: BaseException, executor: Executor) -> BaseException:
    """An error of the executor's as concurrent.futures' users know it."""
    if error is executor.error:
        return broken(error)
    if type(error) is errors.WorkerDied:
        died = errors._rebuild(WorkerDied, error.args)
        vars(died).update(vars(error))
        return died
    return error


def broken(error: BaseException) -> BrokenProcessPool:
    """Return the exception of calls that no worker will run, because of ``error``."""
    raised = BrokenProcessPool(f"the executor is broken: {error}")
    raised.__cause__ = error
    return raised
