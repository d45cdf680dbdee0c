"""``fiber.vector.VectorEnv`` is what Gymnasium's ``SyncVectorEnv`` is."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import fiber.vector
from fiber.vector import VectorEnv
from fiber.vector.worker_process import WorkerProcess
from vector_envs import Faulty, Noticing, Sampling

MIXED = spaces.Dict(
    {
        "image": spaces.Box(0, 255, (3, 4, 2), np.uint8),
        "pair": spaces.Tuple((spaces.Discrete(5, start=-2), spaces.MultiBinary([2, 3]))),
        "half": spaces.Box(-1, 1, (2,), np.float16),
        "words": spaces.Text(5),
    }
)
SPACES: dict[str, spaces.Space[Any]] = {
    "numbers": spaces.Box(-1, 1, (), np.float64),
    "array": spaces.Box(-1, 1, (2, 3), np.float32),
    "discrete": spaces.MultiDiscrete([3, 4]),
    "graphs": spaces.Graph(spaces.Box(-1, 1, (2,)), spaces.Discrete(3)),
    "sequences": spaces.Tuple((spaces.Sequence(spaces.Discrete(4)), spaces.Discrete(2))),
    "one of several": spaces.OneOf((spaces.Discrete(3), spaces.Text(4))),
    "mixed": MIXED,
}

Make = Callable[..., VectorEnv]


@pytest.fixture
def vector_env() -> Iterator[Make]:
    """Makes a ``VectorEnv`` that is closed after the test."""
    made: list[VectorEnv] = []

    def make(*args: Any, num_workers: int = 2, **kwargs: Any) -> VectorEnv:
        made.append(VectorEnv(*args, num_workers=num_workers, **kwargs))
        return made[-1]

    yield make
    for env in made:
        env.close(terminate=True)


def same(one: Any, other: Any) -> None:
    """Equal, and of the same types all the way down."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert list(one) == list(other)
        for key in one:
            same(one[key], other[key])
    elif isinstance(one, tuple | list):
        assert len(one) == len(other)
        for mine, its in zip(one, other, strict=True):
            same(mine, its)
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        assert one.shape == other.shape
        if one.dtype == object:
            same(one.tolist(), other.tolist())
        else:
            np.testing.assert_array_equal(one, other)
    else:
        assert one == other


def play_both(env: VectorEnv, sync: SyncVectorEnv, steps: int = 12) -> None:
    """The same seeds and actions lead to the same in both."""
    assert env.observation_space == sync.observation_space
    assert env.action_space == sync.action_space
    assert env.metadata == sync.metadata
    same(env.reset(seed=7, options={"a": 1}), sync.reset(seed=7, options={"a": 1}))
    sync.action_space.seed(1)
    disabled = env.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    for _ in range(steps):
        actions = sync.action_space.sample()
        mine, its = env.step(actions), sync.step(actions)
        same(mine, its)
        over = its[2] | its[3]
        if disabled and over.any():
            mask = {"reset_mask": over}
            same(env.reset(options=dict(mask)), sync.reset(options=dict(mask)))
    same(env.render(), sync.render())


@pytest.mark.parametrize("space", SPACES)
def test_environments_give_the_same_as_sync_vector_env(space: str, vector_env: Make) -> None:
    makes = [partial(Sampling, SPACES[space], length=3 + number % 3) for number in range(5)]
    play_both(vector_env(makes), SyncVectorEnv(makes))


@pytest.mark.parametrize("shared_memory", [True, False])
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_environments_give_the_same_as_sync_vector_env_in_each_autoreset_mode(
    mode: AutoresetMode, shared_memory: bool, vector_env: Make
) -> None:
    makes = [partial(Sampling, MIXED, length=2 + number) for number in range(3)]
    env = vector_env(makes, shared_memory=shared_memory, autoreset_mode=mode)
    play_both(env, SyncVectorEnv(makes, autoreset_mode=mode))


@pytest.mark.parametrize("space", ["array", "discrete", "graphs", "mixed"])
def test_actions_of_any_space(space: str, vector_env: Make) -> None:
    makes = [partial(Sampling, spaces.Discrete(3), SPACES[space])] * 3
    for shared_memory in (True, False):
        env = vector_env(makes, shared_memory=shared_memory)
        play_both(env, SyncVectorEnv(makes), steps=6)


