"""Worker: a process that steps many environments by command.

A command is a tuple ``(operation, generation, rows, ...)``.  With ``together`` it has one answer.
Otherwise it may have several, so that finished environments do not wait for a slow one.
"""

from __future__ import annotations

import contextlib
import pickle
import signal
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from multiprocessing import TimeoutError as TookTooLong
from types import FrameType
from typing import Any, NamedTuple

from gymnasium.vector import AutoresetMode

from fiber import reduction
from fiber._agent.exception_pickles import encode_error
from fiber._exceptions import add_note
from fiber._hub import client
from fiber._wire import packet
from fiber._wire.packet import Message
from fiber.connection import Connection
from fiber.vector.arrays import ArrayLayout, ArrayMemory, Packed, StepArrays, in_band
from fiber.vector.slot import MakeEnv, Note, Slot

REPORT_AFTER, REPORT_AFTER_ELSEWHERE = 200e-6, 2e-3
"""Seconds that finished environments may wait for more, so that many quick steps make one message.
The first is for a learner on this host, the second for one on another host.
"""

WEIGHT = 0.1
"""Weight of the last step in the expected duration of an environment's step."""


CLOSE = "close"
"""Operation that ends the worker."""

_UNPICKLABLE = "an answer that cannot be pickled"


class Setup(NamedTuple):
    """Description of a worker."""

    worker: int
    first: int
    """Number of the worker's first environment.  Rows count from there."""
    makes: Sequence[MakeEnv]
    autoreset: AutoresetMode
    restart: bool
    """True if an environment that raises is replaced."""
    timeout: float | None
    """Seconds for the making, a step or a reset of one environment."""


class WorkerHello(NamedTuple):
    """First message of a worker."""

    host: str
    metadata: dict[str, Any]
    render_mode: str | None
    spaces: list[tuple[Any, Any]]
    """Observation and action space of each environment."""


class Begin(NamedTuple):
    """First message to a worker, after its ``WorkerHello``."""

    shape: ArrayLayout
    """Shape for the worker's environments, or for all of them if there is ``memory``."""
    memory: ArrayMemory | None
    last: Packed | None = None
    """Last results of the worker that this one replaces."""
    lost: str | None = None
    """Reason why the replaced worker ended."""


class Answer(NamedTuple):
    """Answer of a worker to steps and resets."""

    generation: int
    rows: Sequence[int] | None
    """Rows of the finished environments; None means all of the worker."""
    packed: Packed | None
    notes: Sequence[Note]
    failures: Sequence[EnvironmentFailure]
    """Failures of environments that are not among ``rows``."""


class Results(NamedTuple):
    """Answer of a worker to a call of methods."""

    generation: int
    values: list[Any]
    failures: Sequence[EnvironmentFailure]


def serve(connection: Connection, setup: Setup) -> None:
    """Serve a learner: the target of a worker process."""
    slots: list[Slot] = []
    try:
        if _make_all(connection, setup, slots):
            begin = connection.recv()
            if isinstance(begin, Begin):  # else the learner wants no environments
                EnvironmentWorker(connection, setup, slots, begin).run()
    except (EOFError, BrokenPipeError):
        pass  # the learner has ended, or has closed the environments
    finally:
        with contextlib.ExitStack() as ends:  # closes all, also if one raises
            for slot in reversed(slots):
                ends.callback(slot.close)


def _make_all(connection: Connection, setup: Setup, slots: list[Slot]) -> bool:
    """Make the environments and send WorkerHello; return False if one could not be made."""
    limit = _limit(setup)
    made: set[int] = set()
    spaces: list[tuple[Any, Any]] = []
    for row, make in enumerate(setup.makes):
        try:
            with limit:
                slots.append(Slot(row, make, setup.autoreset))
                _check_new(slots[-1], made)
                spaces.append((slots[row].env.observation_space, slots[row].env.action_space))
        except Exception as error:
            connection.send(EnvironmentFailure.of(row, "the making", error))
            return False
    env = slots[0].env
    metadata, mode = in_band(dict(env.metadata)), env.render_mode
    try:
        connection.send(WorkerHello(client.host(), metadata, mode, in_band(spaces)))
    except Exception as error:  # pickling runs code of the environments
        row = next((row for row, pair in enumerate(spaces) if not _pickles(pair)), 0)
        connection.send(
            EnvironmentFailure.of(row, "spaces or metadata that cannot be pickled", error)
        )
        return False
    return True


