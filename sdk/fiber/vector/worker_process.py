"""Workers as the learner sees them: process, connection and commands of each."""

from __future__ import annotations

import contextlib
import select
import time
from collections import deque
from collections.abc import Iterator, Sequence
from multiprocessing import TimeoutError as TookTooLong
from typing import Any, NamedTuple

from fiber import reduction
from fiber._wire import packet
from fiber.connection import Connection, Pipe
from fiber.context import BaseContext
from fiber.errors import UnpicklableError, WorkerDied, block
from fiber.process import Process
from fiber.resources import largest, resources_of, with_resources
from fiber.vector.arrays import StepArrays
from fiber.vector.worker import CLOSE, Setup, WorkerHello, serve

NEWS = 2.0
"""Seconds from the end of a process's connection to the report of its end."""

GRACE = 5.0
"""Seconds beyond the limits of its environments after which a worker counts as stuck."""

LIMITS_OF_A_RESTART = 4
"""Number of times that ``timeout`` may pass for an environment that is replaced: for its step, its
end, the making of the new one, and the step of the new one.
"""


_CLOSE = reduction.dumps((CLOSE,))


class PendingCommand(NamedTuple):
    """Command that an environment has not answered yet."""

    operation: str
    seed: int | None = None
    options: dict[str, Any] | None = None


