"""An environment that costs nothing, so that a vector step shows the cost of the links alone."""

from __future__ import annotations

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
