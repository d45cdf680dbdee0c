"""Environments with a chosen cost: none, so that a step shows the cost of the links alone, or time,
or a large observation."""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import numpy as np


class Still(gymnasium.Env[Any, Any]):
    """Environment whose four numbers never change."""

    observation_space = gymnasium.spaces.Box(-1, 1, (4,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self) -> None:
        self.observation = np.zeros(4, np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin again, which changes nothing."""
        super().reset(seed=seed)
        return self.observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Return the same observation, no reward, no end."""
        return self.observation, 0.0, False, False, {}


class Sleeping(Still):
    """Environment whose step takes a millisecond, and no processor."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step as `Still` does, a millisecond later."""
        time.sleep(0.001)
        return super().step(action)


class Uneven(Still):
    """Environment with one step in ten of five milliseconds, the others of a tenth of one."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step as `Still` does, after the time of this step."""
        time.sleep(0.005 if self.np_random.random() < 0.1 else 0.0001)
        return super().step(action)


class Pixels(gymnasium.Env[Any, Any]):
    """Environment with four frames of an Atari game, each time another picture."""

    observation_space = gymnasium.spaces.Box(0, 255, (84, 84, 4), np.uint8)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self) -> None:
        self.observation = np.zeros((84, 84, 4), np.uint8)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin again, which changes nothing."""
        super().reset(seed=seed)
        return self.observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """All pixels change."""
        self.observation += 1
        return self.observation, 0.0, False, False, {}


def cart_pole() -> gymnasium.Env[Any, Any]:
    """Gymnasium's CartPole."""
    return gymnasium.make("CartPole-v1")