class WorkerProcess:
    """Worker, whose process is replaced if it dies."""

    process: Process
    connection: Connection
    arrays: StepArrays
    """Arrays of the worker's environments, once all workers have said hello."""

    def __init__(self, setup: Setup, context: BaseContext, owner: str) -> None:
        self.setup = setup
        self.name = f"{owner}-worker-{setup.worker}"
        self.numbers = range(setup.first, setup.first + len(setup.makes))
        """Numbers of the worker's environments."""
        self._context = context
        self._wishes = largest(map(resources_of, setup.makes))
        self.hello: WorkerHello | None = None
        self.generation = 0
        """Number of the present generation of commands.  Answers to earlier ones are ignored."""
        self.pending: dict[int, PendingCommand] = {}
        """Unanswered commands by row."""
        self.is_behind = False
        """True while it may still be carrying out commands that were given up."""
        self.results: list[Any] | None = None
        """Results of the last call of methods; None while they are awaited."""
        self.deadline: float | None = None
        self.stuck = False
        """True if the worker was killed because its deadline had passed."""
        self.deaths = 0
        """Number of processes that died since the last answer, and not by the cluster."""
        self.disruptions = 0
        """Number of processes that the cluster ended, or that moved, since the last answer."""
        self.disrupted = False
        """True if the cluster ended the process before this one."""
        self.has_arrays = False
        """True once the process was sent the arrays."""
        self.is_released = False
        """True from the end of one process until the start of the next."""
        self.lost: str | None = None
        """Reason why the process before this one ended."""
        self.error: Exception | None = None
        """Error for which the worker was given up."""

    def start(self) -> None:
        """Start the process."""
        self.connection, theirs = Pipe()
        with theirs:
            self.process = self._context.Process(
                target=with_resources(serve, self._wishes),
                args=(theirs, self.setup),
                name=self.name,
                daemon=True,
            )
            try:
                self.process.start()
                self.is_released = self.has_arrays = False
            except BaseException as error:
                self.connection.close()
                if isinstance(error, UnpicklableError):
                    self._check_pickling()
                raise

    def leaving(self) -> str:
        """Return why the host of the process will end; empty if the host stays."""
        popen: Any = self.process._popen
        return str(popen.leaving)

    def whose(self) -> str:
        """Return the names of the worker's environments, for messages."""
        first, last = self.numbers[0], self.numbers[-1]
        return f"environment {first}" if first == last else f"environments {first} to {last}"

    def death(self, row: int | None) -> Exception:
        """Count the end of the process, and return the error for it.

        ``row``: environment that was busy; None if unknown.
        """
        command = next(iter(self.pending.values()), None) if self.hello else None
        doing = command.operation if command else "a call" if self.hello else "the making"
        whose = self.whose() if row is None else f"environment {self.numbers[row]}"
        self.process.join(NEWS)
        if self.process.exitcode is None:
            self.process.kill()  # without a connection its results cannot arrive
            self.process.join(NEWS)
        popen: Any = self.process._popen
        report = popen.report
        self.disrupted = bool(report and report.disrupted and not self.stuck)
        self.disruptions += self.disrupted
        self.deaths += not self.disrupted
        if self.stuck:
            self.stuck = False
            lines = [
                f"{doing} of {whose} took longer than {self.setup.timeout:g} s (timeout) for each, "
                f"so worker {self.name!r} was killed"
            ]
            if report and report.stack:
                lines.append(block("Where it was:", report.stack.splitlines()))
            return TookTooLong("\n".join(lines))
        return WorkerDied(
            task=f"{doing} of {whose}",
            worker=self.name,
            host=report.host if report else "?",
            pid=self.process.pid,
            exitcode=self.process.exitcode,
            reason=report.reason if report else "its connection is lost",
            log=report.log if report else (),
            stack=report.stack if report else "",
            attempts=self.deaths,
            disruptions=self.disruptions,
            pod=(report and report.pod) or None,
            node=(report and report.node) or None,
        )

    def give_up(self) -> None:
        """Ignore the answers to all commands so far."""
        self.generation += 1
        self.is_behind = self.is_behind or bool(self.pending)
        self.pending.clear()
        self.deadline = None

    def set_deadline(self) -> None:
        """Set the time by which the worker must have answered the remaining commands."""
        timeout, count = self.setup.timeout, len(self.pending)
        self.deadline = None
        if timeout is not None and count:
            limits = count * (LIMITS_OF_A_RESTART if self.setup.restart else 1)
            self.deadline = time.monotonic() + limits * timeout + GRACE

    def kill_if_stuck(self) -> None:
        """Kill the worker if its deadline has passed.

        Usually an alarm in the worker ends a slow environment.  That fails if native code blocks
        the interpreter, and if the process is stopped or out of reach.
        """
        if self.deadline is not None and self.deadline < time.monotonic():
            self.deadline = None
            self.stuck = True
            popen: Any = self.process._popen
            popen.kill_with_stack()

    def hang_up(self, *, kill: bool) -> None:
        """Ask the worker to end, and close the connection.  ``kill``: kill its process."""
        if not kill:
            # A forked copy of this process may keep the connection open: its end is not enough.
            with contextlib.suppress(OSError):
                self.connection.send_bytes(_CLOSE)
        self.connection.close()
        if kill:
            with contextlib.suppress(ValueError):  # closed just before Ctrl-C
                self.process.kill()

    def close(self, timeout: float | None) -> None:
        """Wait for the end of the process; kill it after ``timeout`` seconds."""
        self.connection.close()
        end(self.process, timeout)

    def _check_pickling(self) -> None:
        for number, make in zip(self.numbers, self.setup.makes, strict=True):
            try:
                reduction.dumps(make)
            except Exception as error:
                what = f"the function that makes environment {number}, of worker {self.name!r},"
                raise UnpicklableError(what, str(error)) from error


def end(process: Process, timeout: float | None) -> None:
    """Wait for the end of a process; kill it after ``timeout`` seconds."""
    with contextlib.suppress(ValueError):  # closed just before Ctrl-C
        process.join(timeout)
        if process.exitcode is None:
            process.kill()
            process.join()
        process.close()


class Ended(NamedTuple):
    """Mark in place of a message: the process has ended."""

    process: Process


class Unreadable(NamedTuple):
    """Mark in place of a message that cannot be unpickled here."""

    error: Exception


