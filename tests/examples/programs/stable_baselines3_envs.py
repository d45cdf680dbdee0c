"""stable-baselines3's own SubprocVecEnv beside its DummyVecEnv: they must not differ.

stable_baselines3_envs.py multiprocessing|fiber
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

ENVS = 2


def make(length: float) -> Any:
    env = gymnasium.make("CartPole-v1")
    env.unwrapped.length = length  # type: ignore[attr-defined]
    return Monitor(env)


def main() -> None:
    if sys.argv[1] == "fiber":
        import fiber

        fiber.adopt("stable_baselines3.common.vec_env.subproc_vec_env")
    makes: list[Any] = [partial(make, 0.5 + place) for place in range(ENVS)]
    here, there = DummyVecEnv(makes), SubprocVecEnv(makes)
    here.seed(7)
    there.seed(7)
    same = np.array_equal(here.reset(), there.reset())
    here.action_space.seed(1)
    ended = 0
    for _ in range(60):
        actions = np.array([here.action_space.sample() for _ in range(ENVS)])
        mine, its = here.step(actions), there.step(actions)
        same &= all(
            np.array_equal(one, other) for one, other in zip(mine[:3], its[:3], strict=True)
        )
        ended += int(mine[2].sum())
    print("same", same, "ended", ended)
    print(there.get_attr("length"), there.get_attr("spec")[0].id)
    there.set_attr("length", 2.0, indices=[1])
    print(there.get_attr("length"), there.env_is_wrapped(Monitor))
    print(there.env_method("get_wrapper_attr", "length", indices=1))
    there.close()
    print("closed")


if __name__ == "__main__":
    main()
