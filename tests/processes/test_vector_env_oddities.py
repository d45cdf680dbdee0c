"""Environments that say what cannot be taken, and learners that fork: told, and nothing hangs."""

from __future__ import annotations

import mmap
import os
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import fiber
from faults.program import alive, wait_for
from fiber._runtime.state import runtime
from fiber.vector import VectorEnv
from fiber.vector.worker import ATTEMPTS
from vector_envs import Faulty, Sampling, Step

Make = Callable[..., VectorEnv]


@pytest.fixture
def vector_env() -> Iterator[Make]:
    """Makes a ``VectorEnv`` in two workers that is closed after the test."""
    made: list[VectorEnv] = []

    def make(*args: Any, **kwargs: Any) -> VectorEnv:
        made.append(VectorEnv(*args, num_workers=2, **kwargs))
        return made[-1]

    yield make
    for env in made:
        env.close(terminate=True)


class Saying(Faulty):
    """An action above 0 has an info."""

    def __init__(self, info: Any = None) -> None:
        super().__init__()
        self._info = info

    def step(self, action: Any) -> Step:
        info = self._info() if callable(self._info) else self._info
        return (*super().step(0)[:4], info if action else {})


class Unreadable:
    """Can be pickled, and not unpickled."""

    def __init__(self, load: Callable[..., Any]) -> None:
        self._load = load

    def __reduce__(self) -> Any:
        return self._load, ("no number",)


def unreadable(load: Callable[..., Any] = int) -> dict[str, Any]:
    return {"it": Unreadable(load)}


@pytest.mark.parametrize(("load", "error"), [(int, ValueError), (os.stat, FileNotFoundError)])
def test_an_answer_that_cannot_be_unpickled(
    load: Callable[..., Any], error: type[Exception], vector_env: Make
) -> None:
    env = vector_env([partial(Saying, partial(unreadable, load))] * 4)
    env.reset()
    with pytest.raises(error, match="no number") as caught:
        env.step([0, 0, 1, 0])
    assert caught.value.__notes__ == [
        "an answer of environments 2 to 3, of worker 'VectorEnv-worker-1', cannot be unpickled"
    ]
    assert env.step([0] * 4)[0][3] == [2]
    # A worker that has answered so is not waited for.
    env.send([0, 0, 1, 0])
    with pytest.raises(error, match="no number"):
        env.recv(4)
    while env._dispatcher.under_way():
        env.recv(1)
    assert env.reset()[0].tolist() == [[0]] * 4


def test_a_late_answer_of_a_failed_worker_is_not_taken_for_the_next_answer(
    vector_env: Make, tmp_path: Path
) -> None:
    gate = tmp_path / "gate"
    makes = [partial(Saying, unreadable), partial(Faulty, gate), Faulty, Faulty]
    env = vector_env(makes, shared_memory=False)
    env.reset()
    for _ in range(4):  # now it is known that this one need not be waited for
        env.step([0, Faulty.SLOW, 0, 0])
    env.send([1, Faulty.WAIT, 0, 0])
    with pytest.raises(ValueError, match="no number"):
        env.recv(4)
    assert sorted(env.recv(2)[4]["env_id"]) == [2, 3]
    gate.touch()
    second = np.array([False, True, False, False])
    assert env.reset(options={"reset_mask": second})[0][1] == [0]
    assert env.step([0] * 4)[0][1] == [1]


@pytest.mark.parametrize("info", [["a list"], 3, None, [], 0])
def test_an_info_that_is_no_dictionary(info: Any, vector_env: Make) -> None:
    env = vector_env([partial(Saying, info)] * 4)
    env.reset()
    with pytest.raises(TypeError, match="an info is a dictionary, not") as caught:
        env.step([0, 0, 0, 1])
    assert "step of environment 3" in caught.value.__notes__[0]


class Filming(Sampling):
    """All that it has to say is large."""

    def __init__(self) -> None:
        super().__init__(spaces.OneOf([spaces.Box(0, 255, (300, 300), np.uint8)]))

    def step(self, action: Any) -> Step:
        return (*super().step(action)[:2], True, False, {"frames": [self.render()]})

    def render(self) -> Any:
        return np.zeros((300, 300), np.uint8)


