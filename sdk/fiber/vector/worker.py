"""The worker: a process with many environments, which steps them as it is told.

It is told by tuples ``(operation, generation, ...)`` and answers with tuples
``(generation, rows, results, notes, failures)``: which environments are done, what travels of what
they gave (nothing, where memory is shared), what else there is to say, and which of them failed.  A
command has one answer or, where ``together`` is not asked for, several: what is done does not wait
for an environment that is slow.
"""

from __future__ import annotations

import faulthandler
import pickle
import signal
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from gymnasium.vector import AutoresetMode

from fiber import reduction
from fiber._hub import client
from fiber.connection import Connection
from fiber.errors import FiberError, UnpicklableError
from fiber.vector.arrays import Packed, Shape, StepArrays
from fiber.vector.memory import SharedMemory
from fiber.vector.slot import MakeEnv, Note, Slot

REPORT_AFTER = 200e-6
"""Seconds that what is done may wait for more, so that many quick steps make one message."""


class Setup(NamedTuple):
    """What a worker is to be."""

    index: int
    first: int
    """The number of its first environment; rows count from there."""
    makes: Sequence[MakeEnv]
    autoreset: AutoresetMode
    restart: bool
    """Whether an environment that raises is made anew."""
    timeout: float | None
    """Seconds for a step or reset of one environment."""


class Hello(NamedTuple):
    """What a worker says first."""

    host: str
    metadata: dict[str, Any]
    render_mode: str | None
    spaces: list[tuple[Any, Any]]
    """Observation and action space of each environment."""


class Begin(NamedTuple):
    """What it is told then."""

    shape: Shape
    """That of its own environments, or of all if there is ``memory``."""
    memory: SharedMemory | None
    last: Packed | None = None
    """What was last seen of the environments of a worker that this one stands in for."""
    lost: str | None = None
    """What became of that worker."""


class Failure(NamedTuple):
    """An operation of one environment that raised."""

    row: int
    doing: str
    error: bytes
    """The pickled exception."""
    trace: str

    @classmethod
    def of(cls, row: int, doing: str, error: BaseException) -> Failure:
        """The failure that ``error`` is."""
        trace = "".join(traceback.format_exception(error))
        return cls(row, doing, _pickled(error), trace)


def serve(connection: Connection, setup: Setup) -> None:
    """The target of a worker process."""
    if setup.timeout is not None:
        _die_of_alarms()
    slots: list[Slot] = []
    for row, make in enumerate(setup.makes):
        try:
            slots.append(Slot(row, make, setup.autoreset))
        except Exception as error:
            connection.send(Failure.of(row, "being made", error))
            return
    try:
        connection.send(_hello(slots))
        begin: Begin = connection.recv()
        Worker(connection, setup, slots, begin).run()
    except (EOFError, BrokenPipeError):
        pass  # whoever wants them stepped is gone
    finally:
        for slot in slots:
            slot.env.close()