def test_cart_poles_of_gymnasium(vector_env: Make) -> None:
    makes = [partial(gymnasium.make, "CartPole-v1")] * 7
    env = vector_env(makes, num_workers=3)
    sync = SyncVectorEnv(makes)
    same(env.reset(seed=list(range(7))), sync.reset(seed=list(range(7))))
    sync.action_space.seed(1)
    for _ in range(100):
        actions = sync.action_space.sample()
        same(env.step(actions), sync.step(actions))
    assert env.np_random_seed == sync.np_random_seed
    for mine, its in zip(env.np_random, sync.np_random, strict=True):
        assert mine.normal() == its.normal()


@pytest.mark.slow
def test_spaces_that_differ(vector_env: Make) -> None:
    makes = [partial(Sampling, spaces.Box(0, high, (2,))) for high in (1, 2, 3)]
    env = vector_env(makes, observation_mode="different")
    play_both(env, SyncVectorEnv(makes, observation_mode="different"))
    with pytest.raises(RuntimeError, match=r"equivalent\. environment 1, of worker .*worker-1'"):
        VectorEnv(makes, num_workers=2)
    makes[2] = partial(Sampling, spaces.Box(0, 1, (3,)))
    with pytest.raises(RuntimeError, match=r"share a common shape .*environment 2, of .*worker-1'"):
        VectorEnv(makes, num_workers=2, observation_mode="different")
    makes = [partial(Sampling, MIXED, spaces.Discrete(number)) for number in (2, 3)]
    with pytest.raises(RuntimeError, match="action spaces are not equivalent"):
        VectorEnv(makes)


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"num_workers": 0}, ValueError),
        ({"on_error": "ignore"}, ValueError),
        ({"timeout": 0}, ValueError),
        ({"observation_mode": "odd"}, ValueError),
        ({"observation_mode": (1, 2)}, TypeError),
        ({"autoreset_mode": "odd"}, ValueError),
        ({"context": "odd"}, ValueError),
    ],
)
def test_bad_options(wrong: dict[str, Any], error: type[Exception]) -> None:
    with pytest.raises(error):
        VectorEnv([Faulty], **wrong)
    with pytest.raises(ValueError, match="env_fns is empty"):
        VectorEnv([])


