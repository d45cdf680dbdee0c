"""Workers of a pool: their processes, how these start and end, and what users see of them."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterable, Sequence
from multiprocessing import process as mp_process
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple, Protocol

from fiber import _logs
from fiber._agent import worker
from fiber._agent.interface import Cause, ChildHandle, ExitReport
from fiber._agent.last_words import TELL
from fiber._engine.start_failures import StartFailure
from fiber._engine.tasks import WorkerEntry
from fiber._engine.worker_set import PoolWorkerSet
from fiber._exceptions import fresh
from fiber._runtime.background import BackgroundThread
from fiber._runtime.latch import Latch
from fiber._runtime.options import PoolOptions
from fiber._runtime.state import Runtime, SharedArguments
from fiber._transport.loop import Loop, LoopTimer, Wakeup
from fiber._wire import work
from fiber._wire.packet import Message
from fiber.errors import FiberError
from fiber.resources import Resources, merged, resources_of, with_resources


class WorkerResources:
    """Decided by the first task: its function's wishes, added to the pool's own.

    No lock: of several threads whose tasks are the first, one decides.
    """

    def __init__(self, own: Resources) -> None:
        self._own = own
        self._chosen: dict[str, Resources] = {}

    @property
    def chosen(self) -> Resources:
        """Resources that workers get.  The first use settles them."""
        return self._chosen.setdefault("resources", self._own)

    def choose_for(self, function: Callable[..., Any]) -> None:
        """Let the workers suit ``function``; ValueError if they are of another kind already."""
        wishes = resources_of(function)
        wanted = merged(self._own, wishes)
        chosen = self._chosen.setdefault("resources", wanted)
        if wishes != Resources() and merged(chosen, wishes) != chosen:
            raise ValueError(
                f"this pool's workers have {chosen}, and {function!r} wants {wanted}: all workers "
                "of a pool have what its first task wished. Make another pool for this function."
            )


class Supervisor(Protocol):
    """Observer of workers.  Its methods run on the loop's thread."""

    def on_message(self, handle: WorkerHandle, message: Message) -> None:
        """Take a packet from a worker."""

    def on_recalled(self, handle: WorkerHandle, seqs: list[int]) -> None:
        """The worker will never see these."""

    def on_draining(self, handle: WorkerHandle) -> None:
        """The worker's host is about to go."""

    def on_exit(self, handle: WorkerHandle, report: ExitReport) -> None:
        """The worker is gone."""


