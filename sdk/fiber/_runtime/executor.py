"""Executor of a pool: does what the pool's scheduler decides, and reports events to it.

::

    any thread           loop thread                                           worker
    call, submit, … ───► Jobs ──► Scheduler.decide ──► _act ──► BatchSender ──► run
                          ▲                                       │ ▲            │
                          │                  background thread ◄──┘ │            │
                          │                  (the user's picklers) ─┘            │
                          └─────────── on_message ◄──────────────────────────────┘
                          │
                          └──► TaskFuture.add_results, set_done

The state changes on the loop thread alone, one event at a time, so no lock guards it.  A request
may come from any thread, finalizer or signal handler.  It goes into the loop's queue, and wakes the
loop.  So an interrupted caller leaves no state half changed, and requests cannot deadlock.

The loop thread never runs the user's code.  If pickling a batch may run some, the batch goes to the
background thread.  If unpickling a value may run some, the value stays ``Pickled``.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol

from fiber import _logs
from fiber._agent.interface import UNKNOWN, Cause, ExitReport
from fiber._engine.scheduler import Decisions, Scheduler
from fiber._engine.start_failures import StartFailure
from fiber._exceptions import fresh
from fiber._runtime.answers import TaskFailure, decode
from fiber._runtime.exchange import AnswerReceiver, BatchSender
from fiber._runtime.jobs import TICK, CallQueue, Calls, Jobs
from fiber._runtime.leases import ADOPTED, UNAVAILABLE, LeasedWorker, Leases
from fiber._runtime.options import PoolOptions
from fiber._runtime.pool_activity import PoolActivity
from fiber._runtime.pool_state import PoolState, pool_state
from fiber._runtime.state import Runtime
from fiber._runtime.threads import BackgroundThread, Latch, UserThreads, say
from fiber._runtime.work_items import (
    Call,
    Function,
    FunctionCache,
    InputStream,
    TaskFuture,
    WorkItem,
    pickle_call,
)
from fiber._runtime.workers import Launcher, WorkerHandle, WorkerResources, WorkerView
from fiber._transport.loop import LoopTimer
from fiber._wire import work
from fiber._wire.packet import Message
from fiber.errors import FiberError


class Waitable(TaskFuture, Protocol):
    """Future that a thread can wait for."""

    def get(self) -> Any:
        """Wait for the result and return it, or raise the exception of the call."""


class PoolExecutor:
    """Working half of a pool.  It goes on if the user drops the ``Pool`` while tasks run."""

    def __init__(
        self,
        options: PoolOptions,
        runtime: Runtime,
        *,
        thread: Callable[[str], BackgroundThread] = BackgroundThread,
    ) -> None:
        self.options = options
        self.threads = UserThreads(thread)
        self.ended = Latch()
        """Set when the last worker has ended."""
        self._runtime = runtime
        self._elastic = runtime.elastic
        self._loop = runtime.loop
        self._background = self.threads.pickling
        self._scheduler = Scheduler(
            options.minimum,
            options.maximum,
            max_tasks=options.max_tasks,
            idle_timeout=options.idle_timeout,
        )
        self._ledger = self._scheduler.ledger
        self.workers = WorkerView(self._scheduler.workers, runtime.loop)
        self._activity = PoolActivity(runtime.activity, runtime.loop)
        retry = bool(options.retryable)
        self._jobs = Jobs(self._ledger, options.limits, self._activity, retry=retry)
        self._sender = BatchSender(
            self._loop,
            self._background,
            self._scheduler,
            self._jobs,
            self._activity,
            advance=self._advance,
        )
        self._resources = WorkerResources(options.resources)
        self._launcher = Launcher(
            options, self._resources, runtime, self._background, on_failed=self._never_started
        )
        self._leases = Leases(
            self._scheduler, self._loop, self._activity, on_adopted=self._adopt, on_back=self._back
        )
        self._receiver = AnswerReceiver(
            self._loop,
            self._background,
            self._scheduler,
            self._jobs,
            self._sender,
            self._leases,
            self._activity,
            advance=self._advance,
            on_ready=self._ready,
        )
        self._leases_workers = options.max_tasks is None and not options.retryable
        self._cache = FunctionCache(runtime.backend.passes_on, options.maximum)
        self.calls = Calls(
            self._loop,
            self._scheduler,
            self._jobs,
            refusal=self._refusal,
            advance=self._advance,
        )
        """Queues of single calls."""
        self._wake: LoopTimer | None = None
        self._ended_by: BaseException | None = None
        """Error of calls that are not done when the pool is terminated."""
        self._acting = False
        self._again = False

    # Requests, on any thread

    def start(self) -> None:
        """Start the first workers; raise the error if one cannot be started.

        Where hosts are made for workers, they start with the first task instead.
        """
        try:
            if self.options.calls_back_at_end:  # after the program's end no thread starts
                self.threads.start()
            self._loop.depend(self)
            self._loop.call_soon(self._runtime.pools.add, self)
        except BaseException:
            self._end()
            raise
        if self._elastic:
            self._runtime.look_at_program()
            return  # the first task chooses their resources, and starts them
        handles = self._launcher.make(self, self.options.minimum)
        try:
            self._loop.call_soon(self._begin, handles)
            self._runtime.look_at_program()
            self._launcher.launch_now(handles, self._runtime.config.start_timeout)
        except BaseException as error:
            self._loop.call_soon(self._launcher.give_up, handles)
            self.terminate(error)
            raise

    def start_workers(self) -> None:
        """Start the first workers now, where the first task would start them."""
        self._loop.call_soon(self._advance)

    def choose_resources(self, function: Callable[..., Any]) -> None:
        """Choose the workers' resources by this function, if Fiber makes hosts for the workers.

        ValueError if workers with other resources were chosen before.
        """
        if self._elastic:
            self._resources.choose_for(function)

    def call(
        self,
        future: TaskFuture,
        function: Callable[..., Any],
        args: Iterable[Any],
        kwargs: Mapping[str, Any],
        timeout: float | None = None,
        queue: CallQueue | None = None,
    ) -> None:
        """Submit a call.  The calls of a ``queue`` share options; ``timeout`` is for this one."""
        call = pickle_call(self._cache, future, function, args, kwargs, self.reject)
        if call is None:
            return
        self._check()
        call.copy_buffers()
        self._enqueue(call, timeout, queue)

    def call_and_wait(
        self,
        future: Waitable,
        function: Callable[..., Any],
        args: Iterable[Any],
        kwargs: Mapping[str, Any],
        timeout: float | None = None,
    ) -> Any:
        """Submit a call and wait for it; return its result or raise its exception."""
        direct = timeout is None and self._leases_workers
        call = pickle_call(self._cache, future, function, args, kwargs, self.reject, direct)
        if call is None:
            return future.get()
        self._check()
        outcome = self._leases.run(call) if direct else UNAVAILABLE
        if outcome is UNAVAILABLE:
            self._enqueue(call, timeout)
        elif outcome is not ADOPTED:
            outcome = decode(outcome)
            if type(outcome) is TaskFailure:
                raise fresh(outcome.error)
            return outcome
        return future.get()

    def _enqueue(self, call: Call, timeout: float | None, queue: CallQueue | None = None) -> None:
        if timeout is None:
            self.calls.put(call, queue)
        else:
            item = WorkItem(work.CALLS, timeout=timeout)
            self._loop.call_soon(self._take, item, (call,))

    def broadcast(
        self, future: TaskFuture, function: Callable[..., Any], args: Sequence[Any]
    ) -> None:
        """Submit a call to every worker, ready or starting; ``future`` gets an outcome of each."""
        call = pickle_call(self._cache, future, function, args, {}, self.reject)
        if call is not None:
            self._check()
            self._cache.share(call.buffers)
            self._loop.call_soon(self._broadcast, WorkItem(work.CALLS, future=future), call)

    def reject(self, future: TaskFuture, error: BaseException) -> None:
        """Fail ``future``, whose call cannot begin.  The loop thread sets it, as always."""
        self._check()
        self._loop.call_soon(future.set_exception, error)

    def function(self, function: Callable[..., Any]) -> Function:
        """Return ``function``, pickled.  Equal pickles are the same Function."""
        return self._cache.get(function)

    def submit(self, item: WorkItem, tasks: Sequence[Any]) -> None:
        """Run all of ``tasks``.  The sequence must not change until they are done."""
        self._check()
        self._loop.call_soon(self._take, item, tasks)

    def open_stream(
        self, item: WorkItem, limit: int | None = None, consumed: Callable[[], int] = lambda: 0
    ) -> InputStream:
        """Run the tasks that the stream will read; the caller ends it by ``finish`` or ``cancel``.

        ``limit``: largest number of tasks that are read and not ``consumed``.
        """
        self._check()
        loop = self._loop
        stream = InputStream(item.unit, lambda: loop.call_soon(self._refill, item), limit, consumed)
        item.stream = stream
        loop.call_soon(self._take, item, None)
        return stream

    def read(self, item: WorkItem, iterable: Iterable[Any]) -> None:
        """Read the input of an item's stream on a new thread, and finish the stream."""
        self._loop.call_soon(self._start_reading, item, iterable)

    def finish(self, item: WorkItem, error: BaseException | None = None) -> None:
        """End the stream of ``item``.  An ``error`` takes the place of the next task."""
        self._loop.call_soon(self._finish, item, error)

    def cancel(self, item: WorkItem) -> None:
        """Drop the tasks of ``item`` that have not begun.  Running tasks go on.

        Do nothing if the item was never submitted, or is done.
        """
        self._loop.call_soon(self._cancel, item)

    def resume(self, item: WorkItem) -> None:
        """Run further tasks of ``item``: its results are read again after a pause."""
        self._loop.call_soon(self._resume, item)

    def cancel_all(self, error: BaseException) -> None:
        """Drop all tasks that have not begun: cancel calls, and end maps with ``error``."""
        self._loop.call_soon(self._cancel_all, error)

    def close(self) -> None:
        """Take no more requests.  The workers end once the present requests are done."""
        self._loop.call_soon(self._close)

    def terminate(self, error: BaseException) -> None:
        """End the workers now.  Callers that wait for a result get ``error``."""
        self._loop.call_soon(self._terminate, error)

    def join(self) -> None:
        """Wait until all workers and threads have ended.  Call ``close`` or ``terminate`` first."""
        self._loop.call_soon(self._lift_limits)
        self.ended.wait()
        self.threads.join()

    def on_loop(self) -> bool:
        """Tell whether the caller runs on the loop thread, which must not wait."""
        return self._loop.on_thread()

    @property
    def error(self) -> BaseException | None:
        """Error that keeps workers from starting, once the pool has given up; None before."""
        return self._scheduler.workers.error

    def _check(self) -> None:
        """Raise the error at once if no worker will run a new request."""
        error = self._refusal()
        if error is not None:
            raise fresh(error)

    def wait_until_up(self, timeout: float | None) -> bool:
        """Wait for the first workers; return False after ``timeout`` seconds.

        Raise the error if workers cannot start.
        """
        self.start_workers()
        up = self.workers.wait_until_up(timeout)
        self._check()
        return up

    def _refusal(self) -> BaseException | None:
        if self.error is not None:
            return self.error
        return self.options.refusal() if self._scheduler.closing else None

    # Requests, on the loop thread.  All that follows runs there.

    def _take(self, item: WorkItem, tasks: Sequence[Any] | None) -> None:
        """Take a map, a call with a time limit, or a stream, for which ``tasks`` is None."""
        refusal = self._refusal()
        if refusal is not None:
            if item.stream is not None:
                item.stream.end()
            future = item.future or (tasks or ())[0].future
            future.set_exception(refusal)
        elif tasks is None:
            self._jobs.open_stream(item)
        else:
            self._jobs.run(item, tasks)
        self._advance()

    def _broadcast(self, item: WorkItem, call: Call) -> None:
        refusal = self._refusal()
        if refusal is None:
            self._scheduler.pin_everywhere(self._jobs.open(item), call)
            self._jobs.close(item)
        elif item.future is not None:
            item.future.set_exception(refusal)
        self._advance()

    def _refill(self, item: WorkItem) -> None:
        """Feed the tasks that a stream has read, and let it read on."""
        self._jobs.top_up(item)
        self._advance()

    def _start_reading(self, item: WorkItem, iterable: Iterable[Any]) -> None:
        # On the loop thread: a signal handler that raises in Thread.start() would break the start.
        if item.stream is not None:
            item.stream.read_on_thread(iterable, partial(self.finish, item))

    def _finish(self, item: WorkItem, error: BaseException | None) -> None:
        self._jobs.end_stream(item, error)
        self._advance()

    def _cancel(self, item: WorkItem) -> None:
        for held in self._jobs.cancel(item):
            held.key.child.recall()
        self._advance()

    def _cancel_all(self, error: BaseException) -> None:
        self.calls.cancel_all()
        for job in list(self._ledger.jobs):
            if job.owner.future is not None:
                self._jobs.fail(job, error)
        self._advance()

    def _resume(self, item: WorkItem) -> None:
        self._jobs.resume(item)
        self._advance()

    def _lift_limits(self) -> None:
        self._jobs.lift_limits()
        self._advance()

    def describe(self) -> PoolState:
        """Return the state of the pool, for monitors."""
        done_before = self._activity.done_before
        return pool_state(self._ledger, self._scheduler.workers, done_before, self._loop.now())

    # Decisions

    def _advance(self) -> None:
        """Have the scheduler decide, and do what it says, until no decision follows."""
        if self._acting:
            self._again = True
            return
        self._acting = True
        try:
            while True:
                self._again = False
                if self._scheduler.needs_leased():
                    self._leases.recall()
                self._act(self._scheduler.decide(self._loop.now()))
                if not self._again:
                    return
        finally:
            self._acting = False

    def _act(self, decisions: Decisions) -> None:
        for job, error in decisions.failed:
            self._jobs.fail(job, error)
        handle: Any
        self._launcher.end(decisions.end)
        for held in decisions.recall:
            held.key.child.recall()
        for handle in decisions.dismiss:
            handle.dismiss()
        if decisions.start:
            self._start_workers(decisions.start)
        for batch in decisions.assign:
            if batch.job is not None:
                self._sender.send(batch)
            else:  # its job failed just now
                self._ledger.put_back(batch.worker, (batch.seq,), self._loop.now())
                self._again = True
        given = (batch.job.owner for batch in decisions.assign if batch.job is not None)
        self._again |= self._jobs.top_up_all(given)
        if decisions.wake_at < math.inf:
            self._wake_at(decisions.wake_at)
        if decisions.over:
            self._end()

    def _wake_at(self, due: float) -> None:
        """Decide again at ``due`` at the latest."""
        if self._wake is not None:
            if self._wake.due <= due:
                return
            self._wake.cancel()
        delay = max(due - self._loop.now(), TICK)
        self._wake = self._loop.call_later(delay, self._time_has_come)

    def _time_has_come(self) -> None:
        self._wake = None
        self._advance()

    # Packets of workers

    def on_message(self, handle: WorkerHandle, message: Message) -> None:
        """Take a packet from a worker."""
        self._receiver.take(handle, message)

    def on_recalled(self, handle: WorkerHandle, seqs: list[int]) -> None:
        """Queue the tasks of these batches again: the worker will never read the batches."""
        self._receiver.recalled(handle, seqs)

    def _adopt(self, leased: LeasedWorker, call: Call) -> None:
        """Take over a call that its caller sent to a worker: its answer comes through the loop."""
        handle = leased.handle
        item = WorkItem(work.CALLS, eager=True)
        job = self._jobs.open(item)
        assert handle.worker is not None
        self._scheduler.return_busy(handle.worker, leased.seq, job, call, self._loop.now())
        self._jobs.close(item)
        if self._ended_by is not None:
            self._jobs.fail(job, self._ended_by)
        self._receiver.replay(leased)

    def _back(self, leased: LeasedWorker) -> None:
        """Take back a leased worker, and handle what happened to it during the lease."""
        if leased.report is not None:
            self.on_exit(leased.handle, leased.report)
        elif leased.draining:
            self.on_draining(leased.handle)
        else:
            self._advance()

    # Workers come and go

    def _start_workers(self, count: int) -> None:
        handles = self._launcher.make(self, count)
        self._begin(handles)
        self._launcher.launch_soon(handles)

    def _begin(self, handles: list[WorkerHandle]) -> None:
        for handle in handles:
            self._scheduler.starting(handle)

    def _never_started(self, handles: Iterable[WorkerHandle], error: BaseException | None) -> None:
        """Remove workers that have no process; ``error`` says why, if a start was tried."""
        failure = None
        if error is not None:
            failure = StartFailure("a pool worker", str(error), killed=True, cause=error)
        for handle in handles:
            self._lost(handle, failure)
        self._advance()

    def _ready(self, handle: WorkerHandle) -> None:
        """Give tasks to a worker that is initialized."""
        _logs.debug("worker %s is ready", handle.name)
        self._activity.ready(handle)
        self._scheduler.ready(handle, self._loop.now())
        self.workers.changed()
        self._advance()

    def on_draining(self, handle: WorkerHandle) -> None:
        """Replace a worker whose host is about to end; its unread tasks run elsewhere."""
        if not self._leases.keep_draining(handle) and self._scheduler.drain(handle):
            _logs.debug("worker %s is drained", handle.name)
            if handle.child is not None:
                handle.child.recall()
            handle.dismiss()
            self.workers.changed()
        self._advance()

    def on_exit(self, handle: WorkerHandle, report: ExitReport) -> None:
        """Remove a worker that has ended, asked or not."""
        if self._leases.keep_exit(handle, report):
            return  # ``_back`` handles it when the caller returns the worker
        self._sender.exited(handle, report.stack)
        # The loss of a host is no failure of the worker.
        lost_host = report.disrupted or report.cause == Cause.AGENT_LOST
        failure = None if lost_host else handle.start_failure(report)
        self._lost(handle, failure, report)
        self._advance()

    def _lost(
        self, handle: WorkerHandle, failure: StartFailure | None, report: ExitReport | None = None
    ) -> None:
        now = self._loop.now()
        unread: set[int] = set()
        running = None
        disrupted = report is not None and report.disrupted
        if handle.worker is not None:
            unread = self._sender.lost(handle.worker)
        if report is not None:
            unread.update(report.unread)
            running = report.running
            if running is not None:
                unread.discard(running[0])
        with self._activity.losing(handle, handle.worker):
            losses = self._scheduler.gone(
                handle, now, unread=unread, running=running, disrupted=disrupted, failure=failure
            )
        self.workers.changed()
        if report is not None:
            self._jobs.put_losses(losses, handle.name, handle.pid, report)
        if failure is not None and (news := self._scheduler.workers.news(failure, now)):
            with contextlib.suppress(RuntimeError):  # the system has no room for its thread
                self._background.submit(say, news)

    # The end

    def _close(self) -> None:
        self.calls.close_all()
        if self.options.closes_streams:
            self._jobs.close_streams()
        self._scheduler.close()
        self._advance()

    def _terminate(self, error: BaseException) -> None:
        self.calls.take_all()
        self._ended_by = error
        if not self.options.calls_back_at_end:
            self.threads.callbacks.stop()
        for job in list(self._ledger.jobs):
            self._jobs.fail(job, error)
        self._launcher.end(self._scheduler.terminate())
        self._advance()

    def broken(self, error: FiberError) -> None:
        """End all: the loop has failed, so no event of the workers will arrive."""
        handles: list[Any] = list(self._scheduler.workers.members)
        self._scheduler.workers.give_up(error)
        self._terminate(error)
        for handle in handles:
            handle.kill()
            handle.exited(ExitReport(UNKNOWN, str(error)))

    def _end(self) -> None:
        """Finish: the last worker has ended."""
        if self.ended.is_set():
            return
        self._runtime.pools.discard(self)
        if self._wake is not None:
            self._wake.cancel()
        self._launcher.close()
        self._sender.close()
        self._leases.close()
        self.threads.stop()
        # Its traceback may hold the pool, whose finalizer holds this.
        self._ended_by = None
        self.workers.end()
        self.ended.set()