class EnvironmentWorker:
    """Loop that carries out commands until the connection ends."""

    def __init__(
        self, connection: Connection, setup: Setup, slots: Sequence[Slot], begin: Begin
    ) -> None:
        self._connection = connection
        self._setup = setup
        self._slots = slots
        self._all = range(len(slots))
        self._expected = [0.0] * len(slots)
        """Expected seconds of a step of each environment: a moving average."""
        self._exchange: Callable[[], Message] | None = None
        """Function that sends the last answer to a command, and returns the next command."""
        self._losses: dict[int, int] = {}
        """Times in a row that an environment was replaced without a success, by row."""
        self._limit = _limit(setup)  # after the environments, which may have set another alarm
        self._shared = begin.memory is not None
        self._report_after = REPORT_AFTER if self._shared else REPORT_AFTER_ELSEWHERE
        if begin.memory is None:
            self._arrays = StepArrays.private(begin.shape)
        else:
            arrays = StepArrays.of_memory(begin.shape, begin.memory.view)
            self._arrays = arrays.part(setup.first, len(slots))
        self._arrays.unpack(slice(None), begin.last)
        # If the arrays are private, no other process reads it.
        self._at_work = self._arrays.at_work
        if begin.lost is not None:
            for slot in slots:
                slot.lose(begin.lost)
        self._operations: dict[str, Callable[..., None]] = {
            "call": self._call,
            "reset": self._reset,
            "step": self._step,
        }

    def run(self) -> None:
        """Carry out commands until ``CLOSE``, or the end of the connection with EOFError."""
        while True:
            operation, *arguments = self._next_command()
            if operation == CLOSE:
                return
            self._operations[operation](*arguments)

    def _next_command(self) -> Any:
        exchange, self._exchange = self._exchange, None
        return self._connection.recv() if exchange is None else packet.loads(exchange())

    def _send_last(self, message: Answer | Results) -> None:
        """Pickle the last answer to a command.  It is sent as the next command is awaited."""
        self._exchange = self._connection._exchange(message)

    # Operations

    def _step(
        self, generation: int, rows: Sequence[int] | None, actions: Any, together: bool
    ) -> None:
        """Step environments.  ``actions``: None if the arrays have them, a list, or packed."""
        arrays, slots = self._arrays, self._slots
        if isinstance(actions, list):
            chosen = dict(zip(self._each(rows), actions, strict=True))
            action_of: Callable[[int], Any] = chosen.__getitem__
        else:
            if actions is not None:
                (packed,) = actions
                arrays.actions.unpack(slice(None) if rows is None else rows, packed)
            action_of = arrays.actions.get

        def step(row: int) -> Note | None:
            return slots[row].step(action_of(row), arrays)

        self._do(_Report(generation), rows, step, "step", together)

    def _reset(
        self,
        generation: int,
        rows: Sequence[int] | None,
        seeds: Sequence[int | None],
        options: Sequence[dict[str, Any] | None],
    ) -> None:
        arguments = dict(zip(self._each(rows), zip(seeds, options, strict=True), strict=True))

        def reset(row: int) -> Note | None:
            return self._slots[row].reset(self._arrays, *arguments[row])

        self._do(_Report(generation), rows, reset, "reset", together=False)

    def _call(
        self,
        generation: int,
        rows: Sequence[int] | None,
        method: str,
        arguments: Sequence[tuple[Any, ...]],
    ) -> None:
        """Call a method of each slot, and send the results."""
        values: dict[int, Any] = {}
        failures = []
        worker, at_work = self._setup.worker, self._at_work
        for row, mine in zip(self._each(rows), arguments, strict=True):
            at_work[worker] = row + 1
            try:
                values[row] = getattr(self._slots[row], method)(*mine)
            except Exception as error:
                failures.append(EnvironmentFailure.of(row, "a call", error))
        at_work[worker] = 0
        try:
            self._send_last(Results(generation, in_band(list(values.values())), failures))
        except Exception:  # pickling an answer may raise any class
            for row, refusal in _refused(values.items()):
                del values[row]
                failures.append(EnvironmentFailure.of(row, _UNPICKLABLE, refusal))
            self._send_last(Results(generation, in_band(list(values.values())), failures))

    # Parts of all operations

    def _each(self, rows: Sequence[int] | None) -> Sequence[int]:
        return self._all if rows is None else rows

    def _do(
        self,
        report: _Report,
        rows: Sequence[int] | None,
        operation: Callable[[int], Note | None],
        doing: str,
        together: bool,
    ) -> None:
        """Do an operation with each environment, and send the results.

        Results are sent as soon as the next environment is expected to delay them, or at the end if
        they are wanted ``together``.
        """
        clock = time.perf_counter
        send = partial(self._send, operation, doing)
        worker, at_work, limit = self._setup.worker, self._at_work, self._limit
        now = clock()
        for row in self._each(rows):
            began = now
            if report.rows and not together and began + self._expected[row] > report.due:
                send(report, whole=False)
                report = _Report(report.generation)
            at_work[worker] = row + 1
            try:
                with limit:
                    note = operation(row)
            except Exception as error:
                self._retry(row, operation, doing, error, report)
            else:
                report.add(row, note)
                if self._losses and (note is None or note.lost is None):
                    self._losses.pop(row, None)
            now = clock()
            self._expected[row] += WEIGHT * (now - began - self._expected[row])
            if len(report.rows) == 1:
                report.due = now + self._report_after
        at_work[worker] = 0
        whole = rows is None and len(report.rows) == len(self._all)
        send(report, whole=whole, last=True)

    def _retry(
        self,
        row: int,
        operation: Callable[[int], Note | None],
        doing: str,
        error: Exception,
        report: _Report,
        failed: str = "",
    ) -> None:
        """Try again with a new environment if ``restart`` is set, else report the failure."""
        losses = self._losses.get(row, 0) + 1
        if self._setup.restart and losses <= ATTEMPTS:
            self._losses[row] = losses
            try:
                with self._limit:
                    self._slots[row].replace_env(f"{doing} raised {summary(error)}")
                with self._limit:
                    note = operation(row)
            except Exception as again:
                again.__cause__ = error
                error = again
            else:
                report.add(row, note)
                return
        report.failures.append(EnvironmentFailure.of(row, failed or doing, error))

    def _send(
        self,
        operation: Callable[[int], Note | None],
        doing: str,
        report: _Report,
        *,
        whole: bool,
        last: bool = False,
    ) -> None:
        while True:
            try:
                answer = report.answer(self._arrays, whole=whole, shared=self._shared)
                if last:
                    self._send_last(answer)
                else:  # the next answer shows that this one has arrived
                    self._connection._send_unconfirmed(answer)
                return
            except Exception:  # pickling an answer may raise any class
                whole = False
                refused = self._refused(report)
                if not refused:
                    raise
            for row, error in refused:
                report.remove(row)
                if not _pickles(self._arrays.observations.pack([row], shared=self._shared)):
                    self._arrays.observations.take_back(row)
                self._at_work[self._setup.worker] = row + 1
                self._retry(row, operation, doing, error, report, _UNPICKLABLE)
            self._at_work[self._setup.worker] = 0

    def _refused(self, report: _Report) -> list[tuple[int, Exception]]:
        """Return the environments whose answers cannot be pickled, and why."""
        notes = {note.row: note for note in report.notes}
        pack = partial(self._arrays.observations.pack, shared=self._shared)
        return _refused((row, (notes.get(row), pack([row]))) for row in report.rows)


