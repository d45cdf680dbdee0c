"""Gymnasium's AsyncVectorEnv on Fiber, over spaces of every kind, with shared memory and without:
both see what SyncVectorEnv sees.
"""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv, VectorEnv

import fiber

ENVS, STEPS = 3, 20

SPACE = spaces.Dict(
    {
        "buttons": spaces.MultiBinary(4),
        "flag": spaces.Box(0, 1, (), np.bool_),  # type: ignore[arg-type]
        "image": spaces.Box(0, 255, (6, 5), np.uint8),
        "pose": spaces.Tuple((spaces.Box(-1, 1, (3,), np.float64), spaces.Discrete(7))),
    }
)


class Dreamer(gym.Env[Any, Any]):
    """Sees something else at every step."""

    def __init__(self) -> None:
        self.observation_space = copy.deepcopy(SPACE)
        self.action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 0.0, False, False, {}


def seen(envs: VectorEnv[Any, Any, Any]) -> list[str]:
    """All observations of a few steps, as text."""
    try:
        observations = [envs.reset(seed=7)[0]]
        observations += [envs.step(np.zeros(ENVS, np.int64))[0] for _ in range(STEPS)]
        return [repr(observation) for observation in observations]
    finally:
        envs.close()


def main() -> None:
    """Compare."""
    fiber.adopt("gymnasium.vector.async_vector_env")
    makers = [Dreamer] * ENVS
    expected = seen(SyncVectorEnv(makers))
    assert len(set(expected)) == STEPS + 1
    for shared in (True, False):
        same = seen(AsyncVectorEnv(makers, shared_memory=shared)) == expected
        print(f"shared_memory={shared}:", "the same" if same else "something else")


if __name__ == "__main__":
    main()