class WorkerHandle:
    """Process of a worker on the side of its pool; also the ``Popen`` behind its Process object.

    The scheduler knows it as a ``PoolMember``.  The pool's worker set changes ``worker`` and
    ``leaving``; all else changes here alone.
    """

    sentinel = -1
    """Placeholder that a Process reads when it starts.  A real sentinel is made if it is wanted."""

    def __init__(self, supervisor: Supervisor, runtime: Runtime, shared: SharedArguments) -> None:
        self.process: BaseProcess | None = None
        """Process object of the worker, once it is started."""
        self.child: ChildHandle | None = None
        self.worker: WorkerEntry | None = None
        """Entry of the worker in the ledger, once it is ready."""
        self.complaint = ""
        """Error of its initializer, or of its start."""
        self.fault = ""
        """Wrong answer for which the pool has killed it."""
        self.leaving = False
        """True if it was told to leave, or will be at once."""
        self.tasks = 0
        """Number of tasks that it has done."""
        self.returncode: int | None = None
        self._supervisor = supervisor
        self._runtime = runtime
        self._shared = shared  # arguments that all workers of its pool are started with
        self._terminated = False
        self._pid: int | None = None
        self._born = Latch()
        self._exited = Latch()
        self._at_exit: Wakeup | None = None
        self._launched: BaseProcess | None = None

    @property
    def name(self) -> str:
        """The worker's name."""
        return self.child.name if self.child is not None else "?"

    @property
    def host(self) -> str:
        """The name of its host, once that is known."""
        return self.child.host if self.child is not None else "?"

    def start(self, process: BaseProcess) -> None:
        """Start the worker as ``process``, a Process object that was made for this handle."""
        process.start()
        self.process = process

    def launch(self, process: BaseProcess, method: str) -> None:
        """Start the process, on behalf of its Process object; returns before it exists."""
        _logs.debug("starting worker %s", process.name)
        self._launched = process
        self._runtime.start(process, self, tasks=True, method=method, shared=self._shared)

    def did(self, tasks: int) -> None:
        """Count tasks that the worker has done."""
        self.tasks += tasks

    def complain(self, error: str) -> None:
        """Note the error of the worker's initializer, or of its start."""
        self.complaint = error

    def convict(self, reason: str) -> None:
        """Kill the worker, since it sent what no worker sends."""
        self.fault = reason
        self.kill()

    # What the agent says, on the loop's thread

    def begin(self, child: ChildHandle) -> None:
        """Note that the child is being started."""
        self.child = child
        child.start()
        if self.leaving:  # it was told to before it could be reached
            self.dismiss()
            if self._terminated:
                self.kill()

    def started(self, pid: int) -> None:
        """Note the pid of the process."""
        _logs.debug("worker %s has pid %d on host %s", self.name, pid, self.host)
        self._pid = pid
        self._born.set()

    def received(self, message: Message) -> None:
        """Take a packet from the worker."""
        self._supervisor.on_message(self, message)

    def recalled(self, seqs: list[int]) -> None:
        """Note batches that the worker will never see."""
        self._supervisor.on_recalled(self, seqs)

    def draining(self) -> None:
        """Note that the host of the worker is about to go."""
        self._supervisor.on_draining(self)

    def exited(self, report: ExitReport) -> None:
        """Note that the worker has ended."""
        if self.fault and report.cause == Cause.CHILD:
            report = report._replace(reason=f"WrongAnswer: {self.fault}, and Fiber killed it")
        _logs.debug("worker %s ended: %s", self.name, report.describe())
        self.returncode = report.exitcode
        self._exited.set()
        self._born.set()
        at_exit = self._at_exit
        if at_exit is not None:
            at_exit.set()
        # Its caller adds it, and looks at ``returncode`` afterwards.
        mp_process._children.discard(self._launched)  # type: ignore[attr-defined]
        self._supervisor.on_exit(self, report)

    def start_failure(self, report: ExitReport) -> StartFailure:
        """Return what its end tells about the start of workers, if it was not ready."""
        text = self.complaint or "\n".join(report.log)
        reason = "it raised an error" if self.complaint else report.reason
        killed = report.cause == Cause.REFUSED or (not self.complaint and report.exitcode < 0)
        final = self.child.start_error if self.child and report.cause == Cause.NO_HOST else None
        return StartFailure(
            f"pool worker {self.name!r}",
            reason,
            text,
            killed,
            final=final if isinstance(final, FiberError) else None,
        )

    # What its Process object asks

    @property
    def pid(self) -> int | None:
        """Pid of the process.  Waits until there is one."""
        if self._pid is None and not self._runtime.loop.on_thread():
            self._born.wait(self._runtime.config.start_timeout)
        return self._pid

    def exit_descriptor(self) -> int:
        """A descriptor that becomes readable when it is gone; made when first asked for."""
        if self._at_exit is None:
            self._at_exit = Wakeup()
            if self.returncode is not None:
                self._at_exit.set()
        return self._at_exit.fd

    def poll(self) -> int | None:
        """The exit code, None while it runs."""
        return self.returncode

    def wait(self, timeout: float | None = None) -> int | None:
        """Wait for the exit code."""
        self._exited.wait(timeout)
        return self.returncode

    def signal(self, signum: int) -> None:
        """Send it a signal."""
        if self.returncode is None and self.child is not None:
            # A program that has closed our descriptors has to hear of that, not of this.
            with contextlib.suppress(OSError):
                self.child.signal(signum)

    def dismiss(self) -> None:
        """Tell it to end once it has read this."""
        if self.child is not None:
            self.child.deliver(0, work.STOP_MESSAGE)

    def terminate(self) -> None:
        """SIGTERM."""
        self._terminated = True
        self.signal(signal.SIGTERM)

    def kill(self) -> None:
        """SIGKILL."""
        self.signal(signal.SIGKILL)

    def kill_with_stack(self) -> None:
        """Have it write the Python stacks of its threads, and kill it."""
        self.signal(TELL)

    def close(self) -> None:
        """Give the descriptor back."""
        self._at_exit = None


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
        runtime: Runtime,
        background: BackgroundThread,
        *,
        on_failed: Callable[[Sequence[WorkerHandle], BaseException | None], None],
    ) -> None:
        self._options = options
        self._arguments = SharedArguments(
            (options.initializer, options.initargs, options.retryable)
        )
        self._resources = resources
        self._runtime = runtime
        self._loop = runtime.loop
        self._background = background
        self._on_failed = on_failed
        self._ending: list[WorkerHandle] = []
        self._kill: LoopTimer | None = None

    def make(self, supervisor: Supervisor, count: int) -> list[WorkerHandle]:
        """Return handles of workers to be started."""
        return [WorkerHandle(supervisor, self._runtime, self._arguments) for _ in range(count)]

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
        process = self._options.new_process(
            handle,
            target=with_resources(worker.run, self._resources.chosen),
            args=self._arguments.args,
        )
        handle.start(process)

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


