"""Workers of a vector environment, and the messages of all of them."""

from __future__ import annotations

import select
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from fiber._wire import packet
from fiber.process import Process
from fiber.vector.worker_process import WorkerProcess, end


class Ended:
    """Mark in place of a message: this process sends no more."""


class Unreadable(NamedTuple):
    """Mark in place of a message that cannot be unpickled here."""

    error: Exception


class WorkerSet:
    """Set of workers that are started and listened to."""

    def __init__(self, workers: Sequence[WorkerProcess]) -> None:
        self._workers = workers
        self._started: list[WorkerProcess] = []
        """Workers whose process must be closed."""
        self._released: list[Process] = []
        """Processes that were told to end while they were well."""
        self._ended: deque[WorkerProcess] = deque()
        """Workers whose end was noticed, and not reported yet."""
        self._poller = select.epoll()
        self._heard_by: dict[int, WorkerProcess] = {}
        """Workers by descriptor."""

    def __iter__(self) -> Iterator[WorkerProcess]:
        return iter(self._workers)

    def __len__(self) -> int:
        return len(self._workers)

    def start(self, worker: WorkerProcess) -> None:
        """Start a worker's process, and listen to it."""
        worker.start()
        self._started.append(worker)
        # A process that an environment has started may hold the connection open after the end of
        # the worker.  The sentinel shows that end.
        for descriptor in (worker.connection.fileno(), worker.process.sentinel):
            self._heard_by[descriptor] = worker
            self._poller.register(descriptor, select.EPOLLIN)

    def drop(self, worker: WorkerProcess) -> None:
        """Close a process that has ended."""
        self._forget(worker)
        worker.close(0)
        self._started.remove(worker)

    def release(self, worker: WorkerProcess) -> None:
        """Have a live process close its environments and end."""
        self._forget(worker)
        self._ended = deque(each for each in self._ended if each is not worker)
        worker.hang_up(kill=False)
        running = [process for process in self._released if process.exitcode is None]
        self._released = [*running, worker.process]
        self._started.remove(worker)

    def send(self, worker: WorkerProcess, data: bytes) -> None:
        """Send a pickled command.  If the worker has ended, ``receive`` reports that next."""
        try:
            worker.connection.send_bytes(data)
        except OSError:
            self._ended.append(worker)

    def receive(self, timeout: float) -> list[tuple[WorkerProcess, Any]]:
        """Return messages of workers; none after ``timeout`` seconds."""
        heard: list[tuple[WorkerProcess, Any]] = []
        for descriptor, _ in self._poller.poll(0 if self._ended else timeout):
            worker = self._heard_by[descriptor]
            if descriptor == worker.process.sentinel:
                heard += [(worker, message) for message in _rest(worker)]
                self._ended.append(worker)
            elif worker not in self._ended:  # else all its messages were received already
                try:
                    heard.append((worker, _received(worker)))
                except (EOFError, OSError):
                    self._ended.append(worker)
        while self._ended:
            worker = self._ended.popleft()
            if self._forget(worker):
                heard.append((worker, Ended()))
        return heard

    def close(self, timeout: float | None) -> None:
        """Wait until all workers have ended; kill the others after ``timeout`` seconds."""
        deadline = None if timeout is None else time.monotonic() + timeout

        def left() -> float | None:
            return None if deadline is None else max(0.0, deadline - time.monotonic())

        for worker in self._started:
            self._forget(worker)
            worker.hang_up(kill=timeout == 0)
        while self._started:
            worker = self._started[-1]  # until it is closed: Ctrl-C may come before
            worker.close(left())
            self._started.pop()
        while self._released:
            end(self._released[-1], left())
            self._released.pop()
        self._poller.close()

    def _forget(self, worker: WorkerProcess) -> bool:
        """Stop listening to a worker; return False if that had happened before."""
        descriptors = [fd for fd, other in self._heard_by.items() if other is worker]
        for descriptor in descriptors:
            del self._heard_by[descriptor]
            self._poller.unregister(descriptor)
        return bool(descriptors)


def _received(worker: WorkerProcess) -> Any:
    """Return the next message of a worker; EOFError or OSError at its end."""
    message = worker.connection._recv_pickled()
    try:
        return packet.loads(message)
    except Exception as error:  # an OSError, too, is that of an environment's object
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
