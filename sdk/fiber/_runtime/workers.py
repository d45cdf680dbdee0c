"""Workers of a pool: their processes, how these start and end, and what users see of them."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterable, Sequence
from multiprocessing import process as mp_process
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple, Protocol

from fiber import _logs, _worker_images
from fiber._agent import worker
from fiber._agent.interface import OUT_OF_MEMORY, Cause, ChildHandle, ExitReport
from fiber._agent.last_words import TELL
from fiber._engine.activity import ChildRecord
from fiber._engine.scheduler import PoolWorkerSet
from fiber._engine.start_failures import StartFailure
from fiber._engine.tasks import WorkerEntry
from fiber._exceptions import fresh
from fiber._runtime.options import PoolOptions
from fiber._runtime.state import Runtime, SharedArguments
from fiber._runtime.threads import BackgroundThread, Latch
from fiber._runtime.work_items import name_of
from fiber._transport.loop import Loop, LoopTimer, Wakeup
from fiber._wire import work
from fiber._wire.packet import Message
from fiber.errors import FiberError
from fiber.resources import Resources, merged, resources_of, with_resources

KILL_AFTER = 2.0
"""Seconds between SIGTERM and SIGKILL for workers that must end at once."""


class WorkerResources:
    """Resources of all workers of a pool: the pool's, and those of the first task's function.

    If several threads submit the first task, one of them decides.  This needs no lock.
    """

    def __init__(self, own: Resources) -> None:
        self._own = own
        self._chosen: dict[str, Resources] = {}

    @property
    def chosen(self) -> Resources:
        """Resources that workers get.  They do not change after the first read."""
        return self._chosen.setdefault("resources", self._own)

    def choose_for(self, function: Callable[..., Any]) -> None:
        """Choose the resources that ``function`` needs; ValueError if others were chosen before."""
        wishes = resources_of(function)
        wanted = merged(self._own, wishes)
        chosen = self._chosen.setdefault("resources", wanted)
        if wishes != Resources() and merged(chosen, wishes) != chosen:
            raise ValueError(
                f"this pool's workers have {chosen}, and {function!r} wishes {wanted}. All workers "
                "of a pool have the resources of its first task. Make another pool for it."
            )


class Supervisor(Protocol):
    """Observer of workers.  Its methods run on the loop thread."""

    def on_message(self, handle: WorkerHandle, message: Message) -> None:
        """Take a packet from a worker."""

    def on_recalled(self, handle: WorkerHandle, seqs: list[int]) -> None:
        """Queue the tasks of these batches again: the worker will never read the batches."""

    def on_draining(self, handle: WorkerHandle) -> None:
        """Replace the worker: its host is about to end."""

    def on_exit(self, handle: WorkerHandle, report: ExitReport) -> None:
        """Remove the worker, which has ended."""


class WorkerHandle:
    """A worker, as its pool sees it; also the ``Popen`` behind its Process object.

    The scheduler knows it as a ``PoolMember``.  The pool's worker set changes ``worker`` and
    ``leaving``; all else changes here alone.
    """

    sentinel = -1
    """Placeholder that a Process reads when it starts.  ``exit_descriptor`` has the real one."""

    def __init__(self, supervisor: Supervisor, runtime: Runtime, shared: SharedArguments) -> None:
        self.process: BaseProcess | None = None
        """Process object of the worker, once it is started."""
        self.child: ChildHandle | None = None
        self.worker: WorkerEntry | None = None
        """Entry of the worker in the ledger, once it is ready."""
        self.record: ChildRecord | None = None
        self.init_error = ""
        """Error of its initializer, or of its start."""
        self.fault = ""
        """Wrong answer for which the pool has killed the worker."""
        self.leaving = False
        """True once the worker was asked to end, or is about to be."""
        self.tasks = 0
        """Number of tasks that the worker has done."""
        self.returncode: int | None = None
        self._supervisor = supervisor
        self._runtime = runtime
        self._shared = shared  # arguments that all workers of its pool are started with
        self._missing = ""
        self._terminated = False
        self._pid: int | None = None
        self._born = Latch()
        self._exited = Latch()
        self._at_exit: Wakeup | None = None
        self._launched: BaseProcess | None = None

    @property
    def name(self) -> str:
        """Name of the worker."""
        return self.child.name if self.child is not None else "?"

    @property
    def host(self) -> str:
        """Name of the worker's host; ``?`` while it is unknown."""
        return self.child.host if self.child is not None else "?"

    @property
    def state(self) -> str:
        """State of the worker, as in ``WorkerInfo``."""
        if self.child is None or self.child.waiting:
            return "waiting"
        if self.leaving:
            return "leaving"
        if self.worker is None:
            return "starting"
        return "busy" if self.worker.queue or self.worker.leased else "idle"

    @property
    def busy_since(self) -> float | None:
        """Time since which the worker has tasks without an answer; None if it has none."""
        worker = self.worker
        return worker.since if worker is not None and worker.queue else None

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

    def note_init_error(self, error: str, missing: str) -> None:
        """Note the error of the worker's initializer or start, and the module that it lacks."""
        self.init_error = error
        self._missing = missing

    def kill_for(self, reason: str) -> None:
        """Kill the worker, since it sent what no worker sends."""
        self.fault = reason
        self.kill()

    # Reports of the agent, on the loop thread

    def begin(self, child: ChildHandle) -> None:
        """Note that the child is being started."""
        self.child = child
        child.start()
        if self.leaving:  # it was asked to before it had a child
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
        # ``Process.start`` adds the process, and looks at ``returncode`` afterwards.
        mp_process._children.discard(self._launched)  # type: ignore[attr-defined]
        self._supervisor.on_exit(self, report)

    def start_failure(self, report: ExitReport) -> StartFailure:
        """Return the start failure that the worker's end is, if the worker was not ready."""
        text = self.init_error or "\n".join(report.log)
        reason = "it raised an error" if self.init_error else report.reason
        killed = report.cause == Cause.REFUSED or (not self.init_error and report.exitcode < 0)
        final = self.child.start_error if self.child and report.cause == Cause.NO_HOST else None
        return StartFailure(
            f"pool worker {self.name!r}",
            reason,
            text,
            killed,
            final=final if isinstance(final, FiberError) else None,
            advice=_worker_images.advice(self._missing) or self._advice_on_initializer(report),
        )

    def _advice_on_initializer(self, report: ExitReport) -> str:
        """Return what to do if the worker ended by itself before it was ready."""
        initializer, *_ = self._shared.args
        by_itself = report.cause == Cause.CHILD and not report.reason.startswith(OUT_OF_MEMORY)
        if initializer is None or self.init_error or not by_itself:
            return ""
        return (
            f"The pool's initializer, {name_of(initializer)}, may have ended the process: it runs "
            "before a worker is ready. Look in it for os._exit() and sys.exit(), for a signal to "
            "its own process, and for native code that crashes."
        )

    # Requests of its Process object

    @property
    def pid(self) -> int | None:
        """Pid of the process.  Waits up to ``start_timeout`` seconds until there is one."""
        if self._pid is None and not self._runtime.loop.on_thread():
            self._born.wait(self._runtime.config.start_timeout)
        return self._pid

    def exit_descriptor(self) -> int:
        """Return a descriptor that becomes readable at the worker's end; the first use makes it."""
        if self._at_exit is None:
            self._at_exit = Wakeup()
            if self.returncode is not None:
                self._at_exit.set()
        return self._at_exit.fd

    def poll(self) -> int | None:
        """Return the exit code, None while the process runs."""
        return self.returncode

    def wait(self, timeout: float | None = None) -> int | None:
        """Wait for the exit code and return it; None after ``timeout`` seconds."""
        self._exited.wait(timeout)
        return self.returncode

    def signal(self, signum: int) -> None:
        """Send the process a signal."""
        if self.returncode is None and self.child is not None:
            # If the program has closed Fiber's descriptors, another error reports that.
            with contextlib.suppress(OSError):
                self.child.signal(signum)

    def dismiss(self) -> None:
        """Ask the worker to end once it has read its batches."""
        if self.child is not None:
            self.child.deliver(0, work.STOP_MESSAGE)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self._terminated = True
        self.signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.signal(signal.SIGKILL)

    def kill_with_stack(self) -> None:
        """Have the worker write the Python stacks of its threads, and kill it."""
        self.signal(TELL)

    def close(self) -> None:
        """Close the sentinel's descriptor, once its last user lets go."""
        self._at_exit = None


