"""Which environments were told what, what came back, and what becomes of those that failed."""

from __future__ import annotations

import pickle
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from multiprocessing import TimeoutError as WaitedTooLong
from multiprocessing.pool import RemoteTraceback  # type: ignore[attr-defined]
from typing import Any, NamedTuple

from fiber import reduction
from fiber._transport.loop import DOZE
from fiber.errors import FiberError
from fiber.vector.arrays import Shape, StepArrays
from fiber.vector.memory import SharedMemory
from fiber.vector.slot import Note
from fiber.vector.worker import Begin, Failure, Hello, Setup
from fiber.vector.worker_process import hung
from fiber.vector.worker_set import Ended, WorkerSet

ATTEMPTS = 3
"""How often in a row a worker is started that dies before it has answered anything."""

GRACE = 5.0
"""Seconds beyond what its environments may take, after which a worker is taken for stuck."""


class Pending(NamedTuple):
    """What an environment was told and has not answered."""

    operation: str
    seed: int | None = None
    options: dict[str, Any] | None = None


_STEP = Pending("step")


class Dispatcher:
    """Tells the workers what to do.  Environments are known by their numbers."""

    def __init__(self, setups: Sequence[Setup], workers: WorkerSet) -> None:
        self._setups = setups
        self._workers = workers
        self._index_of = [setup.index for setup in setups for _ in setup.makes]
        self._restart = setups[0].restart
        self._timeout = setups[0].timeout
        self._generation = 0
        """Of commands: what came before it, nobody waits for any more."""
        self._pending: list[dict[int, Pending]] = [{} for _ in setups]
        """By worker and row."""
        self._results: dict[int, list[Any]] = {}
        """What workers answered that were to apply a function."""
        self._calls: list[_Group] = []
        self._ready: deque[int] = deque()
        self._notes: dict[int, Note] = {}
        self._failures: deque[Exception] = deque()
        self._deadlines: dict[int, float] = {}
        self._stuck: set[int] = set()
        self._deaths = [0] * len(setups)
        self._dead: dict[int, Exception] = {}
        self._absent: dict[int, str] = {}
        """Workers that are made anew and were not told to begin yet, and why."""
        self.hellos: dict[int, Hello] = {}
        self._parts: list[StepArrays] = []
        self._memory: SharedMemory | None = None

    # Beginning

    def start(self) -> None:
        """Start the workers and wait until each has its environments."""
        for setup in self._setups:
            self._workers.start(setup.index)
        self._wait(lambda: len(self.hellos) == len(self._setups) or bool(self._failures), None)
        self._raise_failure()

    def begin(self, shape: Shape, arrays: StepArrays, memory: SharedMemory | None) -> None:
        """Give them the arrays: those of this host share them, if they lie in ``memory``."""
        self._shape, self._arrays, self._memory = shape, arrays, memory
        self._parts = [arrays.part(setup.first, len(setup.makes)) for setup in self._setups]
        for setup in self._setups:
            self._begin(setup.index)

    # Commands

    def step(self, numbers: Sequence[int] | None, actions: Any, *, together: bool) -> None:
        """Step some environments, or all.

        ``actions``: a list with one for each, or None if they are in the arrays.  ``together``:
        nobody asks for the first of them that are done.
        """
        for group in self._groups(numbers):
            rows = group.rows
            self._pending[group.index].update(dict.fromkeys(self._mine(group), _STEP))
            if actions is not None:
                payload: Any = [actions[position] for position in group.positions]
            elif self._shares(group.index):
                payload = None
            else:
                where = slice(None) if rows is None else rows
                payload = (self._parts[group.index].actions.pack(where, shared=False),)
            self._tell(group.index, "step", rows, payload, together)

    def reset(
        self,
        numbers: Sequence[int] | None,
        seeds: Sequence[int | None],
        options: Sequence[dict[str, Any] | None],
        *,
        together: bool,
    ) -> None:
        """Reset some environments, or all, with a seed and options for each."""
        for group in self._groups(numbers):
            for row, position in zip(self._mine(group), group.positions, strict=True):
                told = Pending("reset", seeds[position], options[position])
                self._pending[group.index][row] = told
            self._tell_reset(group.index, group.rows, together)

    def apply(
        self, function: Callable[..., Any], arguments: Mapping[int, tuple[Any, ...]]
    ) -> None:
        """Have ``function(environment, *arguments)`` called for each number."""
        numbers = list(arguments)
        self._results.clear()
        self._calls = self._groups(numbers)
        for group in self._calls:
            mine = [arguments[numbers[position]] for position in group.positions]
            self._tell(group.index, "apply", group.rows, function, mine)

    # Answers

    def wait(self, timeout: float | None = None) -> None:
        """Until all environments have answered; raises what the first that failed has raised."""
        self._wait(lambda: not any(self._pending), timeout)
        self._ready.clear()
        self._raise_failure()

    def wait_for(self, count: int, timeout: float | None = None) -> list[int]:
        """The numbers of the ``count`` environments that answered first."""
        self._wait(lambda: len(self._ready) >= count or bool(self._failures), timeout)
        self._raise_failure()
        return [self._ready.popleft() for _ in range(count)]

    def results(self, timeout: float | None = None) -> list[Any]:
        """What the calls of ``apply`` returned, in its order."""
        calls = self._calls
        self._wait(lambda: len(self._results) == len(calls) or bool(self._failures), timeout)
        self._raise_failure()
        by_position: dict[int, Any] = {}
        for group in calls:
            by_position |= zip(group.positions, self._results[group.index], strict=True)
        return [by_position[position] for position in range(len(by_position))]

    def under_way(self) -> int:
        """How many environments have not answered, or were not asked for their answer."""
        return len(self._ready) + sum(map(len, self._pending))

    def busy(self, numbers: Iterable[int]) -> int | None:
        """The first of these of which ``under_way`` is true; None if there is none."""
        for number in numbers:
            index = self._index_of[number]
            row = number - self._setups[index].first
            if row in self._pending[index] or number in self._ready:
                return number
        return None

    def notes(self, numbers: Iterable[int] | None = None) -> list[tuple[int, Note]]:
        """What the environments had to say: all of them in order, or some as they are given."""
        if numbers is None:
            numbers = sorted(self._notes)
        return [(number, self._notes.pop(number)) for number in numbers if number in self._notes]

    def abandon(self) -> None:
        """Nobody waits any more for what was asked for."""
        self._generation += 1
        for pending in self._pending:
            pending.clear()
        self._ready.clear()
        self._notes.clear()
        self._failures.clear()

    def close(self, timeout: float | None) -> None:
        """End the workers; kill those that have not ended when ``timeout`` is over."""
        data = pickle.dumps(("close",))
        for setup in self._setups:
            self._workers.send(setup.index, data)
        self._workers.close(timeout)

    # Telling

    def _groups(self, numbers: Sequence[int] | None) -> list[_Group]:
        if numbers is None:
            return [
                _Group(setup.index, None, range(setup.first, setup.first + len(setup.makes)))
                for setup in self._setups
            ]
        groups: dict[int, _Group] = {}
        for position, number in enumerate(numbers):
            index = self._index_of[number]
            group = groups.setdefault(index, _Group(index, [], []))
            group.rows.append(number - self._setups[index].first)  # type: ignore[union-attr]
            group.positions.append(position)  # type: ignore[attr-defined]
        return list(groups.values())

    def _mine(self, group: _Group) -> Sequence[int]:
        return range(len(self._setups[group.index].makes)) if group.rows is None else group.rows

    def _tell(self, index: int, operation: str, rows: Sequence[int] | None, *rest: Any) -> None:
        if index in self._dead:
            raise self._dead[index]
        if index in self._absent:
            return  # it is told once it has begun
        command = (operation, self._generation, rows, *rest)
        self._workers.send(index, _encoded(command))
        self._set_deadline(index)

    def _tell_reset(self, index: int, rows: Sequence[int] | None, together: bool) -> None:
        pending = self._pending[index]
        mine = list(pending.values()) if rows is None else [pending[row] for row in rows]
        seeds, options = [each.seed for each in mine], [each.options for each in mine]
        self._tell(index, "reset", rows, seeds, options, together)

    def _begin(self, index: int) -> None:
        """Tell a worker that has its environments where the arrays are."""
        part = self._parts[index]
        memory = self._memory if self._shares(index) else None
        shape = self._shape if memory else self._shape._replace(count=len(part.rewards))
        lost = self._absent.pop(index, None)
        last = part.pack(slice(None), shared=bool(memory)) if lost else None
        self._workers.send(index, _encoded(Begin(shape, memory, last, lost)))

    def _shares(self, index: int) -> bool:
        hello = self.hellos.get(index)
        return self._memory is not None and hello is not None and hello.host == self._memory.host

    # Hearing

    def _wait(self, enough: Callable[[], bool], timeout: float | None) -> None:
        deadline = None if timeout is None else time.monotonic() + timeout
        while not enough():
            left = DOZE if deadline is None else min(DOZE, deadline - time.monotonic())
            if left < 0:
                raise WaitedTooLong(f"not all environments answered within {timeout:g} s")
            for index, message in self._workers.receive(left):
                self._hear(index, message)
            self._kill_stuck()

    def _hear(self, index: int, message: Any) -> None:
        if isinstance(message, Ended):
            self._mourn(index)
        elif isinstance(message, Hello):
            self.hellos[index] = message
            if index in self._absent:
                self._stand_in(index)
        elif isinstance(message, Failure):
            self._dead[index] = error = self._told(index, message)
            self._failures.append(error)
        else:
            self._deaths[index] = 0
            self._answer(index, *message)

    def _answer(
        self,
        index: int,
        generation: int,
        rows: Sequence[int] | None,
        results: Any,
        notes: Sequence[Note],
        failures: Sequence[Failure],
    ) -> None:
        if generation != self._generation:
            return
        pending, first = self._pending[index], self._setups[index].first
        self._failures += [self._told(index, failure) for failure in failures]
        if isinstance(results, list):
            self._results[index] = results
            return
        if rows is None:
            self._parts[index].unpack(slice(None), results)
            pending.clear()
            self._ready.extend(range(first, first + len(self._setups[index].makes)))
        else:
            self._parts[index].unpack(rows, results)
            for row in rows:
                del pending[row]
                self._ready.append(first + row)
        for note in notes:
            self._notes[first + note.row] = note
            if note.lost is not None:
                self._warn(f"environment {first + note.row}", note.lost)
        for failure in failures:
            pending.pop(failure.row, None)
            number = first + failure.row
            if number in self._ready:
                self._ready.remove(number)
        self._set_deadline(index)

    def name(self, number: int) -> str:
        """An environment, for a person."""
        return f"environment {number}, of {self._workers[self._index_of[number]].place()}"

    def _told(self, index: int, failure: Failure) -> Exception:
        """What a worker says of an error, as the error to raise here."""
        where = f"{failure.doing} of {self.name(self._setups[index].first + failure.row)}"
        try:
            error: Exception = pickle.loads(failure.error)
        except Exception:
            error = FiberError(failure.trace.strip().rpartition("\n")[2])
        error.__cause__ = RemoteTraceback(f'\n"""\n{failure.trace}"""')
        error.add_note(where)
        return error

    def _raise_failure(self) -> None:
        if self._failures:
            error = self._failures.popleft()
            for other in self._failures:
                for note in getattr(other, "__notes__", ()):
                    error.add_note(f"failed, too: {note}")
            self._failures.clear()
            raise error

    # Ends

    def _mourn(self, index: int) -> None:
        """A worker is gone."""
        if index in self._dead:
            return  # it said why
        worker, pending = self._workers[index], self._pending[index]
        doing = next(iter(pending.values())).operation if pending else "the last step"
        error = worker.died(doing if self._parts else "making", self._at_work(index))
        if index in self._stuck:
            self._stuck.discard(index)
            assert self._timeout is not None
            error = hung(f"{doing} of {worker.whose()}", self._timeout, worker)
        self._deaths[index] += 1
        if not (self._restart and self._parts) or self._deaths[index] > ATTEMPTS:
            self._dead[index] = error
            self._failures.append(error)
            pending.clear()
            return
        self._warn(worker.whose(), str(error))
        self._workers.drop(index)
        del self.hellos[index]
        self._absent[index] = str(error)
        self._deadlines.pop(index, None)
        self._workers.start(index)

    def _at_work(self, index: int) -> int | None:
        """The row that a worker of this host was busy with."""
        if not self._parts or not self._shares(index):
            return None
        word = int(self._arrays.at_work[index])
        self._arrays.at_work[index] = 0
        return word - 1 if word else None

    def _stand_in(self, index: int) -> None:
        """A worker in place of one that died has its environments: tell it what that one was."""
        self._begin(index)
        pending = self._pending[index]
        steps = [row for row, each in pending.items() if each.operation == "step"]
        resets = [row for row, each in pending.items() if each.operation == "reset"]
        if steps:
            self._tell(index, "step", steps, [None] * len(steps), False)
        if resets:
            self._tell_reset(index, resets, False)

    def _warn(self, whose: str, why: str) -> None:
        warnings.warn(f"{whose} made anew: {why}", RuntimeWarning, stacklevel=2)

    def _set_deadline(self, index: int) -> None:
        if self._timeout is None:
            return
        pending = len(self._pending[index])
        self._deadlines.pop(index, None)
        if pending:
            self._deadlines[index] = time.monotonic() + pending * self._timeout + GRACE

    def _kill_stuck(self) -> None:
        """A worker's own alarm ends it, unless it is stopped or out of reach."""
        if not self._deadlines:
            return
        now = time.monotonic()
        for index in [index for index, deadline in self._deadlines.items() if deadline < now]:
            del self._deadlines[index]
            self._stuck.add(index)
            self._workers[index].process.kill()


class _Group(NamedTuple):
    """The part of a command that is one worker's."""

    index: int
    rows: Sequence[int] | None
    positions: Sequence[int]
    """Of its environments in what the caller gave."""


def _encoded(command: Any) -> bytes:
    return reduction.dumps(command)