def test_a_wrong_keyword_shows_one_error(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", shown.append)
    with pytest.raises(TypeError, match="unexpected keyword argument 'workers'"):
        VectorEnv([Faulty], workers=2)  # type: ignore[call-arg]
    gc.collect()
    assert shown == []


def test_an_environment_that_cannot_be_made_or_pickled() -> None:
    def fail() -> Any:
        raise LookupError("no simulator")

    with pytest.raises(LookupError, match="no simulator") as caught:
        VectorEnv([Faulty, Faulty, fail], num_workers=2)
    assert caught.value.__notes__ == ["the making of environment 2, of worker 'VectorEnv-worker-1'"]
    generator: Any = (each for each in "")
    with pytest.raises(fiber.UnpicklableError, match=r"environment 1, of worker '.*worker-1'"):
        VectorEnv([Faulty, lambda: generator], num_workers=2)


def test_environments_are_distributed_evenly_over_the_workers(vector_env: Make) -> None:
    env = vector_env([Faulty] * 5, num_workers=3)
    pids = env.call("pid")
    assert [pids.count(pid) for pid in dict.fromkeys(pids)] == [1, 2, 2]
    assert len(set(vector_env([Faulty] * 2, num_workers=9).call("pid"))) == 2


def test_many_environments_are_not_compared_with_each_other(vector_env: Make) -> None:
    env = vector_env([Noticing] * 200, num_workers=1)
    assert set(env.get_attr("looks")) == {200}


def test_calls_and_attributes(vector_env: Make) -> None:
    env = vector_env([partial(Sampling, MIXED, length=length) for length in (3, 4, 5)])
    env.reset()
    assert env.get_attr("length") == (3, 4, 5)
    env.set_attr("length", [6, 7, 8])
    assert env.get_attr("length") == (6, 7, 8)
    env.set_attr("length", 9)
    assert env.get_attr("length") == (9, 9, 9)
    with pytest.raises(ValueError, match="Got `2` values for 3 environments"):
        env.set_attr("length", [1, 2])
    with pytest.raises(AttributeError) as caught:
        env.call("nothing")
    assert "a call of environment 0" in caught.value.__notes__[0]
    with pytest.raises(ValueError, match=r"call step\(\) of the vector environment"):
        env.call("step", 1)
    env.set_attr("thread", [1, 2, 3])
    env.set_attr("source", "[]")
    assert env.call("render")[2].shape == (2, 2, 3)


def test_observations_are_copies_unless_asked(vector_env: Make) -> None:
    first, _ = vector_env([Faulty]).reset()
    env = vector_env([Faulty], copy=False)
    seen, _ = env.reset()
    again = env.step([Faulty.GOOD])[0]
    assert seen is again or np.shares_memory(seen, again)
    assert seen[0] == 1
    assert first[0] == 0


def test_actions_that_do_not_fit(vector_env: Make) -> None:
    env = vector_env([Faulty] * 3)
    env.reset()
    with pytest.raises(ValueError, match="actions for 3 environments are needed"):
        env.step([0, 0])
    with pytest.raises(ValueError, match="num_envs=3 but got length=1"):
        env.reset(seed=[1])
    assert env.step([0, 0, 0])[0].tolist() == [[1], [1], [1]]
    checked = vector_env([partial(gymnasium.make, "CartPole-v1")] * 2)
    with pytest.raises(gymnasium.error.ResetNeeded) as caught:
        checked.step([0, 0])
    assert "step of environment 0" in caught.value.__notes__[0]
    checked.reset()
    with pytest.raises(AssertionError, match="5") as bad:
        checked.step([0, 5])
    assert "step of environment 1, of worker 'VectorEnv-worker-1'" in bad.value.__notes__[0]


@pytest.mark.parametrize(
    ("mask", "error"),
    [
        ([True, False], TypeError),
        (np.array([1, 0]), TypeError),
        (np.array([True]), ValueError),
        (np.array([False, False]), ValueError),
    ],
)
def test_invalid_reset_masks_are_refused(
    mask: Any, error: type[Exception], vector_env: Make
) -> None:
    with pytest.raises(error, match="reset_mask"):
        vector_env([Faulty] * 2).reset(options={"reset_mask": mask})


def test_the_order_of_calls(vector_env: Make) -> None:
    env = vector_env([Faulty] * 2)
    with pytest.raises(NoAsyncCallError, match="`step_wait` without any prior"):
        env.step_wait()
    env.reset_async()
    with pytest.raises(AlreadyPendingCallError, match=r"`step_async` while waiting .* `reset`"):
        env.step_async([0, 0])
    env.reset_wait()
    env.step_async([0, 0])
    with pytest.warns(UserWarning, match="pending call to `step`"):
        env.close()
    for call in (env.reset, env.step_wait, lambda: env.send([0]), env.recv, env.render):
        with pytest.raises(ClosedEnvironmentError):
            call()


def test_recv_returns_the_environments_that_are_ready_first(vector_env: Make) -> None:
    env = vector_env([Faulty] * 5)
    with pytest.raises(ValueError, match="would wait for ever: 0 environments"):
        env.recv(1)
    env.reset_async(seed=1)
    with pytest.raises(ValueError, match="would wait for ever: 5 environments"):
        env.recv(6)
    seen = np.zeros(5)
    for _ in range(20):
        observations, rewards, terminations, truncations, infos = env.recv(3)
        numbers = infos["env_id"]
        assert len(set(numbers)) == len(observations) == len(rewards) == 3
        assert not terminations.any()
        assert not truncations.any()
        assert observations[:, 0].tolist() == seen[numbers].tolist()
        seen[numbers] += 1
        env.send(np.zeros(3, np.int64))
    with pytest.raises(AlreadyPendingCallError, match="whose result was not received yet"):
        env.send([0], env_ids=[0])
    with pytest.raises(AlreadyPendingCallError, match="pending call to `send`"):
        env.reset()
    assert sorted(env.recv()[4]["env_id"]) == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match="env_ids has 5, and environments are 0 to 4"):
        env.send([0], env_ids=[5])
    with pytest.raises(ValueError, match="twice"):
        env.send([0, 0], env_ids=[1, 1])
    env.send([0, 0], env_ids=np.array([4, 2]))
    assert sorted(env.recv(2)[4]["env_id"]) == [2, 4]
    assert env.step([0] * 5)[0].shape == (5, 1)
    env.send([0] * 5)
    assert len(env.recv()[0]) == 5


