"""Stack of a task whose worker was killed over its time, or crashed: on each backend."""

from __future__ import annotations

import signal
from collections.abc import Callable

import pytest

import fiber
from faults import pool_targets as tasks
from faults.raising import HangingEnv
from fiber._runtime import exchange
from fiber.errors import WorkerDied
from fiber.vector import VectorEnv, worker_process
from patience import PATIENCE

pytestmark = pytest.mark.usefixtures("backend")


@pytest.mark.parametrize("hang", [tasks.hang_in_python, tasks.hang_in_native_code])
def test_a_task_over_its_time_says_where_each_thread_was(
    hang: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exchange, "STACK_PATIENCE", PATIENCE)
    with fiber.Pool(1) as pool:
        with pytest.raises(fiber.TimeoutError, match="took longer than its timeout") as caught:
            pool.apply(hang, timeout=3)
        text = str(caught.value)
        assert f" in {hang.__name__}" in text
        assert " in wait_beside" in text
        assert "worker.py" not in text
        assert pool.apply(abs, (-1,)) == 1


@pytest.mark.parametrize("signum", [signal.SIGSEGV, signal.SIGABRT, signal.SIGFPE, signal.SIGBUS])
def test_a_worker_that_crashes_says_where_it_was(signum: signal.Signals) -> None:
    with fiber.Pool(1, retries=0) as pool, pytest.raises(WorkerDied) as caught:
        pool.apply(tasks.crash, (signum,))
    error = caught.value
    assert error.exitcode == -signum
    assert "Fatal Python error" in error.stack
    assert " in crash" in error.stack
    assert " in crash" in str(error)


def test_an_environment_that_hangs_reports_its_stack(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(worker_process, "GRACE", 0.3)
    env = VectorEnv([HangingEnv], num_workers=1, timeout=3)
    env.reset()
    with pytest.raises(fiber.TimeoutError, match=r"so worker .* was killed") as caught:
        env.step([0])
    env.close(terminate=True)
    assert " in hang_in_native_code" in str(caught.value)
    assert "slot.py" not in str(caught.value)


def test_a_killed_worker_reports_no_stack() -> None:
    with fiber.Pool(1, retries=0) as pool, pytest.raises(WorkerDied) as caught:
        pool.apply(tasks.die)
    assert caught.value.stack == ""
    assert "Where it was" not in str(caught.value)
