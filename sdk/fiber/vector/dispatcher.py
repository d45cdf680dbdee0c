"""Dispatch of commands to environments, their answers, and the replacement of failed workers."""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from multiprocessing import TimeoutError as WaitedTooLong
from typing import Any, NamedTuple

from fiber import reduction
from fiber._exceptions import add_note, fresh
from fiber._transport.loop import DOZE
from fiber.errors import StartError
from fiber.process import Process
from fiber.vector.arrays import ArrayLayout, ArrayMemory, StepArrays
from fiber.vector.slot import Note
from fiber.vector.worker import (
    ATTEMPTS,
    Answer,
    Begin,
    EnvironmentFailure,
    Results,
    WorkerHello,
)
from fiber.vector.worker_process import (
    Ended,
    PendingCommand,
    Unreadable,
    WorkerGroup,
    WorkerProcess,
)

_STEP = PendingCommand("step")

_PACKAGE = os.path.dirname(__file__)

_SHOWN = 3
"""Number of other failures that the error of the first one shows."""


class Dispatcher:
    """Dispatcher of commands to workers.  Environments are known by their numbers.

    ``restart``: environments of a worker that has died are replaced.  Environments of a worker that
    the cluster ended are replaced in any case, ``disruptions`` times in a row at most.
    """

    def __init__(self, workers: WorkerGroup, *, restart: bool, disruptions: int) -> None:
        self._workers = workers
        self._worker_of = [worker for worker in workers for _ in worker.numbers]
        self._restart = restart
        self._disruptions = disruptions
        self._calls: list[_CommandPart] = []
        """Parts of the last call of methods."""
        self._ready: deque[int] = deque()
        self._notes: dict[int, Note] = {}
        self._failures: list[tuple[int, Exception]] = []
        """Errors to raise, each with the number of an environment."""
        self._replacements: deque[_Replacement] = deque()
        """Workers whose next process is not started yet."""
        self._warnings: list[str] = []
        self._begun = False
        self._next_check = 0.0
        """Time from which on workers are checked again for one that is stuck."""

    # Beginning and end

    def start(self) -> None:
        """Start the workers and wait until each has its environments."""
        for worker in self._workers:
            self._workers.start(worker)
        self._wait(self._all_there, None)

    def begin(self, shape: ArrayLayout, arrays: StepArrays, memory: ArrayMemory | None) -> None:
        """Give the workers the arrays; workers of this host share ``memory``."""
        self._shape, self._arrays, self._memory = shape, arrays, memory
        self._begun = True
        for worker in self._workers:
            worker.arrays = arrays.part(worker.setup.first, len(worker.numbers))
            self._begin(worker)

    def close(self, timeout: float | None) -> None:
        """End the workers; kill those that have not ended when ``timeout`` is over."""
        self._workers.close(timeout)

    # Commands.  All parts of a command are pickled before the first is sent.

    def step(self, numbers: Sequence[int] | None, actions: Any, *, together: bool) -> None:
        """Step some environments, or all.

        ``actions``: a list with one for each, or None if they are in the arrays.  ``together``: the
        caller waits for all of them.
        """
        self._move_idle_workers()
        commands = []
        command_of_all = cache(partial(_command_of_all, together))
        for group in self._groups(numbers):
            worker, rows = group.worker, group.rows
            if actions is None and rows is None and self._shares(worker):
                data = command_of_all(worker.generation)
            else:
                payload = self._step_payload(group, actions)
                data = _encoded(worker, "step", rows, payload, together)
            commands.append((group, dict.fromkeys(group.each(), _STEP), data))
        self._send_commands(commands)

    def reset(
        self,
        numbers: Sequence[int] | None,
        seeds: Sequence[int | None],
        options: Sequence[dict[str, Any] | None],
    ) -> None:
        """Reset some environments, or all, with a seed and options for each."""
        self._move_idle_workers()
        commands = []
        for group in self._groups(numbers):
            pending = {
                row: PendingCommand("reset", seeds[position], options[position])
                for row, position in zip(group.each(), group.positions, strict=True)
            }
            commands.append((group, pending, _reset_command(group.worker, group.rows, pending)))
        self._send_commands(commands)

    def call(
        self, numbers: Sequence[int], method: str, arguments: Sequence[tuple[Any, ...]]
    ) -> None:
        """Call ``Slot.method(*arguments)``, with arguments for each environment."""
        self._move_idle_workers()
        self._wait(self._all_there, None)
        groups = self._groups(numbers)
        commands = []
        for group in groups:
            mine = [arguments[position] for position in group.positions]
            no_steps: dict[int, PendingCommand] = {}
            data = _encoded(group.worker, "call", group.rows, method, mine)
            commands.append((group, no_steps, data))
        for group in groups:
            group.worker.results = None
        self._calls = groups
        self._send_commands(commands)

    # Answers

    def wait(self, timeout: float | None = None) -> None:
        """Wait until all environments have answered; raise the error of the first that failed."""
        self._wait(_all_are(self._workers, lambda worker: not worker.pending), timeout)
        self._ready.clear()

    def wait_for(self, count: int, timeout: float | None = None) -> list[int]:
        """Return the numbers of the ``count`` environments that answered first."""
        self._wait(lambda: len(self._ready) >= count or bool(self._failures), timeout)
        return [self._ready.popleft() for _ in range(count)]

    def results(self, timeout: float | None = None) -> list[Any]:
        """Return the results of ``call``, in its order."""
        calls = self._calls
        called = [group.worker for group in calls]
        self._wait(_all_are(called, lambda worker: worker.results is not None), timeout)
        by_position: dict[int, Any] = {}
        for group in calls:
            by_position |= zip(group.positions, group.worker.results or (), strict=True)
        return [by_position[position] for position in range(len(by_position))]

    def reads_old_actions(self) -> bool:
        """Return whether a worker may still read the shared actions of a step that was given up."""
        return any(worker.is_behind for worker in self._workers)

    def under_way(self) -> int:
        """Return the number of environments whose answer has not come, or was not collected."""
        return len(self._ready) + sum(len(worker.pending) for worker in self._workers)

    def busy(self, numbers: Iterable[int]) -> int | None:
        """Return the first of ``numbers`` that ``under_way`` counts; None if there is none."""
        ready = set(self._ready)
        for number in numbers:
            worker = self._worker_of[number]
            if number - worker.setup.first in worker.pending or number in ready:
                return number
        return None

    def notes(self, numbers: Iterable[int] | None = None) -> list[tuple[int, Note]]:
        """Return the notes of all environments in order, or of ``numbers`` in their order."""
        if numbers is None:
            numbers = sorted(self._notes)
        return [(number, self._notes.pop(number)) for number in numbers if number in self._notes]

    def abandon(self) -> None:
        """Ignore the answers to all commands so far."""
        for worker in self._workers:
            worker.give_up()
        self._calls = []
        self._ready.clear()
        self._notes.clear()
        self._failures.clear()

    def name(self, number: int) -> str:
        """Return the name of an environment, for messages."""
        return f"environment {number}, of worker {self._worker_of[number].name!r}"

    def _all_there(self) -> bool:
        return all(worker.hello or worker.error for worker in self._workers)

    # Sending

    def _groups(self, numbers: Sequence[int] | None) -> list[_CommandPart]:
        """Return the parts of a command, by worker; raise the error of a worker given up."""
        if numbers is None:
            groups = [_CommandPart(worker, None, worker.numbers) for worker in self._workers]
        else:
            by_name: dict[str, tuple[WorkerProcess, list[int], list[int]]] = {}
            for position, number in enumerate(numbers):
                worker = self._worker_of[number]
                _, rows, positions = by_name.setdefault(worker.name, (worker, [], []))
                rows.append(number - worker.setup.first)
                positions.append(position)
            groups = [_CommandPart(*group) for group in by_name.values()]
        for group in groups:
            if group.worker.error is not None:
                raise fresh(group.worker.error)
        return groups

    def _step_payload(self, group: _CommandPart, actions: Any) -> Any:
        """Return the actions to send; None if the worker has them in the shared arrays."""
        if actions is not None:
            return [actions[position] for position in group.positions]
        if self._shares(group.worker):
            return None
        where = slice(None) if group.rows is None else group.rows
        return (group.worker.arrays.actions.pack(where, shared=False),)

    def _send_commands(
        self, commands: Iterable[tuple[_CommandPart, dict[int, PendingCommand], bytes]]
    ) -> None:
        for group, pending, data in commands:
            group.worker.pending.update(pending)
            # A worker that is being started gets its commands in ``_resume``.
            if group.worker.hello is not None:
                self._send(group.worker, data)

    def _send(self, worker: WorkerProcess, data: bytes) -> None:
        self._workers.send(worker, data)
        worker.set_deadline()

    def _begin(self, worker: WorkerProcess) -> None:
        """Send the arrays to a worker that has made its environments, once."""
        if worker.has_arrays:
            return  # an interrupt came afterwards
        memory = self._memory if self._shares(worker) else None
        shape = self._shape if memory else self._shape._replace(num_envs=len(worker.numbers))
        last = worker.arrays.pack(slice(None), shared=bool(memory)) if worker.lost else None
        begin = Begin(shape, memory, last, worker.lost)
        self._workers.send(worker, reduction.dumps(begin))
        worker.has_arrays = True

    def _shares(self, worker: WorkerProcess) -> bool:
        memory, hello = self._memory, worker.hello
        return memory is not None and hello is not None and hello.host == memory.host

    # Receiving

    def _wait(self, enough: Callable[[], bool], timeout: float | None) -> None:
        """Wait until ``enough``; raise the first failure."""
        deadline = None if timeout is None else time.monotonic() + timeout
        self._start_replacements()  # those that an interrupt has prevented
        while not enough():
            left = DOZE if deadline is None else min(DOZE, deadline - time.monotonic())
            if left < 0:
                raise WaitedTooLong(f"not all environments answered within {timeout:g} s")
            was_silent = not self._receive(left)
            self._kill_stuck_workers()
            if was_silent:  # else a step is in progress, which a move would delay
                self._move_idle_workers()
            self._show_warnings()
        self._show_warnings()
        self._raise_failure()

    def _receive(self, timeout: float) -> bool:
        """Receive messages and deal with them; return False if none comes in ``timeout`` seconds.

        An interrupt does not lose a message: the next call deals with it again.
        """
        received = self._workers.received
        if not received:
            self._workers.receive(timeout)
        has_received = bool(received)
        while received:
            worker, message = received[0]
            try:
                self._on_message(worker, message)
            except Exception:
                if not isinstance(message, Ended):
                    received.popleft()
                raise
            received.popleft()
        return has_received

    def _kill_stuck_workers(self) -> None:
        now = time.monotonic()
        if now >= self._next_check:
            self._next_check = now + DOZE
            for worker in self._workers:
                worker.kill_if_stuck()

    def _on_message(self, worker: WorkerProcess, message: Any) -> None:
        match message:
            case Ended():
                self._on_process_end(worker, message.process)
            case WorkerHello():
                worker.hello, worker.is_behind = message, False
                if self._begun:
                    self._resume(worker)
            case EnvironmentFailure():
                self._lose(worker, self._numbered(worker, message)[1])
            case Unreadable():
                self._blame(worker, message.error)
            case Answer() | Results():
                if not _only_reports_losses(message):
                    worker.deaths = worker.disruptions = 0
                if message.generation == worker.generation:
                    worker.is_behind = False
                    self._failures += [self._numbered(worker, each) for each in message.failures]
                    if isinstance(message, Answer):
                        self._answer(worker, message)
                    else:
                        worker.results = message.values

    def _answer(self, worker: WorkerProcess, answer: Answer) -> None:
        first, rows, pending = worker.setup.first, answer.rows, worker.pending
        if rows is None:
            worker.arrays.unpack(slice(None), answer.packed)
            pending.clear()
            self._ready.extend(worker.numbers)
        else:
            worker.arrays.unpack(rows, answer.packed)
            for row in rows:
                del pending[row]
                self._ready.append(first + row)
        for failure in answer.failures:
            pending.pop(failure.row, None)
        for note in answer.notes:
            self._notes[first + note.row] = note
            if note.lost not in (None, worker.lost):
                number = first + note.row
                self._warnings.append(f"environment {number} replaced: {note.lost}")
        worker.set_deadline()

    def _blame(self, worker: WorkerProcess, error: Exception) -> None:
        """Note an answer that cannot be unpickled, whose environments are unknown."""
        whose = f"{worker.whose()}, of worker {worker.name!r},"
        add_note(error, f"an answer of {whose} cannot be unpickled")
        if worker.hello is None:
            self._lose(worker, error)
            return
        worker.results = []
        worker.give_up()  # also the later answers to these commands
        self._failures.append((worker.setup.first, error))

    def _numbered(
        self, worker: WorkerProcess, failure: EnvironmentFailure
    ) -> tuple[int, Exception]:
        number = worker.setup.first + failure.row
        return number, failure.exception(self.name(number))

    def _raise_failure(self) -> None:
        if self._failures:
            (_, error), *others = sorted(self._failures, key=lambda failure: failure[0])
            for _, other in others[:_SHOWN]:
                for note in getattr(other, "__notes__", ()) or (str(other),):
                    add_note(error, f"failed, too: {note}")
            if len(others) > _SHOWN:
                add_note(error, f"not shown: {len(others) - _SHOWN} more errors of environments")
            self._failures.clear()
            raise fresh(error)

    # Ends

    def _on_process_end(self, worker: WorkerProcess, process: Process) -> None:
        """Note that the process of a worker has ended."""
        if worker.error is not None:
            return  # it sent the reason before
        if worker.process is not process or self._is_being_replaced(worker):
            return  # an interrupt came when nearly all was done
        error = worker.death(self._at_work(worker))
        if not self._may_be_replaced(worker):
            self._lose(worker, error)
            return
        if self._is_called(worker):
            # The methods of the call that have run are unknown.
            worker.results = []
            self._failures.append((worker.setup.first, error))
        self._replace(worker, self._workers.drop, str(error), error)
        self._warnings.append(f"{worker.whose()} replaced: {error}")

    def _may_be_replaced(self, worker: WorkerProcess) -> bool:
        if worker.disrupted:
            return worker.disruptions <= self._disruptions
        return self._begun and self._restart and worker.deaths <= ATTEMPTS

    def _replace(
        self,
        worker: WorkerProcess,
        let_go: Callable[[WorkerProcess], None],
        why: str,
        error: Exception,
    ) -> None:
        """Start another process for the worker's environments; if that fails, report ``error``."""
        worker.hello, worker.deadline = None, None
        worker.lost = why if self._begun else None
        self._replacements.append(_Replacement(worker, let_go, error))
        self._start_replacements()

    def _start_replacements(self) -> None:
        """Start the processes.  After an interrupt, the next call goes on."""
        while self._replacements:
            worker, let_go, error = self._replacements[0]
            try:
                if not worker.is_released:
                    let_go(worker)
                    worker.is_released = True
                self._workers.start(worker)
            except Exception:
                self._replacements.popleft()
                self._lose(worker, error)
                raise
            self._replacements.popleft()

    def _is_being_replaced(self, worker: WorkerProcess) -> bool:
        return any(each.worker is worker for each in self._replacements)

    def _is_called(self, worker: WorkerProcess) -> bool:
        return any(group.worker is worker and worker.results is None for group in self._calls)

    def _lose(self, worker: WorkerProcess, error: Exception) -> None:
        """Give up the worker, and its environments with it."""
        worker.error = error
        worker.results = []
        worker.give_up()
        self._failures.append((worker.setup.first, error))

    def _move_idle_workers(self) -> None:
        """Move workers whose hosts are ending, once they have answered all commands."""
        for worker in self._workers:
            if worker.hello is None or worker.pending or worker.error is not None:
                continue
            if (why := worker.leaving()) and not self._is_called(worker):
                self._move(worker, why)

    def _move(self, worker: WorkerProcess, why: str) -> None:
        if worker.disruptions >= self._disruptions:
            return  # it stays until the host ends; its error then says so
        lost = f"the host of worker {worker.name!r} is about to go: {why}"
        worker.disruptions += 1
        error = StartError(f"worker {worker.name!r} on another host", lost)
        self._replace(worker, self._workers.release, lost, error)
        self._warnings.append(f"{worker.whose()} replaced: {lost}")

    def _at_work(self, worker: WorkerProcess) -> int | None:
        """Return the row that a worker of this host was busy with; None if unknown."""
        if not self._begun or not self._shares(worker):
            return None
        at_work = self._arrays.at_work
        row = int(at_work[worker.setup.worker]) - 1
        at_work[worker.setup.worker] = 0
        return None if row < 0 else row

    def _resume(self, worker: WorkerProcess) -> None:
        """Send a new process the commands that the one before has not answered."""
        self._begin(worker)
        steps = [row for row, command in worker.pending.items() if command is _STEP]
        resets = {row: command for row, command in worker.pending.items() if command is not _STEP}
        if steps:
            # These episodes are lost, so the steps need no actions.
            self._send(worker, _encoded(worker, "step", steps, [None] * len(steps), False))
        if resets:
            self._send(worker, _reset_command(worker, list(resets), resets))

    def _show_warnings(self) -> None:
        """Show the warnings, once all messages are dealt with: a warning may be made an error."""
        messages, self._warnings = self._warnings, []
        for at, message in enumerate(messages, 1):
            try:
                warnings.warn(message, RuntimeWarning, stacklevel=_caller_level())
            except RuntimeWarning as error:
                for other in messages[at : at + _SHOWN]:
                    add_note(error, f"another warning: {other}")
                raise


