"""``VectorEnv`` gives what ``SyncVectorEnv`` gives, for all environments.

``RANDOM_VECTOR_ENVS`` is how many mixes of environments are played, by default a few.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from fiber.vector import VectorEnv
from processes.test_vector_env import play_both, same
from vector_envs import Sampling, Step

MIXES = int(os.environ.get("RANDOM_VECTOR_ENVS", "4"))

DTYPES = (np.float16, np.float32, np.float64)
INTEGERS = (np.int8, np.uint8, np.int16, np.uint16, np.int32, np.int64)

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*WARN:UserWarning"),  # Gymnasium's, of odd spaces
]


class Telling(Sampling):
    """Some steps have infos, of every kind that Gymnasium batches in a way of its own."""

    def step(self, action: Any) -> Step:
        observation, reward, terminated, truncated, info = super().step(action)
        chosen = self.np_random.integers(0, 9)
        kinds: list[dict[str, Any]] = [
            {},
            {"whole": 3},
            {"real": 0.5},
            {"yes": True},
            {"array": np.arange(3) + self.steps},
            {"text": "words"},
            {"none": None, "list": [1, "two"]},
            {"nested": {"deeper": {"whole": self.steps}, "text": "x"}},
            {"numpy": np.float32(2.5), "tuple": (1, 2)},
        ]
        return observation, reward, terminated, truncated, info | kinds[chosen]


def some_space(chance: random.Random, depth: int = 0) -> spaces.Space[Any]:
    shape = tuple(chance.randint(1, 3) for _ in range(chance.randint(0, 3)))
    counts: list[Any] = [3, [2, 2]]
    kinds: list[Callable[[], spaces.Space[Any]]] = [
        lambda: spaces.Box(-1, 1, shape, chance.choice(DTYPES)),
        lambda: spaces.Box(0, 100, shape, chance.choice(INTEGERS)),
        lambda: spaces.Discrete(chance.randint(1, 5), start=chance.randint(-3, 3)),
        lambda: spaces.MultiDiscrete(np.full(shape or (2,), chance.randint(1, 4))),
        lambda: spaces.MultiBinary(chance.choice(counts)),
        lambda: spaces.Text(chance.randint(1, 6)),
        lambda: spaces.Graph(spaces.Box(-1, 1, (2,)), chance.choice([None, spaces.Discrete(3)])),
    ]
    if depth < 3:
        part = partial(some_space, chance, depth + 1)
        parts = range(chance.randint(1, 3))
        kinds += [
            lambda: spaces.Dict({f"part {number}": part() for number in parts}),
            lambda: spaces.Tuple([part() for _ in parts]),
            lambda: spaces.OneOf([part() for _ in parts]),
            lambda: spaces.Sequence(spaces.Discrete(4), stack=chance.random() < 0.5),
        ]
    return chance.choice(kinds)()


@pytest.mark.parametrize("seed", range(MIXES))
def test_a_mix_of_environments(seed: int) -> None:
    chance = random.Random(seed)
    observed, acted = some_space(chance), some_space(chance)
    count = chance.randint(1, 7)
    makes = [partial(Telling, observed, acted, chance.randint(1, 6)) for _ in range(count)]
    mode = chance.choice(list(AutoresetMode))
    sync = SyncVectorEnv(makes, autoreset_mode=mode)
    env = VectorEnv(
        makes,
        num_workers=chance.randint(1, 3),
        shared_memory=chance.random() < 0.7,
        autoreset_mode=mode,
    )
    try:
        play_both(env, sync)
        values = [chance.random() for _ in range(count)]
        for each in (env, sync):
            each.set_attr("value", values)
        same(env.get_attr("value"), sync.get_attr("value"))
        same(env.np_random_seed, sync.np_random_seed)
    finally:
        env.close(terminate=True)
        sync.close()
