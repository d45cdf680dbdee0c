"""The workers of a pool: started, watched, replaced, let go.

Everything here but ``Link``'s own state is guarded by the pool's lock; methods that say so are
called with it held, the others without.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterable
from multiprocessing import process as mp_process
from typing import Any, Protocol

from fiber._agent import worker
from fiber._agent.port import ChildPort, ExitReport
from fiber._engine.ledger import Worker
from fiber._runtime.methods import zygote_method
from fiber._runtime.state import runtime
from fiber._wire import work
from fiber._wire.packet import Message
from fiber.errors import StartError
from fiber.process import Process

TRIES = 3
"""Workers that may fail to start, one after the other, before the pool gives up."""


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

    def __init__(self, supervisor: Supervisor) -> None:
        self.process: PoolProcess | None = None
        """Once it is started."""
        self.port: ChildPort | None = None
        self.worker: Worker | None = None
        """Its entry in the ledger, once it is ready."""
        self.known: dict[int, None] = {}
        """Functions that it was sent."""
        self.complaint = ""
        """What its initializer, or its birth, failed with."""
        self.leaving = False
        self.returncode: int | None = None
        self._supervisor = supervisor
        self._pid: int | None = None
        self._born = threading.Event()
        self._exited = threading.Event()
        self._sentinel: int | None = None

    @property
    def name(self) -> str:
        """The worker's name."""
        return self.port.name if self.port is not None else "?"

    def launch(self, process: PoolProcess, method: str) -> None:
        """Start the process; returns before it exists."""
        self.port = runtime().start(process, self, tasks=True, method=method)

    # What the agent says, on the loop's thread

    def started(self, pid: int) -> None:
        """It has a pid."""
        self._pid = pid
        self._born.set()

    def said(self, message: Message) -> None:
        """It sent a packet."""
        self._supervisor.heard(self, message)

    def taken_back(self, seqs: list[int]) -> None:
        """It will never see these."""
        self._supervisor.recalled(self, seqs)

    def exited(self, report: ExitReport) -> None:
        """It is gone."""
        self.returncode = report.exitcode
        self._exited.set()
        self._born.set()
        if self._sentinel is not None:
            os.eventfd_write(self._sentinel, 1)
        mp_process._children.discard(self.process)  # type: ignore[attr-defined]
        self._supervisor.lost(self, report)

    # What its Process object asks

    @property
    def pid(self) -> int | None:
        """Its pid; waits until it has one."""
        if self._pid is None and not runtime().loop.on_thread():
            self._born.wait(runtime().config.start_timeout)
        return self._pid

    @property
    def sentinel(self) -> int:
        """A descriptor that becomes readable when it is gone; made when first asked for."""
        if self._sentinel is None:
            self._sentinel = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
            if self.returncode is not None:
                os.eventfd_write(self._sentinel, 1)
        return self._sentinel

    def poll(self) -> int | None:
        """The exit code, None while it runs."""
        return self.returncode

    def wait(self, timeout: float | None = None) -> int | None:
        """Wait for the exit code."""
        self._exited.wait(timeout)
        return self.returncode

    def signal(self, signum: int) -> None:
        """Send it a signal."""
        if self.returncode is None and self.port is not None:
            self.port.signal(signum)

    def terminate(self) -> None:
        """SIGTERM."""
        self.signal(signal.SIGTERM)

    def kill(self) -> None:
        """SIGKILL."""
        self.signal(signal.SIGKILL)

    def close(self) -> None:
        """Give the sentinel's descriptor back."""
        sentinel, self._sentinel = self._sentinel, None
        if sentinel is not None:
            os.close(sentinel)

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

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_link": None}

    def _Popen(self) -> Link:  # type: ignore[override]
        assert self._link is not None
        self._link.launch(self, zygote_method(self._start_method))
        return self._link

    @property
    def sentinel(self) -> int:
        """As in multiprocessing."""
        self._check_closed()  # type: ignore[attr-defined]
        assert self._link is not None
        return self._link.sentinel


class Crew:
    """Who works for a pool: between ``minimum`` and ``maximum`` processes.

    ``failures`` counts workers that were gone before they were ready, since the last that was,
    ``idle_deaths`` those that died with nothing to do since one last did something; ``error`` is
    set once there is no point in trying again.
    """

    def __init__(
        self,
        supervisor: Supervisor,
        lock: threading.Lock,
        context: Any,
        target_args: tuple[Any, ...],
        minimum: int,
        maximum: int,
    ) -> None:
        self.links: dict[Link, None] = {}
        self.hiring = 0
        """Workers that someone is about to hire."""
        self.minimum = minimum
        self.maximum = maximum
        self.failures = 0
        self.idle_deaths = 0
        self.error: StartError | None = None
        self._supervisor = supervisor
        self._lock = lock
        self._context = context
        self._args = target_args

    def hire(self) -> Link:
        """Start one of those in ``hiring``; the supervisor hears when it is ready, or gone."""
        link = Link(self._supervisor)
        process = PoolProcess(link, self._context, target=worker.run, args=self._args)
        with self._lock:
            self.hiring -= 1
            self.links[link] = None
        try:
            process.start()
            link.process = process
        except BaseException:
            with self._lock:
                self.links.pop(link, None)
            raise
        return link

    def missing(self, demand: int) -> int:
        """Workers to hire for ``demand`` tasks.  Lock held."""
        wanted = min(max(demand, self.minimum), self.maximum)
        return max(0, wanted - len(self.staying()) - self.hiring)

    def staying(self) -> list[Link]:
        """Workers that were not told to go.  Lock held."""
        return [link for link in self.links if not link.leaving]

    def starting(self) -> int:
        """Workers that are not ready yet.  Lock held."""
        return self.hiring + sum(link.worker is None for link in self.staying())

    def ready(self) -> int:
        """Workers that are.  Lock held."""
        return sum(link.worker is not None for link in self.staying())

    def degraded(self) -> bool:
        """Whether new workers do not start while others work on.  Lock held."""
        return self.failures >= TRIES and self.ready() > 0

    def gone(self, link: Link, report: ExitReport) -> None:
        """Take in that a worker is gone.  Lock held."""
        self.links.pop(link, None)
        if link.leaving:
            return
        if link.worker is not None:
            # One that dies with nothing to do, again and again, is not worth a process each time.
            self.idle_deaths += not link.worker.queue
            return
        self.failures += 1
        if self.failures >= TRIES and not self.ready():
            reason = "it raised an error" if link.complaint else report.reason
            self.error = StartError(
                f"pool worker {link.name!r}", reason, link.complaint or "\n".join(report.log), TRIES
            )

    def hesitant(self) -> bool:
        """Whether new workers should wait a little."""
        return self.idle_deaths > self.maximum + TRIES

    def refused(self, error: BaseException) -> None:
        """Take in that a worker could not even be asked for.  Lock held."""
        self.failures = TRIES
        if not self.links:
            self.error = StartError("a pool worker", str(error))
            self.error.__cause__ = error


def dismiss(links: Iterable[Link]) -> None:
    """Tell workers to end once they have read this."""
    for link in links:
        link.leaving = True
        if link.port is not None:
            link.port.deliver(0, work.STOP_MESSAGE)
