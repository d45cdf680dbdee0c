"""The ``Popen`` object behind multiprocessing's Process, for all backends."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable
from multiprocessing.process import BaseProcess

from fiber import _logs
from fiber._agent.interface import UNKNOWN, ChildHandle, ExitReport
from fiber._agent.last_words import TELL
from fiber._engine.activity import ChildRecord
from fiber._exceptions import fresh
from fiber._runtime.state import runtime
from fiber._runtime.threads import Latch
from fiber._transport.channels import naming_the_limit
from fiber._transport.loop import Wakeup
from fiber._wire.packet import Message
from fiber.errors import FiberError, StartError


class Popen:
    """A started process, and the observer of its child.

    It has the attributes and methods that multiprocessing's Process expects.
    """

    def __init__(self, process: BaseProcess, method: str, on_exit: Callable[[], None]) -> None:
        self._name = process.name
        self._on_exit = on_exit
        self.returncode: int | None = None
        self.report: ExitReport | None = None
        self.record: ChildRecord | None = None
        self._pid: int | None = None
        self._child: ChildHandle | None = None
        self._may_wait = runtime().backend.elastic
        self.same_pids = runtime().backend.same_pids
        """True if its pid is valid on this host, in this PID namespace."""
        self._answered = Latch()
        """Set when ``start`` need not wait longer."""
        self._born = Latch()
        self._exited = Latch()
        self._loop = loop = runtime().loop
        loop.depend(self)
        with naming_the_limit("starting a process"):
            # A thread that sets it keeps a reference, so the descriptor is not closed meanwhile.
            self._at_exit: Wakeup | None = Wakeup()
        self.sentinel = self._at_exit.fd
        try:
            self._wait_for_answer(runtime().start(process, self, method=method))
        except BaseException:
            # The caller gets no Process for it, so it must not run.
            loop.call_soon(self.kill)
            self.close()
            raise

    def _wait_for_answer(self, child: ChildHandle) -> None:
        timeout = runtime().config.start_timeout
        if not self._answered.wait(timeout):
            raise StartError(
                f"process {self._name!r}",
                f"its agent on host {child.host!r} did not start it within {timeout:g} s "
                "(start_timeout)",
            )
        if self._pid is None and self.report is not None:
            if child.start_error is not None:
                raise fresh(child.start_error)
            raise StartError(f"process {self._name!r}", self.report.reason)

    # Reports of the agent, on the loop thread

    def begin(self, child: ChildHandle) -> None:
        """Note that the child is being started."""
        self._child = child
        child.start()
        if child.waiting and self._may_wait:
            self._answered.set()

    def started(self, pid: int) -> None:
        """Note the pid of the process."""
        _logs.debug("process %s has pid %d", self._name, pid)
        self._pid = pid
        self._born.set()
        self._answered.set()

    def received(self, message: Message) -> None:
        """Drop a message: only pool workers send them."""
        message.release()

    def recalled(self, seqs: list[int]) -> None:
        """Do nothing: only pool workers have tasks."""

    def draining(self) -> None:
        """Do nothing: the agent signals a process that handles SIGTERM before its host ends."""

    def exited(self, report: ExitReport) -> None:
        """Note that the process has ended."""
        _logs.debug("process %s ended: %s", self._name, report.describe())
        self.report = report
        at_exit = self._at_exit
        if at_exit is not None:
            at_exit.set()
        # From here on the user may close the Process.
        self.returncode = report.exitcode
        self._on_exit()
        self._exited.set()
        self._born.set()
        self._answered.set()
        # This breaks a reference cycle.  The sentinel's descriptor closes with its last user.
        self._child = None

    def broken(self, error: FiberError) -> None:
        """Count the process as ended, since its end could not be reported."""
        if self.returncode is None:
            # The loop fails if its descriptors were closed, and then these calls may fail, too.
            with contextlib.suppress(OSError):
                self.kill()
            self.exited(ExitReport(UNKNOWN, str(error)))

    @property
    def state(self) -> str:
        """State of the process: ``waiting`` for a host, ``starting`` or ``running``."""
        child = self._child
        if child is not None and child.waiting:
            return "waiting"
        return "starting" if self._pid is None else "running"

    @property
    def busy_since(self) -> None:
        """None: a process has no tasks."""

    @property
    def leaving(self) -> str:
        """Reason for which the host is about to end; empty if the host stays."""
        child = self._child
        return "" if child is None else child.leaving

    # Requests of the Process object

    @property
    def pid(self) -> int | None:
        """Pid of the process.  Waits up to ``start_timeout`` seconds; None if it never had one."""
        if self._pid is None and not self._loop.on_thread():
            self._born.wait(runtime().config.start_timeout)
        return self._pid

    def poll(self) -> int | None:
        """Return the exit code, None while the process runs."""
        return self.wait(0)

    def wait(self, timeout: float | None = None) -> int | None:
        """Wait for the exit code and return it; None after ``timeout`` seconds."""
        self._exited.wait(timeout)
        return self.returncode

    def interrupt(self) -> None:
        """Send SIGINT."""
        self._signal(signal.SIGINT)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self._signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self._signal(signal.SIGKILL)

    def kill_with_stack(self) -> None:
        """Have the process write the Python stacks of its threads, and kill it."""
        self._signal(TELL)

    def _signal(self, signum: int) -> None:
        child = self._child
        if child is not None:
            child.signal(signum)

    def close(self) -> None:
        """Close the sentinel's descriptor, once its last user lets go."""
        self._at_exit = None
