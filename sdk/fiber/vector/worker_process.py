"""Worker on the side of the learner: its process, its connection and its commands."""

from __future__ import annotations

import contextlib
import time
from multiprocessing import TimeoutError as TookTooLong
from typing import Any, NamedTuple

from fiber import reduction
from fiber.connection import Connection, Pipe
from fiber.context import BaseContext
from fiber.errors import UnpicklableError, WorkerDied, block
from fiber.process import Process
from fiber.resources import largest, resources_of, with_resources
from fiber.vector.arrays import StepArrays
from fiber.vector.worker import Hello, Setup, serve

NEWS = 2.0
"""Seconds that the news of a process's end may take after that of its connection."""

GRACE = 5.0
"""Seconds beyond the limits of its environments after which a worker counts as stuck."""

LIMITS_OF_A_RESTART = 4
"""Number of times that ``timeout`` may pass for an environment that is made anew: for its step, its
end, the making of the new one, and the step of that.
"""


class Pending(NamedTuple):
    """Command that an environment has not answered yet."""

    operation: str
    seed: int | None = None
    options: dict[str, Any] | None = None


class WorkerProcess:
    """Worker whose process is started anew if it dies."""

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
        self.hello: Hello | None = None
        self.generation = 0
        """Number of the present generation of commands.  Answers to earlier ones are ignored."""
        self.pending: dict[int, Pending] = {}
        """Unanswered commands by row."""
        self.results: list[Any] | None = None
        """Results of the last call of methods; None while they are awaited."""
        self.deadline: float | None = None
        self.stuck = False
        """True if the worker was killed because its deadline had passed."""
        self.deaths = 0
        """Number of its processes that died since the last answer, and not by the cluster."""
        self.disruptions = 0
        """Number of its processes that the cluster ended, or that moved, since the last answer."""
        self.disrupted = False
        """True if the cluster ended the process before this one."""
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
            except BaseException as error:
                self.connection.close()
                if isinstance(error, UnpicklableError):
                    self._check_pickling()
                raise

    def leaving(self) -> str:
        """Return why the host of its process is about to go; empty if the host stays."""
        popen: Any = self.process._popen
        return str(popen.leaving)

    def whose(self) -> str:
        """Return the names of the worker's environments, for messages."""
        first, last = self.numbers[0], self.numbers[-1]
        return f"environment {first}" if first == last else f"environments {first} to {last}"

    def death(self, row: int | None) -> Exception:
        """Count the end of the process, and return the error that tells of it.

        ``row`` was at work then, if that is known.
        """
        told = next(iter(self.pending.values()), None) if self.hello else None
        doing = told.operation if told else "a call" if self.hello else "the making"
        whose = self.whose() if row is None else f"environment {self.numbers[row]}"
        self.process.join(NEWS)
        if self.process.exitcode is None:
            self.process.kill()  # its connection is lost: nothing that it does reaches us
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
                f"and nothing but its end stopped worker {self.name!r}"
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
        self.pending.clear()
        self.deadline = None

    def set_deadline(self) -> None:
        """Set the time by which the worker must have answered the remaining commands."""
        timeout, told = self.setup.timeout, len(self.pending)
        self.deadline = None
        if timeout is not None and told:
            limits = told * (LIMITS_OF_A_RESTART if self.setup.restart else 1)
            self.deadline = time.monotonic() + limits * timeout + GRACE

    def kill_if_stuck(self) -> None:
        """Kill the worker if its deadline has passed.

        Mostly the worker's own alarm ends a slow environment.  That fails where native code holds
        the interpreter, and where the process is stopped or out of reach.
        """
        if self.deadline is not None and self.deadline < time.monotonic():
            self.deadline = None
            self.stuck = True
            popen: Any = self.process._popen
            popen.kill_with_stack()

    def hang_up(self, *, kill: bool) -> None:
        """Close the connection, at which the worker ends.  ``kill`` ends it at once."""
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
