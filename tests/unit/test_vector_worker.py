"""Reports of a worker of a vector environment: at once, or with the next ones."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from gymnasium.spaces import Discrete
from gymnasium.vector import AutoresetMode

from fiber.connection import Pipe
from fiber.vector import worker as worker_module
from fiber.vector.arrays import ArrayLayout, ArrayMemory
from fiber.vector.slot import Slot
from fiber.vector.worker import Begin, EnvironmentWorker, Setup
from hosts import background
from patience import PATIENCE

ROWS = 4
MS = 1e-3


class Clock:
    """Time that passes only in steps."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now


class Steps(Slot):
    """An environment whose steps take some time."""

    def __init__(self, clock: Clock, seconds: float) -> None:
        self._clock, self._seconds = clock, seconds

    def step(self, action: Any, arrays: Any) -> None:
        self._clock.now += self._seconds


def told(
    monkeypatch: pytest.MonkeyPatch, seconds: list[float], *, shared: bool, together: bool = False
) -> list[list[int] | None]:
    """The rows of each answer to a step, when it is known how long each takes."""
    clock, answers = Clock(), []
    monkeypatch.setattr(worker_module, "time", clock)
    shape = ArrayLayout(Discrete(2), Discrete(2), ROWS, 1)
    memory = ArrayMemory.allocate(shape.size()) if shared else None

    def note(answer: Any) -> None:
        answers.append(answer.rows)

    connection: Any = SimpleNamespace(_send_unconfirmed=note, _exchange=note)
    setup = Setup(0, 0, [], AutoresetMode.NEXT_STEP, restart=False, timeout=None)
    slots = [Steps(clock, each) for each in seconds]
    worker = EnvironmentWorker(connection, setup, slots, Begin(shape, memory))
    for _ in range(100):
        worker._step(0, None, [0] * ROWS, together=True)
    answers.clear()
    worker._step(0, None, [0] * ROWS, together)
    return answers


def test_quick_environments_are_reported_together(monkeypatch: pytest.MonkeyPatch) -> None:
    for shared in (True, False):
        assert told(monkeypatch, [0.01 * MS] * ROWS, shared=shared) == [None]


def test_a_finished_environment_does_not_wait_for_a_slow_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slow_at_the_end = [0.01 * MS, 0.01 * MS, 0.01 * MS, 5 * MS]
    for shared in (True, False):
        assert told(monkeypatch, slow_at_the_end, shared=shared) == [[0, 1, 2], [3]]
        assert told(monkeypatch, slow_at_the_end, shared=shared, together=True) == [None]


def test_a_message_between_hosts_costs_more(monkeypatch: pytest.MonkeyPatch) -> None:
    assert told(monkeypatch, [0.5 * MS] * ROWS, shared=True) == [[0], [1], [2], [3]]
    assert told(monkeypatch, [0.5 * MS] * ROWS, shared=False) == [None]


class Named(Slot):
    """An environment with a name."""

    def __init__(self) -> None:
        """Make no environment."""

    def name(self) -> str:
        return "named"


def test_a_worker_whose_learner_ends_sends_its_last_answer_once() -> None:
    here, there = Pipe()
    shape = ArrayLayout(Discrete(2), Discrete(2), 1, 1)
    setup = Setup(0, 0, [], AutoresetMode.NEXT_STEP, restart=False, timeout=None)
    worker = EnvironmentWorker(there, setup, [Named()], Begin(shape, None))
    here.send(("call", 0, None, "name", [()]))

    def take_the_answer_and_end() -> None:
        here.recv()
        here.close()

    learner = background(take_the_answer_and_end)
    with pytest.raises(EOFError):
        worker.run()
    learner.join(PATIENCE)
