"""One worker of a pool, as the pool sees it."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterable
from multiprocessing import process as mp_process
from typing import Any, Protocol

from fiber._agent.interface import ChildHandle, ExitReport
from fiber._engine.ledger import Worker
from fiber._runtime.methods import zygote_method
from fiber._runtime.state import runtime
from fiber._wire import work
from fiber._wire.packet import Message
from fiber.process import Process


class Supervisor(Protocol):
    """Who hears what workers say; on the loop's thread."""

    def heard(self, link: Link, message: Message) -> None:
        """A packet from a worker."""

    def recalled(self, link: Link, seqs: list[int]) -> None:
        """The worker will never see these."""

    def lost(self, link: Link, report: ExitReport) -> None:
        """The worker is gone."""


class Link:
    """One worker's process as its pool sees it; also the ``Popen`` behind its Process object."""

    sentinel = -1
    """What a Process asks for when it starts; ``PoolProcess`` has a real one, if wanted."""

    def __init__(self, supervisor: Supervisor) -> None:
        self.process: PoolProcess | None = None
        """Once it is started."""
        self.port: ChildHandle | None = None
        self.worker: Worker | None = None
        """Its entry in the ledger, once it is ready."""
        self.known: dict[int, None] = {}
        """Functions that it was sent."""
        self.complaint = ""
        """What its initializer, or its birth, failed with."""
        self.leaving = False
        """It was told to go, or will be at once."""
        self.returncode: int | None = None
        self._supervisor = supervisor
        self._pid: int | None = None
        self._born = threading.Event()
        self._exited = threading.Event()
        self._exit: int | None = None
        self._launched: PoolProcess | None = None

    @property
    def name(self) -> str:
        """The worker's name."""
        return self.port.name if self.port is not None else "?"

    def launch(self, process: PoolProcess, method: str) -> None:
        """Start the process; returns before it exists."""
        self._launched = process
        self.port = runtime().start(process, self, tasks=True, method=method)

    # What the agent says, on the loop's thread

    def started(self, pid: int) -> None:
        """It has a pid."""
        self._pid = pid
        self._born.set()

    def received(self, message: Message) -> None:
        """It sent a packet."""
        self._supervisor.heard(self, message)

    def recalled(self, seqs: list[int]) -> None:
        """It will never see these."""
        self._supervisor.recalled(self, seqs)

    def exited(self, report: ExitReport) -> None:
        """It is gone."""
        self.returncode = report.exitcode
        self._exited.set()
        self._born.set()
        if self._exit is not None:
            os.eventfd_write(self._exit, 1)
        # Its caller adds it, and looks at ``returncode`` afterwards.
        mp_process._children.discard(self._launched)  # type: ignore[attr-defined]
        self._supervisor.lost(self, report)

    # What its Process object asks

    @property
    def pid(self) -> int | None:
        """Its pid; waits until it has one."""
        if self._pid is None and not runtime().loop.on_thread():
            self._born.wait(min(runtime().config.start_timeout, threading.TIMEOUT_MAX))
        return self._pid

    def exit_descriptor(self) -> int:
        """A descriptor that becomes readable when it is gone; made when first asked for."""
        if self._exit is None:
            self._exit = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
            if self.returncode is not None:
                os.eventfd_write(self._exit, 1)
        return self._exit

    def poll(self) -> int | None:
        """The exit code, None while it runs."""
        return self.returncode

    def wait(self, timeout: float | None = None) -> int | None:
        """Wait for the exit code."""
        self._exited.wait(None if timeout is None else min(timeout, threading.TIMEOUT_MAX))
        return self.returncode

    def signal(self, signum: int) -> None:
        """Send it a signal."""
        if self.returncode is None and self.port is not None:
            # A program that has closed our descriptors has to hear of that, not of this.
            with contextlib.suppress(OSError):
                self.port.signal(signum)

    def terminate(self) -> None:
        """SIGTERM."""
        self.signal(signal.SIGTERM)

    def kill(self) -> None:
        """SIGKILL."""
        self.signal(signal.SIGKILL)

    def close(self) -> None:
        """Give the descriptor back."""
        descriptor, self._exit = self._exit, None
        if descriptor is not None:
            os.close(descriptor)

    def __del__(self) -> None:
        self.close()


class PoolProcess(Process):
    """The Process object of a pool worker."""

    def __init__(self, link: Link | None, context: Any, **options: Any) -> None:
        super().__init__(**options)
        base = context.Process
        self._start_method = getattr(base, "_start_method", None)
        role = base.__name__.replace("Process", "PoolWorker")
        self.name = self.name.replace(type(self).__name__, role)
        self.daemon = True
        self._link = link

    def __reduce__(self) -> tuple[Any, ...]:
        # In its own process it is a Process like any other: a worker that had to import this class
        # would import the whole runtime, and start much later.
        state = {name: value for name, value in vars(self).items() if name != "_link"}
        return object.__new__, (Process,), state

    def _Popen(self) -> Link:
        assert self._link is not None
        self._link.launch(self, zygote_method(self._start_method))
        return self._link

    @property
    def sentinel(self) -> int:
        """As in multiprocessing."""
        self._check_closed()  # type: ignore[attr-defined]
        assert self._link is not None
        return self._link.exit_descriptor()


def dismiss(links: Iterable[Link]) -> None:
    """Tell workers that are leaving to end once they have read this."""
    for link in links:
        if link.port is not None:
            link.port.deliver(0, work.STOP_MESSAGE)
