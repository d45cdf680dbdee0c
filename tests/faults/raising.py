"""Targets that raise an exception whose ``__init__`` takes other arguments than it passes on."""

from __future__ import annotations

from typing import Any, NoReturn

import gymnasium
import numpy as np
from gymnasium import spaces

from faults.pool_targets import hang_in_native_code
from fiber.managers import AsyncManager, BaseManager
from unit.exception_kinds import Unreadable


class Diverged(Exception):
    def __init__(self, step: int, *, loss: float) -> None:
        super().__init__(f"loss {loss} at step {step}")
        self.step = step
        self.loss = loss


def diverge(step: int) -> NoReturn:
    raise Diverged(step, loss=0.5)


def diverge_as_member(rank: int, size: int) -> NoReturn:
    diverge(7)


def raise_unreadable() -> NoReturn:
    raise Unreadable("closed")


def raise_with(thing: object) -> NoReturn:
    error = ValueError("holds a handle")
    error.thing = thing  # type: ignore[attr-defined]
    raise error


class Model:
    def __init__(self, kind: type[BaseException] | None = None) -> None:
        if kind is not None:
            raise kind("in the making")

    def diverge(self, step: int) -> NoReturn:
        diverge(step)

    def end_by(self, kind: type[BaseException]) -> NoReturn:
        raise kind("no display")

    def unpicklable(self, kind: type[BaseException]) -> RaisesWhenPickled:
        return RaisesWhenPickled(kind)

    def double(self, value: int) -> int:
        return 2 * value


def make_model(manager: Any) -> Any:
    """Return a proxy that no other process has."""
    there = ModelManager(manager)
    there.connect()
    return there.Model()  # type: ignore[attr-defined]


class RaisesWhenPickled:
    def __init__(self, kind: type[BaseException]) -> None:
        self._kind = kind

    def __reduce__(self) -> NoReturn:
        raise self._kind("while it is pickled")


class ModelManager(BaseManager):
    pass


class AsyncModelManager(AsyncManager):
    pass


ModelManager.register("Model", Model)
AsyncModelManager.register("Model", Model)


class HangingEnv(gymnasium.Env[Any, Any]):
    observation_space = spaces.Box(0, 1, (1,), np.float64)
    action_space = spaces.Discrete(9)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(1), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        hang_in_native_code()
        raise AssertionError


class DivergingEnv(HangingEnv):
    def step(self, action: Any) -> NoReturn:
        diverge(int(action))