class _Report:
    """Finished part of a command that was not sent yet."""

    __slots__ = ("due", "failures", "generation", "notes", "rows")

    def __init__(self, generation: int) -> None:
        self.generation = generation
        self.rows: list[int] = []
        self.notes: list[Note] = []
        self.failures: list[EnvironmentFailure] = []
        self.due = 0.0

    def add(self, row: int, note: Note | None) -> None:
        """Add an environment that is done."""
        self.rows.append(row)
        if note is not None:
            self.notes.append(note)

    def remove(self, row: int) -> None:
        """Take out an environment whose answer cannot be sent."""
        self.rows.remove(row)
        self.notes = [note for note in self.notes if note.row != row]

    def answer(self, arrays: StepArrays, *, whole: bool, shared: bool) -> Answer:
        """Return the answer to send.  ``whole``: it has all environments of the worker."""
        packed = arrays.pack(slice(None) if whole else self.rows, shared=shared)
        rows = None if whole else self.rows
        notes = in_band(self.notes) if self.notes else ()
        return Answer(self.generation, rows, packed, notes, self.failures)


def _check_new(slot: Slot, made: set[int]) -> None:
    """Refuse an environment whose id is in ``made``: the ids of those that were made before."""
    newest = id(slot.env.unwrapped)
    if newest in made:
        raise ValueError(
            "the function returned an environment that it had returned before: make a new one at "
            "every call (`lambda: gymnasium.make(...)` instead of `lambda: env`)"
        )
    made.add(newest)


