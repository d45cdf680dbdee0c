"""The worker processes of a vector environment, and what any of them says."""

from __future__ import annotations

import select
from collections import deque
from collections.abc import Sequence
from typing import Any

from fiber.context import BaseContext
from fiber.vector.worker import Setup
from fiber.vector.worker_process import WorkerProcess


class Ended:
    """In place of a message: there will be no more from this worker."""


class WorkerSet:
    """A worker for each setup, by its index."""

    def __init__(self, setups: Sequence[Setup], context: BaseContext, owner: str) -> None:
        self._setups = setups
        self._context = context
        self._owner = owner
        self._workers: dict[int, WorkerProcess] = {}
        self._ended: deque[int] = deque()
        """Those of whose end we heard while we sent them something."""
        self._poller = select.epoll()
        self._index: dict[int, int] = {}
        """By descriptor."""

    def __getitem__(self, index: int) -> WorkerProcess:
        return self._workers[index]

    def start(self, index: int) -> None:
        """Start a worker, in place of one that was dropped if there was one."""
        worker = WorkerProcess(self._setups[index], self._context, self._owner)
        self._workers[index] = worker
        # A process that an environment has started may hold the connection open beyond the end of
        # the worker: that is told by the sentinel.
        for descriptor in (worker.connection.fileno(), worker.sentinel):
            self._index[descriptor] = index
            self._poller.register(descriptor, select.EPOLLIN)

    def drop(self, index: int) -> None:
        """Let go of a worker that has ended."""
        worker = self._workers.pop(index)
        self._forget(worker)
        worker.close(0)

    def send(self, index: int, data: bytes) -> None:
        """Send a pickled command; if the worker is gone, that is the next thing to be heard."""
        try:
            self._workers[index].connection.send_bytes(data)
        except OSError:
            self._ended.append(index)

    def receive(self, timeout: float) -> list[tuple[int, Any]]:
        """What workers say, each with its index; nothing after ``timeout`` seconds."""
        heard: list[tuple[int, Any]] = []
        for descriptor, _ in self._poller.poll(0 if self._ended else timeout):
            index = self._index[descriptor]
            worker = self._workers[index]
            if descriptor == worker.sentinel:
                heard += [(index, message) for message in _rest(worker)]
                self._ended.append(index)
            else:
                try:
                    heard.append((index, worker.connection.recv()))
                except (EOFError, OSError):
                    self._ended.append(index)
        while self._ended:
            index = self._ended.popleft()
            worker = self._workers[index]
            if self._forget(worker):
                heard.append((index, Ended()))
        return heard

    def close(self, timeout: float | None) -> None:
        """Wait until they have ended; kill those that have not when ``timeout`` is over."""
        while self._workers:
            _, worker = self._workers.popitem()
            self._forget(worker)
            worker.close(timeout)
        self._poller.close()

    def _forget(self, worker: WorkerProcess) -> bool:
        """Listen to it no more; False if that is so already."""
        descriptors = [fd for fd, index in self._index.items() if index == worker.setup.index]
        for descriptor in descriptors:
            del self._index[descriptor]
            self._poller.unregister(descriptor)
        return bool(descriptors)


def _rest(worker: WorkerProcess) -> list[Any]:
    """What a worker had said before it ended."""
    messages = []
    try:
        while worker.connection.poll():
            messages.append(worker.connection.recv())
    except (EOFError, OSError):
        pass
    return messages
