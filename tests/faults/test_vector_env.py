"""Environments that raise, hang or kill their worker: named by number, and replaced if asked."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import fiber
from faults.program import Program, alive, wait_for
from fiber.vector import VectorEnv, worker_process
from fiber.vector.worker import ATTEMPTS
from patience import PATIENCE
from vector_envs import Faulty, Telling

GOOD = Faulty.GOOD
Make = Callable[..., VectorEnv]


@pytest.fixture
def vector_env(backend: str) -> Iterator[Make]:
    """Makes a ``VectorEnv`` of four environments in two workers, and resets it."""
    made: list[VectorEnv] = []

    def make(function: Any = Faulty, **options: Any) -> VectorEnv:
        env = VectorEnv([function] * 4, num_workers=2, **options)
        made.append(env)
        env.reset()
        return env

    yield make
    for env in made:
        env.close(terminate=True)


def works(env: VectorEnv) -> None:
    """Check that all environments can be reset and stepped, and are as they were made."""
    assert env.reset()[0].tolist() == [[0]] * 4
    assert env.step([GOOD] * 4)[0].tolist() == [[1]] * 4


def test_an_error_of_an_environment_names_its_step_and_worker(vector_env: Make) -> None:
    env = vector_env()
    with pytest.raises(ArithmeticError, match="a bad action") as caught:
        env.step([GOOD, GOOD, Faulty.RAISE, Faulty.RAISE])
    note, other = caught.value.__notes__
    assert note == "step of environment 2, of worker 'VectorEnv-worker-1'"
    assert other == "failed, too: step of environment 3, of worker 'VectorEnv-worker-1'"
    assert "in step" in str(caught.value.__cause__)
    works(env)
    with pytest.raises(RuntimeError, match="no reset") as failed:
        env.reset(options={"raise": True})
    assert "reset of environment 0" in failed.value.__notes__[0]
    works(env)


def test_an_error_of_many_environments_shows_a_few_of_them() -> None:
    with contextlib.closing(VectorEnv([Faulty] * 6, num_workers=2)) as env:
        env.reset()
        with pytest.raises(ArithmeticError) as caught:
            env.step([Faulty.RAISE] * 6)
    assert [re.sub(", of.*", "", note) for note in caught.value.__notes__] == [
        "step of environment 0",
        "failed, too: step of environment 1",
        "failed, too: step of environment 2",
        "failed, too: step of environment 3",
        "not shown: 2 more errors of environments",
    ]


def test_an_environment_that_raises_is_replaced(vector_env: Make) -> None:
    env = vector_env(on_error="restart")
    env.step([GOOD] * 4)
    with pytest.warns(RuntimeWarning, match="environment 2 replaced: step raised Arithm"):
        observations, rewards, terminations, truncations, infos = env.step(
            [GOOD, GOOD, Faulty.RAISE, GOOD]
        )
    # It was seen last after a step; the others have made two.
    assert observations.tolist() == [[2], [2], [1], [2]]
    assert rewards.tolist() == [1, 1, 0, 1]
    assert truncations.tolist() == [False, False, True, False]
    assert not terminations.any()
    assert infos["_restarted"].tolist() == truncations.tolist()
    assert infos["restarted"][2].startswith("step raised ArithmeticError: a bad action (")
    observations, _, _, truncations, infos = env.step([GOOD] * 4)
    assert observations.tolist() == [[3], [3], [0], [3]]  # reset, as after any episode
    assert not truncations.any()
    assert "restarted" not in infos
    works(env)


@pytest.mark.parametrize("action", [Faulty.EXIT, Faulty.SEGFAULT])
def test_an_environment_that_ends_its_worker_raises_worker_died(
    action: int, backend: str, vector_env: Make
) -> None:
    env = vector_env()
    with pytest.raises(fiber.WorkerDied) as caught:
        env.step([GOOD, GOOD, GOOD, action])
    # On one host shared memory has the number of the environment that was at work.
    whose = "environment 3" if backend == "local" else "environments 2 to 3"
    assert caught.value.task == f"step of {whose}"
    assert caught.value.worker == "VectorEnv-worker-1"
    assert caught.value.exitcode == (7 if action == Faulty.EXIT else -signal.SIGSEGV)
    assert (" in step" in caught.value.stack) == (action == Faulty.SEGFAULT)
    for _ in range(2):
        with pytest.raises(fiber.WorkerDied):
            env.step([GOOD] * 4)
    with pytest.raises(fiber.WorkerDied):
        env.reset()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_worker_that_died_is_started_anew(mode: str, vector_env: Make) -> None:
    env = vector_env(on_error="restart", autoreset_mode=mode)
    env.step([GOOD] * 4)
    with pytest.warns(RuntimeWarning, match=r"environments 2 to 3 replaced: worker '.*-1' died"):
        observations, _, _, truncations, infos = env.step([GOOD, GOOD, Faulty.SEGFAULT, GOOD])
    assert truncations.tolist() == [False, False, True, True]
    assert "died while it ran step" in infos["restarted"][2]
    if mode == "SameStep":
        assert observations.tolist() == [[2], [2], [0], [0]]
        assert [each.tolist() for each in infos["final_obs"][2:]] == [[1], [1]]
    else:
        assert observations.tolist() == [[2], [2], [1], [1]]
    if mode == "Disabled":
        env.reset(options={"reset_mask": truncations})
    observations = env.step([GOOD] * 4)[0]
    new = 0 if mode == "NextStep" else 1
    assert observations.tolist() == [[3], [3], [new], [new]]
    works(env)


def test_an_environment_that_hangs_raises_a_timeout_error(vector_env: Make) -> None:
    env = vector_env(timeout=2)
    with pytest.raises(fiber.TimeoutError, match=r"longer than 2 s") as caught:
        env.step([GOOD, Faulty.HANG, GOOD, GOOD])
    assert "step of environment 1" in caught.value.__notes__[0]
    works(env)


def test_an_environment_that_hangs_is_replaced(vector_env: Make) -> None:
    env = vector_env(timeout=2, on_error="restart")
    with pytest.warns(RuntimeWarning, match=r"environment 1 replaced: .*longer than 2 s"):
        observations, _, _, truncations, _ = env.step([GOOD, Faulty.HANG, GOOD, GOOD])
    assert truncations.tolist() == [False, True, False, False]
    assert observations.tolist() == [[1], [0], [1], [1]]
    works(env)


def test_a_worker_that_ignores_signals_is_killed(
    vector_env: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_process, "GRACE", 0.3)
    env = vector_env(timeout=1.5)
    with pytest.raises(fiber.TimeoutError, match=r"so worker '.*-0' was killed"):
        env.step([GOOD, Faulty.HANG_NATIVE, GOOD, GOOD])


def test_first_ready_goes_on_without_those_that_fail(vector_env: Make) -> None:
    env = vector_env(on_error="restart")
    env.send([GOOD, GOOD, Faulty.EXIT, Faulty.RAISE])
    seen = {}

    def receive() -> None:
        for _ in range(4):
            _, _, _, truncations, infos = env.recv(1)
            seen[int(infos["env_id"][0])] = bool(truncations[0])

    with pytest.warns(RuntimeWarning, match="replaced"):
        receive()
    assert seen == {0: False, 1: False, 2: True, 3: True}
    works(env)


def test_a_failure_between_those_that_are_ready(vector_env: Make) -> None:
    env = vector_env()
    env.send([GOOD, Faulty.RAISE, GOOD, GOOD])
    with pytest.raises(ArithmeticError):
        env.recv(4)
    assert sorted(env.recv(3)[4]["env_id"]) == [0, 2, 3]
    works(env)


def test_a_worker_that_is_killed_while_idle_is_replaced(vector_env: Make) -> None:
    env = vector_env(on_error="restart")
    pid = env.call("pid")[0]
    os.kill(pid, signal.SIGKILL)
    wait_for(lambda: not alive(pid))
    with pytest.warns(RuntimeWarning, match="(?s)environments 0 to 1 replaced: .*SIGKILL"):
        truncations = env.step([GOOD] * 4)[3]
    assert truncations.tolist() == [True, True, False, False]
    works(env)


def test_a_worker_that_dies_in_a_call(vector_env: Make) -> None:
    env = vector_env(on_error="restart")
    with (
        pytest.warns(RuntimeWarning, match="replaced"),
        pytest.raises(fiber.WorkerDied, match="a call"),
    ):
        env.call("exit", 0)
    assert len(env.call("pid")) == 4  # processes of workers that are starting
    works(env)


def test_an_environment_that_kills_each_worker_is_given_up(
    vector_env: Make, tmp_path: Path
) -> None:
    last = tmp_path / "last"
    env = vector_env(partial(Faulty, last=last), on_error="restart")
    last.touch()
    with (
        pytest.warns(RuntimeWarning, match="replaced") as warned,
        pytest.raises(fiber.WorkerDied, match="the making of environments 0 to 1") as caught,
    ):
        env.step([Faulty.EXIT, GOOD, GOOD, GOOD])
    assert len(warned) == ATTEMPTS
    assert caught.value.exitcode == 3


def test_an_answer_that_cannot_be_pickled(vector_env: Make) -> None:
    env = vector_env()
    with pytest.raises(TypeError, match="cannot pickle") as caught:
        env.step([GOOD, GOOD, GOOD, Faulty.UNPICKLABLE])
    assert caught.value.__notes__ == [
        "an answer that cannot be pickled of environment 3, of worker 'VectorEnv-worker-1'"
    ]
    works(env)
    assert np.isfinite(env.step([GOOD] * 4)[0]).all()


def test_an_environment_whose_answer_cannot_be_pickled_is_replaced(vector_env: Make) -> None:
    env = vector_env(on_error="restart")
    with pytest.warns(RuntimeWarning, match="environment 3 replaced: step raised TypeError"):
        _, rewards, _, truncations, infos = env.step([GOOD, GOOD, GOOD, Faulty.UNPICKLABLE])
    assert rewards.tolist() == [1, 1, 1, 0]
    assert truncations.tolist() == [False, False, False, True]
    assert "cannot pickle" in infos["restarted"][3]
    assert env.step([GOOD] * 4)[0].tolist() == [[2], [2], [2], [0]]
    works(env)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_an_environment_whose_observation_cannot_be_pickled_is_replaced(
    vector_env: Make, mode: AutoresetMode
) -> None:
    env = vector_env(Telling, on_error="restart", autoreset_mode=mode)
    env.step([GOOD] * 4)
    with pytest.warns(RuntimeWarning, match="environment 3 replaced: step raised TypeError"):
        observations, _, _, truncations, infos = env.step([GOOD, GOOD, GOOD, Faulty.UNPICKLABLE])
    at_once = mode is AutoresetMode.SAME_STEP
    assert observations == ("2", "2", "2", "none" if at_once else "1")
    assert truncations.tolist() == [False, False, False, True]
    if at_once:
        assert infos["final_obs"][3] == "1"
    assert env.step([GOOD] * 4)[0] == ("3", "3", "3", "1" if at_once else "none")


class NeverPicklable(Faulty):
    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        observation, _ = super().reset(**options)
        return observation, {"lock": threading.Lock()}


def test_an_environment_whose_answers_can_never_be_pickled_is_given_up(backend: str) -> None:
    env = VectorEnv([Faulty, NeverPicklable], num_workers=1, on_error="restart")
    with pytest.raises(TypeError, match="cannot pickle") as caught:
        env.reset()
    assert "an answer that cannot be pickled of environment 1" in caught.value.__notes__[0]
    env.close()


PROGRAM = """
    from contextlib import suppress
    from functools import partial
    from pathlib import Path
    from fiber.vector import VectorEnv
    from vector_envs import Faulty, Telling
    if __name__ == "__main__":
        gate = Path("gate")
        env = VectorEnv([partial(Faulty, gate.absolute())] * 3, num_workers=2)
        env.reset()
        {prepare}
        try:
            print("ready", flush=True)
            {call}
        except KeyboardInterrupt:
            print("interrupted", flush=True)
        gate.touch()
        with suppress(ValueError):  # there is nothing to receive: it was given up
            env.recv()  # the interrupt came just before that would have waited
        print(env.reset()[0].tolist(), env.step([0, 0, 0])[0].tolist(), flush=True)
        env.send([0, 0, 0])
        print(len(env.recv(3)[0]))
        {close}
"""


@pytest.mark.parametrize(
    ("prepare", "call", "close"),
    [
        ("pass", "env.step([Faulty.WAIT, 0, Faulty.WAIT])", "env.close()"),
        ("env.send([Faulty.WAIT] * 3)", "env.recv(1)", "pass"),
    ],
)
def test_an_interrupted_environment_goes_on(
    launch_on: Callable[..., Program], prepare: str, call: str, close: str
) -> None:
    program = launch_on(PROGRAM.format(prepare=prepare, call=call, close=close))
    assert program.line() == "ready"
    program.signal(signal.SIGINT)
    assert program.line() == "interrupted"
    assert program.finish() == "[[0.0], [0.0], [0.0]] [[1.0], [1.0], [1.0]]\n3\n"
    assert not program.stderr


def test_a_killed_learner_leaves_no_process(launch_on: Callable[..., Program]) -> None:
    program = launch_on(
        PROGRAM.format(prepare="pass", call="env.step([Faulty.HANG] * 3)", close="pass")
    )
    assert program.line() == "ready"
    program.kill()
    assert program.left(PATIENCE) == []