class Worker:
    """Does what it is told until its connection ends."""

    def __init__(
        self, connection: Connection, setup: Setup, slots: Sequence[Slot], begin: Begin
    ) -> None:
        self._connection = connection
        self._setup = setup
        self._slots = slots
        self._all = range(len(slots))
        self._took = [0.0] * len(slots)
        """Seconds that each environment's last step took."""
        self._shared = begin.memory is not None
        if begin.memory is None:
            self._arrays = StepArrays.private(begin.shape)
            self._at_work = None
        else:
            arrays = StepArrays.of_memory(begin.shape, begin.memory.view)
            self._arrays = arrays.part(setup.first, len(slots))
            self._at_work = arrays.at_work
        self._arrays.unpack(slice(None), begin.last)
        if begin.lost is not None:
            for slot in slots:
                slot.lose(begin.lost)
        self._operations: dict[str, Callable[..., None]] = {
            "apply": self._apply,
            "reset": self._reset,
            "step": self._step,
        }

    def run(self) -> None:
        """Until the end of the connection, or until told."""
        while True:
            operation, *arguments = self._connection.recv()
            if operation == "close":
                break
            self._operations[operation](*arguments)
            self._rest()

    # Operations

    def _step(
        self, generation: int, rows: Sequence[int] | None, actions: Any, together: bool
    ) -> None:
        """``actions``: None where they are in the arrays already, a list, or packed."""
        arrays, slots = self._arrays, self._slots
        if isinstance(actions, list):
            chosen = dict(zip(self._all if rows is None else rows, actions, strict=True))

            def step(row: int) -> Note | None:
                return slots[row].step(chosen[row], arrays)
        else:
            if actions is not None:
                (packed,) = actions
                arrays.actions.unpack(slice(None) if rows is None else rows, packed)
            action_of = arrays.actions.get

            def step(row: int) -> Note | None:
                return slots[row].step(action_of(row), arrays)

        self._each(generation, rows, step, "step", together)

    def _reset(
        self,
        generation: int,
        rows: Sequence[int] | None,
        seeds: Sequence[int | None],
        options: Sequence[dict[str, Any] | None],
        together: bool,
    ) -> None:
        arguments = dict(
            zip(
                self._all if rows is None else rows,
                zip(seeds, options, strict=True),
                strict=True,
            )
        )

        def reset(row: int) -> Note | None:
            return self._slots[row].reset(self._arrays, *arguments[row])

        self._each(generation, rows, reset, "reset", together)

    def _apply(
        self,
        generation: int,
        rows: Sequence[int],
        function: Callable[..., Any],
        arguments: Sequence[tuple[Any, ...]],
    ) -> None:
        """``function(environment, ...)`` for each: the results are what it returns."""
        results, failures = [], []
        for row, mine in zip(rows, arguments, strict=True):
            try:
                results.append(function(self._slots[row].env, *mine))
            except Exception as error:
                failures.append(Failure.of(row, "a call", error))
        try:
            self._connection.send((generation, rows, results, [], failures))
        except UnpicklableError as error:
            told = Failure.of(rows[0], "a call", error)
            self._connection.send((generation, rows, [], [], [told]))

    # What they have in common

    def _each(
        self,
        generation: int,
        rows: Sequence[int] | None,
        operation: Callable[[int], Note | None],
        doing: str,
        together: bool,
    ) -> None:
        report = _Report(generation)
        clock = time.perf_counter
        for row in self._all if rows is None else rows:
            began = clock()
            if report.rows and not together and began + self._took[row] > report.due:
                self._send(report)
                report = _Report(generation)
            self._note_work(row)
            try:
                note = operation(row)
            except Exception as error:
                note = self._failed(row, operation, doing, error, report)
            if note is not None:
                report.notes.append(note)
            now = clock()
            self._took[row] = now - began
            if not report.rows:
                report.due = now + REPORT_AFTER
            report.rows.append(row)
        self._send(report, whole=rows is None and len(report.rows) == len(self._all))

    def _failed(
        self,
        row: int,
        operation: Callable[[int], Note | None],
        doing: str,
        error: Exception,
        report: _Report,
    ) -> Note | None:
        """Try again with a new environment, if that is wished; else tell."""
        if self._setup.restart:
            why = "".join(traceback.format_exception_only(error)).strip()
            try:
                self._slots[row].make_anew(f"{doing} raised {why}")
                return operation(row)
            except Exception as again:
                again.__cause__ = error
                error = again
        report.failures.append(Failure.of(row, doing, error))
        return None

    def _note_work(self, row: int) -> None:
        if self._at_work is not None:
            self._at_work[self._setup.index] = row + 1
        if self._setup.timeout is not None:
            signal.setitimer(signal.ITIMER_REAL, self._setup.timeout)

    def _rest(self) -> None:
        if self._at_work is not None:
            self._at_work[self._setup.index] = 0
        if self._setup.timeout is not None:
            signal.setitimer(signal.ITIMER_REAL, 0)

    def _send(self, report: _Report, *, whole: bool = False) -> None:
        try:
            self._connection.send(report.message(self._arrays, whole=whole, shared=self._shared))
        except UnpicklableError:
            self._blame(report)
            self._connection.send(report.message(self._arrays, whole=False, shared=self._shared))

    def _blame(self, report: _Report) -> None:
        """Some of it does not pickle: those environments have failed."""
        notes = {note.row: note for note in report.notes}
        for row in list(report.rows):
            told = notes.get(row), self._arrays.observations.pack([row], shared=True)
            try:
                reduction.dumps(told)
            except Exception as error:
                report.fail(Failure.of(row, "an answer that cannot be pickled", error))


class _Report:
    """What is done of a command and was not told yet."""

    __slots__ = ("due", "failures", "generation", "notes", "rows")

    def __init__(self, generation: int) -> None:
        self.generation = generation
        self.rows: list[int] = []
        self.notes: list[Note] = []
        self.failures: list[Failure] = []
        self.due = 0.0

    def fail(self, failure: Failure) -> None:
        """One of them cannot be told."""
        self.rows.remove(failure.row)
        self.notes = [note for note in self.notes if note.row != failure.row]
        self.failures.append(failure)

    def message(self, arrays: StepArrays, *, whole: bool, shared: bool) -> tuple[Any, ...]:
        """The answer; ``whole``: all environments of the worker are in it."""
        packed = arrays.pack(slice(None) if whole else self.rows, shared=shared)
        rows = None if whole else self.rows
        return self.generation, rows, packed, self.notes, self.failures


def _hello(slots: Iterable[Slot]) -> Hello:
    envs = [slot.env for slot in slots]
    spaces = [(env.observation_space, env.action_space) for env in envs]
    return Hello(client.host(), dict(envs[0].metadata), envs[0].render_mode, spaces)


def _die_of_alarms() -> None:
    """An alarm ends this process, whatever holds the interpreter, and shows where it was."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    faulthandler.register(signal.SIGALRM, file=2, all_threads=True, chain=True)


def _pickled(error: BaseException) -> bytes:
    """The exception, or what can be said of one that does not survive pickling."""
    try:
        data = reduction.dumps(error)
        pickle.loads(data)
    except Exception:
        return pickle.dumps(FiberError("".join(traceback.format_exception_only(error)).strip()))
    return data
