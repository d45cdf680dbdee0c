"""``fiber.vector.VecEnv`` is what stable-baselines3's ``DummyVecEnv`` is."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError
from gymnasium.wrappers import TimeLimit

import fiber
from fiber.resources import Resources
from vector_envs import Faulty, Sampling

STAND_INS = Path(__file__).parents[1] / "stand_ins"

if importlib.util.find_spec("stable_baselines3") is None:
    pytest.skip("make installs stable-baselines3", allow_module_level=True)

Make = Callable[..., Any]


@pytest.fixture(scope="module", autouse=True)
def torch() -> Iterator[None]:
    """torch, or what stands in for it, and is gone afterwards."""
    before = set(sys.modules)
    path = list(sys.path)
    sys.path.append(str(STAND_INS))  # last: installed packages are found first
    yield
    sys.path[:] = path
    for name in set(sys.modules) - before:
        if name.partition(".")[0] in ("torch", "stable_baselines3", "any_name"):
            del sys.modules[name]
    sys.modules.pop("fiber.vector.vec_env", None)


@pytest.fixture
def vec_env() -> Iterator[Make]:
    """Makes a ``VecEnv`` that is closed after the test."""
    from fiber.vector import VecEnv

    made = []

    def make(*args: Any, num_workers: int = 2, **kwargs: Any) -> Any:
        made.append(VecEnv(*args, num_workers=num_workers, **kwargs))
        return made[-1]

    yield make
    for env in made:
        env.close()


def dummy(makes: list[Any]) -> Any:
    from stable_baselines3.common.vec_env import DummyVecEnv

    return DummyVecEnv(makes)


def same(one: Any, other: Any) -> None:
    """Equal, and arrays of the same types."""
    if isinstance(one, dict):
        assert set(one) == set(other)
        for key in one:
            same(one[key], other[key])
    elif isinstance(one, tuple | list):
        assert len(one) == len(other)
        for mine, its in zip(one, other, strict=True):
            same(mine, its)
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    else:
        assert type(one) is type(other)
        assert one == other


def play_both(env: Any, other: Any, steps: int = 20) -> None:
    assert env.metadata == other.metadata
    for each in (env, other):
        each.seed(5)
        each.set_options({"a": 1})
    same(env.reset(), other.reset())
    same(env.reset_infos, other.reset_infos)
    other.action_space.seed(1)
    for _ in range(steps):
        actions = np.array([other.action_space.sample() for _ in range(other.num_envs)])
        same(env.step(actions), other.step(actions))
        same(env.reset_infos, other.reset_infos)


SPACES = {
    "array": spaces.Box(-1, 1, (2, 3), np.float32),
    "number": spaces.Discrete(7),
    "dict": spaces.Dict({"a": spaces.Box(0, 255, (4, 4, 1), np.uint8), "b": spaces.Discrete(3)}),
    "tuple": spaces.Tuple((spaces.MultiDiscrete([3, 4]), spaces.MultiBinary(2))),
}


@pytest.mark.parametrize("space", SPACES)
def test_environments_give_the_same_as_dummy_vec_env(space: str, vec_env: Make) -> None:
    makes = [partial(Sampling, SPACES[space], length=3 + number % 3) for number in range(5)]
    play_both(vec_env(makes), dummy(makes))


def test_environments_without_shared_memory_give_the_same_as_dummy_vec_env(vec_env: Make) -> None:
    makes = [partial(Sampling, SPACES["dict"], SPACES["array"])] * 3
    play_both(vec_env(makes, shared_memory=False), dummy(makes), 6)


def test_cart_poles_in_the_wrappers_of_stable_baselines3(vec_env: Make) -> None:
    from stable_baselines3.common.vec_env import VecFrameStack, VecMonitor, VecNormalize

    makes = [partial(gymnasium.make, "CartPole-v1")] * 3
    mine, its = (
        VecFrameStack(VecNormalize(VecMonitor(env), norm_reward=False), 2)
        for env in (vec_env(makes), dummy(makes))
    )
    play_both(mine, its, steps=0)
    mine, its = (VecFrameStack(VecNormalize(env), 2) for env in (vec_env(makes), dummy(makes)))
    play_both(mine, its, 60)


def test_spaces_that_differ(vec_env: Make) -> None:
    makes = [partial(Sampling, spaces.Box(0, high, (2,))) for high in (1, 2, 3)]
    play_both(vec_env(makes), dummy(makes))
    makes[2] = partial(Sampling, spaces.Box(0, 1, (3,)))
    with pytest.raises(RuntimeError, match=r"which one batch of them needs\. environment 2, .*-1'"):
        vec_env(makes)


def test_spaces_of_the_users_own(vec_env: Make) -> None:
    class Word(spaces.Text):
        """Space of a kind that Gymnasium cannot batch with others."""

    env = vec_env([partial(Sampling, Word(5))] * 3)
    assert env.observation_space == Word(5)


def test_make_vec_env() -> None:
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.monitor import Monitor

    from fiber.vector import VecEnv

    env = make_vec_env(
        "CartPole-v1", 3, seed=2, vec_env_cls=VecEnv, vec_env_kwargs={"num_workers": 2}
    )
    try:
        same(env.reset(), make_vec_env("CartPole-v1", 3, seed=2).reset())
        assert env.env_is_wrapped(Monitor) == [True] * 3
        assert env.env_is_wrapped(gymnasium.wrappers.GrayscaleObservation) == [False] * 3
    finally:
        env.close()


def test_calls_and_attributes(vec_env: Make) -> None:
    env = vec_env([lambda: TimeLimit(Sampling(spaces.Discrete(2)), 9)] * 4)
    env.reset()
    assert env.get_attr("length", indices=[0, -1]) == [4, 4]
    env.set_attr("length", 8, indices=1)
    assert env.get_attr("length") == [4, 8, 4, 4]
    assert env.has_attr("length")
    assert not env.has_attr("width")
    assert env.env_method("set_wrapper_attr", "length", 5, indices=[2]) == [True]
    assert env.get_attr("length") == [4, 8, 5, 4]
    assert env.env_is_wrapped(TimeLimit, indices=[0]) == [True]
    assert [image.shape for image in env.get_images()] == [(2, 2, 3)] * 4
    assert env.render().shape == (4, 4, 3)
    with pytest.raises(AttributeError):
        env.get_attr("width")


def test_the_order_of_calls(vec_env: Make) -> None:
    env = vec_env([Faulty] * 2)
    with pytest.raises(NoAsyncCallError):
        env.step_wait()
    env.reset()
    env.step_async([0, 0])
    with pytest.raises(AlreadyPendingCallError):
        env.step_async([0, 0])
    with pytest.raises(AlreadyPendingCallError):
        env.get_attr("steps")
    assert env.reset().tolist() == [[0], [0]]  # which gives the step up
    with pytest.raises(ValueError, match="actions for 2 environments are needed"):
        env.step([0])
    assert env.step([0, 0])[0].tolist() == [[1], [1]]
    env.close()
    env.close()
    with pytest.raises(ClosedEnvironmentError):
        env.reset()


def test_environments_that_fail(vec_env: Make) -> None:
    env = vec_env([Faulty] * 3)
    env.reset()
    with pytest.raises(ArithmeticError) as caught:
        env.step([0, Faulty.RAISE, 0])
    assert caught.value.__notes__ == ["step of environment 1, of worker 'VecEnv-worker-1'"]
    assert env.reset().tolist() == [[0]] * 3
    with pytest.raises(fiber.WorkerDied, match="step of environment 0"):
        env.step([Faulty.SEGFAULT, 0, 0])


def test_environments_made_anew(vec_env: Make) -> None:
    env = vec_env([Faulty] * 3, on_error="restart")
    env.reset()
    env.step([0, 0, 0])
    with pytest.warns(RuntimeWarning, match="environment 1 replaced"):
        observations, rewards, dones, infos = env.step([0, Faulty.RAISE, 0])
    assert observations.tolist() == [[2], [0], [2]]
    assert rewards.tolist() == [1, 0, 1]
    assert dones.tolist() == [False, True, False]
    assert infos[1].pop("restarted").startswith("step raised ArithmeticError: a bad action (")
    assert infos[1] == {
        "TimeLimit.truncated": True,
        "terminal_observation": np.array([1.0]),
    }


def test_functions_that_make_one_environment_only() -> None:
    from fiber.vector import VecEnv

    env = Faulty()
    with pytest.raises(ValueError, match="had returned before") as caught:
        VecEnv([lambda: env] * 2, num_workers=1)
    assert caught.value.__notes__ == ["the making of environment 1, of worker 'VecEnv-worker-0'"]


def test_gymnasium_alone_does_not_import_it() -> None:
    program = "import fiber.vector; fiber.vector.VectorEnv; import sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "gymnasium" in done.stdout.split()
    assert not {"torch", "stable_baselines3"} & set(done.stdout.split())


def test_a_worker_has_the_resources_of_its_environments(vec_env: Make) -> None:
    env = vec_env([wishful, Faulty], num_workers=1)
    (worker,) = env._dispatcher._workers
    assert worker._wishes == Resources(memory=512)


@fiber.meta(memory=512)
def wishful() -> Faulty:
    return Faulty()