def test_ready_environments_do_not_wait_for_slow_ones(vector_env: Make, tmp_path: Any) -> None:
    gate = tmp_path / "gate"
    env = vector_env([partial(Faulty, gate)] * 4)  # in each worker one that waits
    env.reset()
    env.step([Faulty.GOOD, Faulty.SLOW, Faulty.GOOD, Faulty.SLOW])  # now that is known
    env.send([Faulty.GOOD, Faulty.WAIT, Faulty.GOOD, Faulty.WAIT])
    with pytest.raises(fiber.TimeoutError, match=r"within 0\.01 s"):
        env.recv(4, timeout=0.01)
    assert sorted(env.recv(2)[4]["env_id"]) == [0, 2]
    gate.touch()
    assert sorted(env.recv(2)[4]["env_id"]) == [1, 3]


def test_infos_of_a_batch_have_its_rows(vector_env: Make) -> None:
    makes = [partial(Sampling, spaces.Discrete(2), length=20)] * 4
    env, sync = vector_env(makes), SyncVectorEnv(makes)
    env.reset(seed=3)
    sync.reset(seed=3)
    sync.step([0, 0, 0, 0])
    expected = sync.step([0, 0, 0, 0])[4]
    env.step([0, 0, 0, 0])
    env.send([0, 0, 0, 0])
    _, _, _, _, infos = env.recv(4)
    numbers = infos["env_id"]
    assert infos["steps"].tolist() == [2] * 4
    assert infos["name"].tolist() == expected["name"][numbers].tolist()
    assert infos["_steps"].all()


def test_wrappers_of_gymnasium(vector_env: Make) -> None:
    makes = [partial(gymnasium.make, "CartPole-v1")] * 3
    wrappers = gymnasium.wrappers.vector
    wrapped = [
        wrappers.NormalizeObservation(wrappers.RecordEpisodeStatistics(each))
        for each in (vector_env(makes), SyncVectorEnv(makes))
    ]
    mine, its = (each.reset(seed=4) for each in wrapped)
    same(mine, its)
    ended = 0
    for _ in range(60):
        my_step, its_step = (each.step(np.array([0, 1, 0])) for each in wrapped)
        for results in (my_step, its_step):
            results[4].get("episode", {}).pop("t", None)  # seconds
        same(my_step, its_step)
        ended += "episode" in my_step[4]
    assert ended > 3


def test_made_by_id(monkeypatch: pytest.MonkeyPatch) -> None:
    wrapper = partial(gymnasium.wrappers.TransformReward, func=float)
    env = fiber.vector.make_vec(
        "CartPole-v1",
        3,
        vector_kwargs={"num_workers": 1, "autoreset_mode": "SameStep"},
        wrappers=[wrapper],
        max_episode_steps=5,
    )
    try:
        assert (env.num_envs, len(set(env.call("__hash__")))) == (3, 3)
        assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
        assert env.get_attr("spec")[0].max_episode_steps == 5
    finally:
        env.close()


def test_a_registered_environment_makes_fibers_vector_env(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = gymnasium.spec("CartPole-v1")
    monkeypatch.setattr(spec, "vector_entry_point", spec.vector_entry_point)
    fiber.vector.register("CartPole-v1", num_workers=1)
    modes: list[dict[str, Any]] = [{}, {"vectorization_mode": "vector_entry_point"}]
    for mode in modes:
        env = gymnasium.make_vec("CartPole-v1", 2, max_episode_steps=6, **mode)
        assert isinstance(env, VectorEnv)
        assert env.get_attr("spec")[0].max_episode_steps == 6
        env.close()


def test_a_learner_that_drops_it_leaves_no_process(vector_env: Make) -> None:
    env = VectorEnv([Faulty], num_workers=1)
    workers: list[WorkerProcess] = list(env._sub_environments.dispatcher._workers)
    assert workers[0].process.is_alive()
    del env
    with pytest.raises(ValueError, match="closed"):
        workers[0].process.is_alive()