class WorkerGroup:
    """Group of workers with started processes, whose messages are received."""

    def __init__(self, workers: Sequence[WorkerProcess]) -> None:
        self._workers = workers
        self.received: deque[tuple[WorkerProcess, Any]] = deque()
        """Messages that were received.  The caller removes each once it has dealt with it."""
        self._started: list[WorkerProcess] = []
        """Workers whose process must be closed."""
        self._released: list[Process] = []
        """Live processes that were asked to end."""
        self._ended: deque[tuple[WorkerProcess, Process]] = deque()
        """Workers whose process has ended, as was noticed and not reported yet."""
        self._poller = select.epoll()
        self._by_descriptor: dict[int, WorkerProcess] = {}
        """Workers by descriptor."""

    def __iter__(self) -> Iterator[WorkerProcess]:
        return iter(self._workers)

    def __len__(self) -> int:
        return len(self._workers)

    def start(self, worker: WorkerProcess) -> None:
        """Start a worker's process, and receive its messages."""
        worker.start()
        self._started.append(worker)
        # A process that an environment has started may hold the connection open after the end of
        # the worker.  The sentinel shows that end.
        for descriptor in (worker.connection.fileno(), worker.process.sentinel):
            self._by_descriptor[descriptor] = worker
            self._poller.register(descriptor, select.EPOLLIN)

    def drop(self, worker: WorkerProcess) -> None:
        """Close a process that has ended.  It may be called again after an interrupt."""
        self._forget(worker)
        worker.close(0)
        self._remove(worker)

    def release(self, worker: WorkerProcess) -> None:
        """Ask a live process to close its environments and end.

        It may be called again after an interrupt.
        """
        self._forget(worker)
        worker.hang_up(kill=False)
        running = [process for process in self._released if process.exitcode is None]
        self._released = [*running, worker.process]
        self._remove(worker)

    def send(self, worker: WorkerProcess, data: bytes) -> None:
        """Send a pickled command.  If the worker has ended, ``receive`` reports that next."""
        try:
            worker.connection.send_bytes(data)
        except OSError:
            self._ended.append((worker, worker.process))

    def receive(self, timeout: float) -> None:
        """Add messages of workers to ``received``; none after ``timeout`` seconds."""
        for descriptor, _ in self._poller.poll(0 if self._ended else timeout):
            worker = self._by_descriptor[descriptor]
            if descriptor == worker.process.sentinel:
                self.received += [(worker, message) for message in _rest(worker)]
                self._ended.append((worker, worker.process))
            elif (worker, worker.process) not in self._ended:  # else all was received already
                try:
                    self.received.append((worker, _received(worker)))
                except (EOFError, OSError):
                    self._ended.append((worker, worker.process))
        while self._ended:
            worker, process = self._ended[0]  # an interrupt must not lose it
            if worker.process is process and worker in self._by_descriptor.values():
                self.received.append((worker, Ended(process)))
                self._forget(worker)
            self._ended.popleft()

    def close(self, timeout: float | None) -> None:
        """Wait until all workers have ended; kill the others after ``timeout`` seconds."""
        deadline = None if timeout is None else time.monotonic() + timeout

        def left() -> float | None:
            return None if deadline is None else max(0.0, deadline - time.monotonic())

        for worker in self._started:
            self._forget(worker)
            worker.hang_up(kill=timeout == 0)
        while self._started:
            worker = self._started[-1]  # removed after the close, which Ctrl-C may interrupt
            worker.close(left())
            self._started.pop()
        while self._released:
            end(self._released[-1], left())
            self._released.pop()
        self._poller.close()

    def _forget(self, worker: WorkerProcess) -> None:
        """Stop receiving from a worker."""
        for descriptor in [fd for fd, other in self._by_descriptor.items() if other is worker]:
            with contextlib.suppress(OSError):  # closed by the garbage collector
                self._poller.unregister(descriptor)
            del self._by_descriptor[descriptor]

    def _remove(self, worker: WorkerProcess) -> None:
        if worker in self._started:
            self._started.remove(worker)


def _received(worker: WorkerProcess) -> Any:
    """Return the next message of a worker; EOFError or OSError at its end."""
    message = worker.connection._recv_pickled()
    try:
        return packet.loads(message)
    except Exception as error:  # also an OSError, from unpickling an object
        return Unreadable(error)


def _rest(worker: WorkerProcess) -> list[Any]:
    """Return the messages that a worker sent before it ended."""
    messages = []
    try:
        while worker.connection.poll():
            messages.append(_received(worker))
    except (EOFError, OSError):
        pass
    return messages