def is_its_owners(array: Any) -> bool:
    """Return whether the array lies in memory that its sender does not share."""
    memory = array
    while isinstance(memory, np.ndarray):
        memory = memory.base
    return not isinstance(memory.obj if isinstance(memory, memoryview) else memory, mmap.mmap)


def test_large_arrays_belong_to_the_user_and_are_writable(vector_env: Make) -> None:
    env = vector_env([Filming] * 2, autoreset_mode="SameStep", copy=False)
    env.reset()
    observations, *_, infos = env.step([0, 0])
    one_of: Any = env.single_observation_space
    for array in (
        one_of.spaces[0].high,
        env.render()[0],
        observations[0][1],
        infos["final_obs"][0][1],
        infos["final_info"]["frames"][0][0],
    ):
        assert array.shape == (300, 300)
        assert is_its_owners(array)
        assert array.flags.writeable


def test_infos_of_types_that_do_not_go_together(vector_env: Make) -> None:
    env = vector_env([partial(Saying, {"it": 1}), partial(Saying, {"it": "one"})])
    env.reset()
    with pytest.raises(ValueError) as caught:
        env.step([1, 1])
    assert caught.value.__notes__ == ["an info of environment 1, of worker 'VectorEnv-worker-1'"]


class Spaceless(Faulty):
    """Environment that has no space, or one that cannot be pickled."""

    def __init__(self, space: Any = None) -> None:
        super().__init__()
        self._space = space

    @property
    def observation_space(self) -> Any:  # type: ignore[override]
        if self._space is None:
            raise LookupError("no space")
        self._space.lock = threading.Lock()
        return self._space


def test_a_space_that_is_not_to_be_had(vector_env: Make) -> None:
    with pytest.raises(LookupError, match="no space") as caught:
        vector_env([Faulty, Faulty, Faulty, Spaceless])
    assert "environment 3" in caught.value.__notes__[0]
    with pytest.raises(fiber.UnpicklableError) as unpicklable:
        vector_env([Faulty, Faulty, Faulty, partial(Spaceless, spaces.Discrete(2))])
    assert "environment 3, of worker 'VectorEnv-worker-1'" in unpicklable.value.__notes__[0]


def test_an_observation_of_another_shape(vector_env: Make) -> None:
    class Wide(Faulty):
        def step(self, action: Any) -> Step:
            return (np.zeros(int(action)), *super().step(0)[1:])

    env = vector_env([Wide] * 2)
    env.reset()
    with pytest.raises(ValueError, match=r"has the shape \(3,\), but its space has \(1,\)"):
        env.step([1, 3])


