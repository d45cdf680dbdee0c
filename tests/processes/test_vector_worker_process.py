"""Limit of a learner's wait for a worker before it takes it for stuck."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from gymnasium.vector import AutoresetMode

import fiber
from fiber.vector import worker_process
from fiber.vector.worker import Setup
from fiber.vector.worker_process import GRACE, PendingCommand, WorkerProcess
from vector_envs import Faulty

TIMEOUT = 2.0


def patience(monkeypatch: pytest.MonkeyPatch, *, restart: bool) -> float | None:
    """Seconds that a worker has which was told to step two environments."""
    monkeypatch.setattr(worker_process, "time", SimpleNamespace(monotonic=lambda: 0.0))
    setup = Setup(0, 0, [Faulty] * 3, AutoresetMode.NEXT_STEP, restart, TIMEOUT)
    worker = WorkerProcess(setup, fiber.get_context(), "owner")
    worker.pending = {0: PendingCommand("step"), 2: PendingCommand("step")}
    worker.set_deadline()
    return worker.deadline


def test_a_worker_has_the_time_that_its_environments_have(monkeypatch: pytest.MonkeyPatch) -> None:
    assert patience(monkeypatch, restart=False) == 2 * TIMEOUT + GRACE


def test_a_worker_has_time_to_make_its_environments_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    # The step, the end of the old environment, the making of the new one, its step.
    assert patience(monkeypatch, restart=True) == 2 * 4 * TIMEOUT + GRACE
