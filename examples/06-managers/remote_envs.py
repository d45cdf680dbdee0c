"""Environments as managed objects, each in a separate process: on a cluster, in a pod."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

import fiber
from fiber.managers import AsyncManager

Array = npt.NDArray[Any]


class Env:
    """Gymnasium environment that begins a new episode when one ends.

    A step takes ``milliseconds`` at least, as in a game or a robot that runs in real time.
    """

    def __init__(self, name: str, milliseconds: float) -> None:
        self._env: gym.Env[Any, Any] = gym.make(name)
        self._seconds = milliseconds / 1000

    def reset(self, seed: int) -> Array:
        """Return the first observation."""
        observation: Array = self._env.reset(seed=seed)[0]
        return observation

    def step(self, action: int) -> tuple[Array, float, bool]:
        """Return observation, reward, and whether an episode has ended."""
        end = time.perf_counter() + self._seconds
        observation, reward, terminated, truncated, _ = self._env.step(action)
        if terminated or truncated:
            observation, _ = self._env.reset()
        time.sleep(max(0.0, end - time.perf_counter()))
        return observation, float(reward), terminated or truncated


class EnvManager(fiber.BaseManager):
    """Manager whose environments are stepped one after the other: a call returns the result."""


class AsyncEnvManager(AsyncManager):
    """Manager whose environments are stepped side by side: a call returns a result object at
    once."""


for manager in (EnvManager, AsyncEnvManager):
    manager.register("Env", Env)


class RemoteEnvs:
    """Set of environments, each in the process of its manager."""

    def __init__(self, name: str, envs: int, milliseconds: float, *, side_by_side: bool) -> None:
        kind: Any = AsyncEnvManager if side_by_side else EnvManager
        self._side_by_side = side_by_side
        self._managers = [kind() for _ in range(envs)]
        with ThreadPoolExecutor(envs) as starters:
            list(starters.map(kind.start, self._managers))
        self._envs = [manager.Env(name, milliseconds) for manager in self._managers]

    def reset(self, seed: int) -> Array:
        """Return first observations; environment i starts from ``seed`` + i."""
        begun = [env.reset(seed + place) for place, env in enumerate(self._envs)]
        return np.stack(self._results(begun))

    def step(self, actions: Sequence[int] | Array) -> tuple[Array, Array, Array]:
        """Return observations, rewards and which episodes ended, after one action for each."""
        begun = [env.step(int(action)) for env, action in zip(self._envs, actions, strict=True)]
        observations, rewards, over = zip(*self._results(begun), strict=True)
        return np.stack(observations), np.array(rewards), np.array(over)

    def _results(self, begun: list[Any]) -> list[Any]:
        return [handle.get() for handle in begun] if self._side_by_side else begun

    def close(self) -> None:
        """End the processes."""
        for manager in self._managers:
            manager.shutdown()

    def __enter__(self) -> RemoteEnvs:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
