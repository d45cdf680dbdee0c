"""Worker on the side of its pool."""

from __future__ import annotations

import contextlib
import signal
from multiprocessing import process as mp_process
from multiprocessing.process import BaseProcess
from typing import Any, Protocol

from fiber import _logs
from fiber._agent.interface import Cause, ChildHandle, ExitReport
from fiber._agent.last_words import TELL
from fiber._engine.ledger import Worker
from fiber._engine.start_failures import StartFailure
from fiber._runtime.latch import Latch
from fiber._runtime.shared_arguments import SharedArguments
from fiber._transport.loop import Wakeup
from fiber._wire import work
from fiber._wire.packet import Message
from fiber.errors import FiberError


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

    The scheduler knows it as a ``Member`` of the pool's worker set.
    """

    sentinel = -1
    """Placeholder that a Process reads when it starts.  A real sentinel is made if it is wanted."""

    def __init__(self, supervisor: Supervisor, host: Any) -> None:
        self.process: BaseProcess | None = None
        """Once it is started."""
        self.child: ChildHandle | None = None
        self.worker: Worker | None = None
        """Entry of the worker in the ledger, once it is ready."""
        self.known: dict[int, None] = {}
        """Functions that were sent to the worker."""
        self.complaint = ""
        """Error of its initializer, or of its start."""
        self.fault = ""
        """Wrong answer for which the pool has killed it."""
        self.asked = 0
        """Number of the last call that a caller sent it directly."""
        self.leaving = False
        """True if it was told to leave, or will be at once."""
        self.unwanted = False
        """True if it was told to end at once, also in the middle of a task."""
        self.tasks = 0
        """Number of tasks that it has done."""
        self.returncode: int | None = None
        self.shared: SharedArguments | None = None
        """Arguments that all workers of its pool are started with."""
        self._supervisor = supervisor
        self._host = host
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

    def launch(self, process: BaseProcess, method: str) -> None:
        """Start the process; returns before it exists."""
        _logs.debug("starting worker %s", process.name)
        self._launched = process
        self._host.start(process, self, tasks=True, method=method, shared=self.shared)

    # What the agent says, on the loop's thread

    def begin(self, child: ChildHandle) -> None:
        """Note that the child is being started."""
        self.child = child
        child.start()
        if self.leaving:  # it was told to before it could be reached
            self.dismiss()
            if self.unwanted:
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
        if self._pid is None and not self._host.loop.on_thread():
            self._born.wait(self._host.config.start_timeout)
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
        self.unwanted = True
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