def _encoded(
    worker: WorkerProcess, operation: str, rows: Sequence[int] | None, *rest: Any
) -> bytes:
    return reduction.dumps((operation, worker.generation, rows, *rest))


def _command_of_all(together: bool, generation: int) -> bytes:
    """Return the pickled step of all environments of a worker that has the shared arrays."""
    return reduction.dumps(("step", generation, None, None, together))


def _reset_command(
    worker: WorkerProcess, rows: Sequence[int] | None, pending: dict[int, PendingCommand]
) -> bytes:
    seeds = [each.seed for each in pending.values()]
    return _encoded(worker, "reset", rows, seeds, [each.options for each in pending.values()])


def _caller_level() -> int:
    """Return the ``stacklevel`` of a warning that shows the first line outside of this package."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        frame, level = frame.f_back, level + 1
    return level


def _all_are(
    workers: Iterable[WorkerProcess], is_done: Callable[[WorkerProcess], bool]
) -> Callable[[], bool]:
    """Return a function that returns whether all workers are done.

    It asks no more about a worker that was done.  So the calls between two answers of hundreds of
    workers do not ask about each of them.
    """
    remaining = list(workers)

    def all_done() -> bool:
        while remaining and is_done(remaining[-1]):
            remaining.pop()
        return not remaining

    return all_done


def _only_reports_losses(message: Answer | Results) -> bool:
    """Return whether the environments only reported lost episodes."""
    if not isinstance(message, Answer) or message.rows is None:
        return False
    return all(note.lost for note in message.notes) and len(message.notes) == len(message.rows)


class _Replacement(NamedTuple):
    """Worker that gets another process."""

    worker: WorkerProcess
    let_go: Callable[[WorkerProcess], None]
    """Function that lets go of its process."""
    error: Exception
    """Error to report if the other process cannot be started."""


class _CommandPart(NamedTuple):
    """Part of a command for one worker."""

    worker: WorkerProcess
    rows: Sequence[int] | None
    positions: Sequence[int]
    """Positions of the worker's environments in the arguments of the caller."""

    def each(self) -> Sequence[int]:
        """Return the rows one by one."""
        return range(len(self.worker.numbers)) if self.rows is None else self.rows
