"""Environments that both programs step, and the clock that times them."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium as gym

MakeEnv = Callable[[], gym.Env[Any, Any]]


class Simulator(gym.Wrapper[Any, Any, Any, Any]):
    """Environment whose step takes so many milliseconds of a core, as in a real simulator."""

    def __init__(self, env: gym.Env[Any, Any], milliseconds: float) -> None:
        super().__init__(env)
        self._seconds = milliseconds / 1000

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        # The time of this thread on a core, not the clock on the wall: two environments that share
        # a core must not count the same moment twice.
        end = time.thread_time() + self._seconds
        result = self.env.step(action)
        while time.thread_time() < end:
            pass
        return result


def make(name: str, milliseconds: float) -> gym.Env[Any, Any]:
    """Make one environment, slowed down to `milliseconds` a step if it is faster."""
    env: gym.Env[Any, Any] = gym.make(name)
    return Simulator(env, milliseconds) if milliseconds else env


def makers(options: argparse.Namespace, milliseconds: float) -> list[MakeEnv]:
    """Return a function for each environment that makes it, in any process."""
    return [partial(make, options.env, milliseconds)] * options.envs


def rate(step: Callable[[], object], options: argparse.Namespace) -> float:
    """Return environment steps a second, when `step` steps all of the environments once."""
    steps: int = options.steps
    envs: int = options.envs
    started = time.perf_counter()
    for _ in range(steps):
        step()
    return steps * envs / (time.perf_counter() - started)


def parse(description: str, arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the options that both programs have."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("--envs", type=int, default=8, help="how many environments")
    parser.add_argument("--steps", type=int, default=100, help="steps of each environment")
    parser.add_argument(
        "--ms", type=float, default=10.0, help="milliseconds of a slow simulator's step"
    )
    options = parser.parse_args(arguments)
    if options.envs < 1 or options.steps < 1 or options.ms < 0:
        parser.error("--envs and --steps must be at least 1, --ms at least 0")
    try:
        gym.make(options.env).close()
    except gym.error.Error as error:
        parser.error(f"--env {options.env}: {error}")
    return options
