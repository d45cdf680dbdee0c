"""Environments that cost as much as is wanted: nothing, so that a vector step shows the cost of the
links alone, or time, or a large observation.
"""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import numpy as np


class Still(gymnasium.Env[Any, Any]):
    """Four numbers that never change."""

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
        """The same observation, no reward, no end."""
        return self.observation, 0.0, False, False, {}


class Sleeping(Still):
    """A step takes a millisecond, and no processor."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """As that of `Still`, a moment later."""
        time.sleep(0.001)
        return super().step(action)


class Uneven(Still):
    """One step in ten takes five milliseconds, the others a tenth of one."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """As that of `Still`, sooner or later."""
        time.sleep(0.005 if self.np_random.random() < 0.1 else 0.0001)
        return super().step(action)


class Pixels(gymnasium.Env[Any, Any]):
    """Four frames of an Atari game, each time another picture."""

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
    """The real one."""
    return gymnasium.make("CartPole-v1")
