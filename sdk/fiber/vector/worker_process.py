"""A worker as its learner sees it: its process, its connection, what it was told."""

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
"""Seconds beyond what its environments may take, after which a worker is taken for stuck."""

LIMITS_OF_A_RESTART = 4
"""How often ``timeout`` may pass for an environment that is made anew: the step, the end of the old
one, the making of the new one, its step.
"""


class Pending(NamedTuple):
    """What an environment was told and has not answered."""

    operation: str
    seed: int | None = None
    options: dict[str, Any] | None = None


class WorkerProcess:
    """A worker, whose process is started anew if it dies."""

    process: Process
    connection: Connection
    arrays: StepArrays
    """Those of its environments, once all have said hello."""

    def __init__(self, setup: Setup, context: BaseContext, owner: str) -> None:
        self.setup = setup
        self.name = f"{owner}-worker-{setup.worker}"
        self.numbers = range(setup.first, setup.first + len(setup.makes))
        """Its environments."""
        self._context = context
        self._wishes = largest(map(resources_of, setup.makes))
        self.hello: Hello | None = None
        self.generation = 0
        """Of commands: what came before it, nobody waits for any more."""
        self.pending: dict[int, Pending] = {}
        """By row."""
        self.results: list[Any] | None = None
        """Of the call of methods that it was told last; None while that is awaited."""
        self.deadline: float | None = None
        self.stuck = False
        """Killed, since the deadline was over."""
        self.deaths = 0
        """Of its processes since it answered anything, but for those that the cluster ended."""
        self.disruptions = 0
        """Of its processes that the cluster ended, or that moved, since it answered anything."""
        self.disrupted = False
        """Whether the cluster ended the process before this one."""
        self.lost: str | None = None
        """What became of the process before this one."""
        self.error: Exception | None = None
        """Why there is none any more."""

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
        """Its environments, for a person."""
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
        """Nobody waits any more for what it was told."""
        self.generation += 1
        self.pending.clear()
        self.deadline = None

    def set_deadline(self) -> None:
        """It has been told something, or has answered: until when it has to answer the rest."""
        timeout, told = self.setup.timeout, len(self.pending)
        self.deadline = None
        if timeout is not None and told:
            limits = told * (LIMITS_OF_A_RESTART if self.setup.restart else 1)
            self.deadline = time.monotonic() + limits * timeout + GRACE

    def kill_if_stuck(self) -> None:
        """Its own alarm ends what takes too long, unless that keeps the interpreter, or the process
        is stopped or out of reach.
        """
        if self.deadline is not None and self.deadline < time.monotonic():
            self.deadline = None
            self.stuck = True
            popen: Any = self.process._popen
            popen.kill_with_stack()

    def hang_up(self, *, kill: bool) -> None:
        """Have it end: now, or when it hears that nobody listens."""
        self.connection.close()
        if kill:
            with contextlib.suppress(ValueError):  # closed just before Ctrl-C
                self.process.kill()

    def close(self, timeout: float | None) -> None:
        """Wait for its end; kill it when ``timeout`` is over."""
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
    """Wait for the end of a process; kill it when ``timeout`` is over."""
    with contextlib.suppress(ValueError):  # closed just before Ctrl-C
        process.join(timeout)
        if process.exitcode is None:
            process.kill()
            process.join()
        process.close()
