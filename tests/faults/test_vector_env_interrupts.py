"""Vector environments whose waits are interrupted or time out: the next command works again."""

from __future__ import annotations

import contextlib
import os
import signal
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fiber
from fiber.vector import VectorEnv
from fiber.vector.worker_process import WorkerGroup, WorkerProcess
from vector_envs import Faulty, Step

GOOD = Faulty.GOOD

pytestmark = pytest.mark.usefixtures("backend")


@contextlib.contextmanager
def killed_workers(**options: Any) -> Iterator[VectorEnv]:
    """Yield four environments on four workers, all of which were killed after the reset."""
    with contextlib.closing(VectorEnv([Faulty] * 4, num_workers=4, **options)) as env:
        env.reset()
        for pid in env.call("pid"):
            os.kill(pid, signal.SIGKILL)
        yield env


def interrupt_first(
    monkeypatch: pytest.MonkeyPatch, owner: type, name: str, error: BaseException
) -> list[object]:
    """Raise ``error`` in the first call of a method, after the call; return the calls."""
    original: Callable[..., Any] = getattr(owner, name)
    calls: list[object] = []

    def interrupted(self: object, *args: Any) -> Any:
        calls.append(self)
        result = original(self, *args)
        if len(calls) == 1:
            raise error
        return result

    monkeypatch.setattr(owner, name, interrupted)
    return calls


@pytest.mark.filterwarnings("ignore:.*replaced")
@pytest.mark.parametrize(("owner", "name"), [(WorkerProcess, "death"), (WorkerGroup, "drop")])
def test_an_interrupt_while_workers_are_replaced_loses_none(
    owner: type, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with killed_workers(on_error="restart") as env:
        calls = interrupt_first(monkeypatch, owner, name, KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            env.step([GOOD] * 4)
        assert env.reset()[0].tolist() == [[0]] * 4
        assert env.step([GOOD] * 4)[0].tolist() == [[1]] * 4
    assert len(calls) > 4


@pytest.mark.filterwarnings("ignore:.*replaced")
def test_an_interrupted_start_of_a_replacement_is_made_up_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    original, starts = WorkerGroup.start, []

    def interrupted(self: WorkerGroup, worker: WorkerProcess) -> None:
        starts.append(worker)
        if len(starts) == 1:
            raise KeyboardInterrupt
        original(self, worker)

    with killed_workers(on_error="restart") as env:
        monkeypatch.setattr(WorkerGroup, "start", interrupted)
        with pytest.raises(KeyboardInterrupt):
            env.step([GOOD] * 4)
        assert env.reset()[0].tolist() == [[0]] * 4
    assert len(starts) == 5


def test_an_interrupt_while_the_end_of_a_worker_is_noted_does_not_hide_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with killed_workers() as env:
        interrupt_first(monkeypatch, WorkerProcess, "death", KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            env.step([GOOD] * 4)
        with pytest.raises(fiber.WorkerDied, match="SIGKILL"):
            env.reset()


def test_a_warning_that_is_an_error_does_not_prevent_the_replacement() -> None:
    with killed_workers(on_error="restart") as env:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with pytest.raises(RuntimeWarning, match="replaced: worker"):
                env.step([GOOD] * 4)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert env.reset()[0].tolist() == [[0]] * 4


def test_a_warning_shows_the_line_of_the_caller() -> None:
    with contextlib.closing(VectorEnv([Faulty], num_workers=1, on_error="restart")) as env:
        env.reset()
        with pytest.warns(RuntimeWarning, match=r"bad action \(.*vector_envs.py:\d+\)") as caught:
            env.step([Faulty.RAISE])
    assert [warning.filename for warning in caught] == [__file__]


class Summing(Faulty):
    """Environment that waits for the gate at the action WAIT, and adds up its actions."""

    def step(self, action: Any) -> Step:
        result = super().step(action)
        self.total = getattr(self, "total", 0) + int(action)
        return np.array([float(self.total)]), *result[1:]


def test_a_step_that_was_given_up_has_its_own_actions(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    make = partial(Summing, gate)
    with contextlib.closing(VectorEnv([make] * 2, num_workers=1)) as env:
        env.reset()
        env.step_async([Faulty.WAIT, Faulty.SLOW])
        with pytest.raises(fiber.TimeoutError):
            env.step_wait(timeout=0)
        env.step_async(np.array([GOOD, GOOD]))
        gate.touch()
        assert env.step_wait()[0].tolist() == [[Faulty.WAIT], [Faulty.SLOW]]
        assert not env._dispatcher.reads_old_actions()


def test_a_forked_copy_of_the_learner_does_not_keep_the_workers() -> None:
    env = VectorEnv([Faulty], num_workers=1)
    env.reset()
    reader, writer = os.pipe()
    if not (child := os.fork()):
        os.close(writer)
        os.read(reader, 1)  # until the learner has closed its environments
        os._exit(0)
    env.close()
    os.close(writer)
    os.close(reader)
    assert os.waitpid(child, 0)[1] == 0


def test_environments_whose_connections_are_closed_are_ended() -> None:
    env = VectorEnv([Faulty] * 2, num_workers=2)
    workers = list(env._dispatcher._workers)
    for worker in workers:
        worker.connection.close()
    env.close(terminate=True)
    for worker in workers:
        with pytest.raises(ValueError, match="closed"):
            worker.process.is_alive()


def test_a_reward_of_none_is_an_error() -> None:
    with contextlib.closing(VectorEnv([Unrewarded], num_workers=1)) as env:
        env.reset()
        with pytest.raises(TypeError, match="a reward is a number, not None"):
            env.step([GOOD])


class Unrewarded(Faulty):
    """Environment without rewards."""

    def step(self, action: Any) -> Any:
        observation, _, *rest = super().step(action)
        return observation, None, *rest
