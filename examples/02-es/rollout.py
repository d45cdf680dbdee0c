"""Work of the pool's workers: set up once, then evaluate candidates.

These functions have a separate module, so that only their names travel.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from evolution import Candidate
from noise import NoiseTable
from policy import Policy, Vector, make_env, play, play_randomly


class Worker:
    """State that one worker keeps between tasks."""

    def __init__(self, env_name: str, table: NoiseTable) -> None:
        self.env: gym.Env[Any, Any] = make_env(env_name)
        self.policy = Policy(self.env)
        self.noise = table.open()

    def play(self, theta: Vector, seed: int) -> float:
        """Return the return of the policy `theta` in the episode `seed`."""
        return play(self.env, self.policy.act(theta), seed)


worker: Worker


def prepare(env_name: str, table: NoiseTable) -> None:
    """Set up a worker: the pool's initializer."""
    global worker
    worker = Worker(env_name, table)


def evaluate(theta: Vector, sigma: float, candidate: Candidate) -> tuple[int, tuple[float, float]]:
    """Play both halves of a pair; return the noise index and the two returns."""
    index, seed = candidate
    step = sigma * worker.noise[index : index + theta.size]
    return index, (worker.play(theta + step, seed), worker.play(theta - step, seed))


def test(theta: Vector, seed: int) -> float:
    """Return the return of the policy itself, without noise."""
    return worker.play(theta, seed)


def baseline(seed: int) -> float:
    """Return the return of random actions."""
    return play_randomly(worker.env, seed)