class WorkerInfo(NamedTuple):
    """State of a worker at one moment."""

    name: str
    """Name of its process."""
    host: str
    """Host that it runs on, on Kubernetes the name of its pod; empty while it waits for one."""
    node: str
    """Node of its pod; empty without Kubernetes, or while the node is not known."""
    pid: int | None
    """Pid on that host; None while it is not started."""
    state: str
    """``waiting`` for a host, ``starting``, ``idle``, ``busy`` or ``leaving``."""
    tasks: int
    """Number of tasks that it has done."""


class WorkerView:
    """Looks at the workers from any thread, and waits for them."""

    def __init__(self, workers: PoolWorkerSet, loop: Loop) -> None:
        self._workers = workers
        self._loop = loop
        self._waiting: list[Latch] = []
        """Any thread adds and removes its own."""
        self._over = False

    def processes(self) -> list[BaseProcess]:
        """The processes of those that are there."""
        handles: list[Any] = list(self._workers.members)
        return [handle.process for handle in handles if handle.process is not None]

    def describe(self) -> list[WorkerInfo]:
        """All that are there, the oldest first."""
        return [_describe(handle) for handle in list(self._workers.members)]

    def wait_until_up(self, timeout: float | None) -> bool:
        """Wait until the pool's least number of workers are ready, or it is clear that they will
        not be; False if ``timeout`` seconds are over first.
        """
        latch = Latch()
        # Both sides note first and look then: one of both sees the other.
        self._waiting.append(latch)
        try:
            self._loop.call_soon(self.changed)
            return self._over or latch.wait(timeout)
        finally:
            self._waiting.remove(latch)

    # On the loop's thread

    def changed(self) -> None:
        """Workers are ready, or it is clear that none will be."""
        workers = self._workers
        if (
            self._over
            or workers.size - workers.starting >= workers.minimum
            or workers.error is not None
        ):
            for latch in list(self._waiting):
                latch.set()

    def end(self) -> None:
        """Note that there will be no more workers."""
        self._over = True
        self.changed()


def _describe(handle: Any) -> WorkerInfo:
    child, worker = handle.child, handle.worker
    if child is None or child.waiting:
        return WorkerInfo(handle.name, "", "", None, "waiting", 0)
    if handle.leaving:
        state = "leaving"
    elif worker is None:
        state = "starting"
    else:
        state = "busy" if worker.queue or worker.leased else "idle"
    return WorkerInfo(handle.name, child.host, child.node, child.pid, state, handle.tasks)
