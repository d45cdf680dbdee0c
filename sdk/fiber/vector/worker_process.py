"""A worker as its learner sees it: its process, its connection, what became of it."""

from __future__ import annotations

import signal
from multiprocessing import TimeoutError as WaitedTooLong
from typing import Any

from fiber import reduction
from fiber.connection import Pipe
from fiber.context import BaseContext
from fiber.errors import UnpicklableError, WorkerDied
from fiber.process import Process
from fiber.vector.worker import Setup, serve

_NEWS = 2.0
"""Seconds that the news of a process's end may take after that of its connection."""


class WorkerProcess:
    """One worker process; another one takes its place if it dies."""

    def __init__(self, setup: Setup, context: BaseContext, owner: str) -> None:
        self.setup = setup
        self.name = f"{owner}-worker-{setup.index}"
        self.numbers = range(setup.first, setup.first + len(setup.makes))
        """Its environments."""
        self.connection, theirs = Pipe()
        with theirs:
            self.process: Process = context.Process(
                target=serve, args=(theirs, setup), name=self.name, daemon=True
            )
            try:
                self.process.start()
            except UnpicklableError:
                self.connection.close()
                self._check_pickling()
                raise
            except BaseException:
                self.connection.close()
                raise

    @property
    def sentinel(self) -> int:
        """A descriptor that is readable once the process has ended."""
        return self.process.sentinel

    def place(self) -> str:
        """Where it is, for a person."""
        return f"worker {self.name!r}"

    def send(self, data: bytes) -> None:
        """Send a pickled command; OSError if the worker is gone."""
        self.connection.send_bytes(data)

    def died(self, doing: str, row: int | None) -> Exception:
        """The error that tells of its end, in which ``row`` was at work, if that is known."""
        if row is not None:
            what = f"{doing} of environment {self.setup.first + row}"
        else:
            what = f"{doing} of {self.whose()}"
        self.process.join(_NEWS)
        if self.process.exitcode is None:
            self.process.kill()  # its connection is lost: nothing that it does reaches us
            self.process.join(_NEWS)
        popen: Any = self.process._popen
        report = popen.report
        if report is None:
            return WorkerDied(
                task=what,
                worker=self.name,
                host="?",
                pid=self.process.pid,
                exitcode=None,
                reason="its connection is lost",
            )
        timeout = self.setup.timeout
        if timeout is not None and report.exitcode == -signal.SIGALRM:
            return hung(what, timeout, self, report.log)
        return WorkerDied(
            task=what,
            worker=self.name,
            host=report.host,
            pid=self.process.pid,
            exitcode=report.exitcode,
            reason=report.reason,
            log=report.log,
            pod=report.pod or None,
            node=report.node or None,
        )

    def whose(self) -> str:
        """Its environments, for a person."""
        first, last = self.numbers[0], self.numbers[-1]
        return f"environment {first}" if first == last else f"environments {first} to {last}"

    def close(self, timeout: float | None) -> None:
        """Wait for its end; kill it when ``timeout`` is over."""
        self.connection.close()
        self.process.join(timeout)
        if self.process.exitcode is None:
            self.process.kill()
            self.process.join()
        self.process.close()

    def _check_pickling(self) -> None:
        for number, make in zip(self.numbers, self.setup.makes, strict=True):
            try:
                reduction.dumps(make)
            except Exception as error:
                what = f"the function that makes environment {number}, of {self.place()},"
                raise UnpicklableError(what, str(error)) from error


def hung(
    what: str, timeout: float, worker: WorkerProcess, log: tuple[str, ...] = ()
) -> WaitedTooLong:
    """The error of an environment that took too long."""
    message = (
        f"{what} did not end within {timeout:g} s (timeout), so {worker.place()} was killed. "
        "Allow it more time, or find out where it hangs"
    )
    if log:
        message += ". Where it was:\n" + "\n".join(f"  | {line}" for line in log)
    return WaitedTooLong(message)