def _refused(answers: Iterable[tuple[int, Any]]) -> list[tuple[int, Exception]]:
    """Return the rows of the answers that cannot be pickled, each with the error."""
    refused = []
    for row, answer in answers:
        try:
            reduction.dumps(answer)
        except Exception as error:
            refused.append((row, error))
    return refused


def _limit(setup: Setup) -> contextlib.AbstractContextManager[None]:
    return contextlib.nullcontext() if setup.timeout is None else TimeLimit(setup.timeout)


def _pickles(obj: object) -> bool:
    try:
        reduction.dumps(obj)
    except Exception:
        return False
    return True


ATTEMPTS = 3
"""Number of times in a row that an environment is replaced without a success."""


class EnvironmentFailure(NamedTuple):
    """Error that one environment raised."""

    row: int
    doing: str
    error: bytes
    """The pickled exception."""

    @classmethod
    def of(cls, row: int, doing: str, error: BaseException) -> EnvironmentFailure:
        """Return the failure of the environment in ``row``.  Called in its worker."""
        return cls(row, doing, encode_error(error))

    def exception(self, whose: str) -> Exception:
        """Return the exception to raise, with a note that names the environment."""
        error: Exception = pickle.loads(self.error)
        add_note(error, f"{self.doing} of {whose}")
        return error


def summary(error: BaseException) -> str:
    """Return the last line of the traceback of ``error``, and where it was raised."""
    line = "".join(traceback.format_exception_only(error)).strip()
    frames = traceback.extract_tb(error.__traceback__)
    return f"{line} ({frames[-1].filename}:{frames[-1].lineno})" if frames else line


class TimeLimit:
    """Context that raises ``multiprocessing.TimeoutError`` in a block that takes too long.

    It uses an alarm (SIGALRM).  So it works only in a main thread, and only while Python code runs
    or a system call waits.  It cannot end native code that never returns.  The alarm is repeated,
    because the block may have caught the error.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._inside = False
        signal.signal(signal.SIGALRM, self._ring)

    def __enter__(self) -> None:
        self._inside = True
        signal.setitimer(signal.ITIMER_REAL, self._seconds, self._seconds)

    def __exit__(self, *_: object) -> None:
        self._inside = False  # first: an alarm may still ring
        signal.setitimer(signal.ITIMER_REAL, 0)

    def _ring(self, _signal: int, _frame: FrameType | None) -> None:
        if self._inside:
            raise TookTooLong(f"it took longer than {self._seconds:g} s (timeout)")