class Closing(Faulty):
    """Writes that it was closed, and raises."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path

    def close(self) -> None:
        self._path.touch()
        raise RuntimeError("not closed well")


def test_all_are_closed_whatever_one_of_them_raises(vector_env: Make, tmp_path: Path) -> None:
    env = vector_env([partial(Closing, tmp_path / str(number)) for number in range(4)])
    env.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "1", "2", "3"]


def test_a_worker_that_dies_in_a_call_names_the_environment(vector_env: Make) -> None:
    env = vector_env([Faulty] * 4)
    env.reset()
    env.step([Faulty.GOOD] * 4)
    env.reset(options={"reset_mask": np.array([True, True, True, False])})
    with pytest.raises(fiber.WorkerDied) as caught:
        env.call("exit", 1)
    assert caught.value.task == "a call of environment 3"


class Stubborn:
    """Error that cannot be pickled for a special reason."""

    def __reduce__(self) -> str:
        raise ValueError("cannot pickle this")


class Unpicklable(Faulty):
    """Environment with an object that cannot be pickled."""

    def __init__(self, make: Callable[[], Any]) -> None:
        super().__init__()
        self._make = make

    def get(self) -> Any:
        return self._make()


@pytest.mark.parametrize(("make", "kind"), [(threading.Lock, TypeError), (Stubborn, ValueError)])
def test_a_result_that_cannot_be_pickled_names_its_environment(
    vector_env: Make, make: Callable[[], Any], kind: type[Exception]
) -> None:
    env = vector_env([partial(Unpicklable, make if number == 3 else int) for number in range(4)])
    with pytest.raises(kind, match="cannot pickle") as caught:
        env.call("get")
    assert caught.value.__notes__ == [
        "an answer that cannot be pickled of environment 3, of worker 'VectorEnv-worker-1'"
    ]
    assert len(env.call("pid")) == 4


# Restarts


class Flagged(Faulty):
    """While a file exists, it raises or dies in ``step`` and ``reset``, or hangs in its making."""

    def __init__(self, flag: Path, how: str) -> None:
        super().__init__()
        self._flag, self._how = flag, how
        if how == "hang" and flag.exists():
            time.sleep(1000)

    def _fail(self) -> None:
        if not self._flag.exists():
            return
        if self._how == "die":
            os._exit(9)
        if self._how == "raise":
            raise ArithmeticError("always")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self._fail()
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> Step:
        self._fail()
        return super().step(action)


@pytest.mark.slow
@pytest.mark.parametrize(("how", "error"), [("raise", ArithmeticError), ("die", fiber.WorkerDied)])
def test_an_environment_that_never_answers_again_is_given_up(
    how: str, error: type[Exception], vector_env: Make, tmp_path: Path
) -> None:
    env = vector_env([partial(Flagged, tmp_path / "flag", how)] * 2, on_error="restart")
    env.reset()
    (tmp_path / "flag").touch()
    for _ in range(ATTEMPTS):
        with pytest.warns(RuntimeWarning, match="replaced"):
            truncations = env.step([0, 0])[3]
        assert truncations.tolist() == [True, True]
    with pytest.raises(error):
        env.step([0, 0])


def test_an_environment_that_works_between_its_errors_is_not_given_up(
    vector_env: Make,
) -> None:
    env = vector_env([Faulty] * 2, on_error="restart")
    env.reset()
    for _ in range(2 * ATTEMPTS):
        with pytest.warns(RuntimeWarning, match="replaced"):
            truncations = env.step([Faulty.GOOD, Faulty.RAISE])[3]
        assert truncations.tolist() == [False, True]
        assert env.step([Faulty.GOOD, Faulty.RAISE])[3].tolist() == [False, False]


@pytest.mark.slow
def test_a_making_that_hangs(vector_env: Make, tmp_path: Path) -> None:
    makes = [partial(Flagged, tmp_path / "flag", "hang")] * 2
    env = vector_env(makes, on_error="restart", timeout=2)
    env.reset()
    (tmp_path / "flag").touch()
    with pytest.raises(fiber.TimeoutError, match="longer than 2 s") as caught:
        env.step([Faulty.GOOD, Faulty.RAISE])
    assert "step of environment 1" in caught.value.__notes__[0]


# Ends


def test_a_vector_env_that_is_collected_on_the_loop_thread_ends_its_workers(tmp_path: Path) -> None:
    env = VectorEnv([partial(Faulty, tmp_path / "never")] * 2, num_workers=2)
    env.reset()
    pids = env.call("pid")
    env.step_async([Faulty.WAIT] * 2)
    runtime().loop.call_soon(env.__del__)
    wait_for(lambda: not any(alive(pid) for pid in pids))
    env.closed = True


# Forks


@pytest.mark.parametrize("call", ["step", "close", "__del__"])
def test_a_fork_leaves_the_workers_to_its_parent(call: str, vector_env: Make) -> None:
    env = vector_env([Faulty] * 2)
    env.reset()
    pid = os.fork()
    if pid == 0:
        status = 3
        try:
            env.step([0, 0]) if call == "step" else getattr(env, call)()
            status = 0
        except RuntimeError as error:
            status = 1 if "belongs to process" in str(error) else 2
        finally:
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == (1 if call == "step" else 0)
    assert env.step([0, 0])[0].tolist() == [[1], [1]]