class Launcher:
    """Starts workers of one pool, and ends them by force.

    Workers start on other threads than the loop's, since pickling the initializer and its arguments
    may run the user's code, and agents may need the loop.  ``on_failed`` is called, on the loop
    thread, with workers that get no process, and with the error if a start was tried.
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
        """Start workers on the calling thread; raise the error if one cannot be started."""
        for handle in handles:
            self._start(handle)
        self._raise_start_error(handles, timeout)

    def give_up(self, handles: Sequence[WorkerHandle]) -> None:
        """Give up workers whose start was interrupted.

        Runs on the loop thread, where it is known which of them have a child.
        """
        self._on_failed([handle for handle in handles if handle.child is None], None)

    def _raise_start_error(self, handles: Sequence[WorkerHandle], timeout: float) -> None:
        """Wait until the agent has tried to start the workers; raise its error, if there is one."""
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
        """Start workers on the background thread.  The loop thread calls this."""
        for handle in handles:
            try:
                self._background.submit(self._launch, handle)
            except RuntimeError as error:  # the system has no room for its thread
                self._loop.call_soon(self._on_failed, (handle,), error)

    def end(self, handles: Iterable[Any]) -> None:
        """End workers at once, and kill them if they do not end.  Runs on the loop thread."""
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
            except BaseException as raised:  # no descriptors, or any error of the user's pickler
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
    """View of a pool's workers, for users on any thread."""

    def __init__(self, workers: PoolWorkerSet, loop: Loop) -> None:
        self._workers = workers
        self._loop = loop
        self._waiting: list[Latch] = []
        """Latches of the waiting threads.  Each thread adds and removes one."""
        self._over = False

    def processes(self, *, leaving: bool = True) -> list[BaseProcess]:
        """Return the Process objects of the workers that have one.

        ``leaving``: also those of workers that were asked to end.
        """
        handles: list[Any] = list(self._workers.members)
        return [
            handle.process
            for handle in handles
            if handle.process is not None and (leaving or not handle.leaving)
        ]

    def describe(self) -> list[WorkerInfo]:
        """Return the states of all workers, the oldest first."""
        return [_describe(handle) for handle in list(self._workers.members)]

    def busy(self) -> int:
        """Return the number of workers that have tasks."""
        handles: list[Any] = list(self._workers.members)
        return sum(handle.state == "busy" for handle in handles)

    def wait_until_up(self, timeout: float | None) -> bool:
        """Wait until the pool's minimum of workers are ready, or cannot start.

        Return False if ``timeout`` seconds are over first.
        """
        latch = Latch()
        # The waiter adds its latch before the loop looks, so the loop sees the latch.
        self._waiting.append(latch)
        try:
            self._loop.call_soon(self.changed)
            return self._over or latch.wait(timeout)
        finally:
            self._waiting.remove(latch)

    # On the loop thread

    def changed(self) -> None:
        """Wake the waiters if the pool's minimum of workers are ready, or cannot start."""
        workers = self._workers
        if (
            self._over
            or workers.size - workers.starting >= workers.minimum
            or workers.error is not None
        ):
            for latch in list(self._waiting):
                latch.set()

    def end(self) -> None:
        """Note that the pool has no more workers."""
        self._over = True
        self.changed()


def _describe(handle: Any) -> WorkerInfo:
    child, state = handle.child, handle.state
    if state == "waiting":
        return WorkerInfo(handle.name, "", "", None, state, 0)
    return WorkerInfo(handle.name, child.host, child.node, child.pid, state, handle.tasks)
