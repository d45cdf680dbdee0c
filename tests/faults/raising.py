"""What raises an exception whose ``__init__`` takes other arguments than it passes on."""

from __future__ import annotations

from typing import Any, NoReturn

import gymnasium
import numpy as np
from gymnasium import spaces

from fiber.managers import BaseManager


class Diverged(Exception):
    def __init__(self, step: int, *, loss: float) -> None:
        super().__init__(f"loss {loss} at step {step}")
        self.step = step
        self.loss = loss


def diverge(step: int) -> NoReturn:
    raise Diverged(step, loss=0.5)


def diverge_as_member(rank: int, size: int) -> NoReturn:
    diverge(7)


class Model:
    def diverge(self, step: int) -> NoReturn:
        diverge(step)


class ModelManager(BaseManager):
    pass


ModelManager.register("Model", Model)


class DivergingEnv(gymnasium.Env[Any, Any]):
    observation_space = spaces.Box(0, 1, (1,), np.float64)
    action_space = spaces.Discrete(9)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(1), {}

    def step(self, action: Any) -> NoReturn:
        diverge(int(action))
