"""Proximal policy optimization (Schulman et al., 2017) with a linear policy, in NumPy.

The policy sees two successive frames, each reduced to 20x20 means. That is enough to learn a
little; the experiment measures how fast the environments are stepped.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import numpy.typing as npt
from benchmarks.paper.atari import ACTIONS, SIDE

Array = npt.NDArray[np.float32]

BLOCK = 4
FEATURES = 2 * (SIDE // BLOCK) ** 2
DISCOUNT, SMOOTHING, CLIP, RATE = 0.99, 0.95, 0.1, 0.003
EPOCHS, MINIBATCHES = 4, 4


class Learner:
    """Linear policy and linear estimate of values over the same features."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._policy = np.zeros((FEATURES, ACTIONS), np.float32)
        self._value = np.zeros(FEATURES, np.float32)

    def act(self, features: Array) -> tuple[Any, Array, Array]:
        """Return actions, their probabilities, and the values of the states."""
        chances = softmax(features @ self._policy)
        drawn = self._rng.random((len(features), 1))
        actions = np.minimum((chances.cumsum(axis=1) < drawn).sum(axis=1), ACTIONS - 1)
        return actions, chances[np.arange(len(actions)), actions], self.values(features)

    def values(self, features: Array) -> Array:
        """Return the estimated values of the states."""
        found: Array = features @ self._value
        return found

    def learn(
        self, features: Array, actions: Any, chances: Array, advantages: Array, goals: Array
    ) -> None:
        """Take the steps of one rollout."""
        scaled = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        for _ in range(EPOCHS):
            for part in np.array_split(self._rng.permutation(len(actions)), MINIBATCHES):
                self._step(features[part], actions[part], chances[part], scaled[part], goals[part])

    def _step(
        self, features: Array, actions: Any, before: Array, advantages: Array, goals: Array
    ) -> None:
        every = np.arange(len(actions))
        chances = softmax(features @ self._policy)
        ratio = chances[every, actions] / before
        clipped = np.where(advantages > 0, ratio > 1 + CLIP, ratio < 1 - CLIP)
        push = np.where(clipped, 0, ratio * advantages)[:, None]
        gradient = -chances * push
        gradient[every, actions] += push[:, 0]
        self._policy += RATE * features.T @ gradient / len(actions)
        errors = goals - self.values(features)
        self._value += RATE * features.T @ errors / len(actions)


class Training:
    """PPO on a vector of environments. `collecting`: seconds spent on steps and choices."""

    def __init__(self, envs: Any, count: int) -> None:
        self.collecting = 0.0
        self._envs = envs
        self._count = count
        self._learner = Learner(np.random.default_rng(1))
        self._frame = reduced(envs.reset())
        self._features = np.concatenate([self._frame, self._frame], axis=1)

    def steps(self, number: int) -> list[tuple[Array, Any, Array, Array, Array, Array]]:
        """Step all environments so often, by the policy."""
        made = []
        for _ in range(number):
            features = self._features
            actions, chances, values = self._learner.act(features)
            frames, rewards, over, _ = self._envs.step(actions)
            frame, last = reduced(frames), self._frame
            self._frame, self._features = frame, np.concatenate([frame, last], axis=1)
            made.append((features, actions, chances, values, rewards, np.float32(1) - over))
        return made

    def run(self, total: int, horizon: int) -> None:
        """Collect and learn until all environments together have made `total` steps."""
        left = total // self._count
        while left > 0:
            begin = time.perf_counter()
            rollout = self.steps(min(horizon, left))
            self.collecting += time.perf_counter() - begin
            left -= len(rollout)
            features, actions, chances, values, rewards, goes_on = (
                np.stack(column) for column in zip(*rollout, strict=True)
            )
            last = self._learner.values(self._features)
            found = advantages(rewards, np.concatenate([values, last[None]]), goes_on)
            self._learner.learn(
                features.reshape(-1, FEATURES),
                actions.ravel(),
                chances.ravel(),
                found.ravel(),
                (found + values).ravel(),
            )


def advantages(rewards: Array, values: Array, goes_on: Array) -> Array:
    """Return generalized advantages (Schulman et al., 2016); `values` has one row more."""
    found = np.zeros_like(values)
    for at in reversed(range(len(rewards))):
        error = rewards[at] + DISCOUNT * goes_on[at] * values[at + 1] - values[at]
        found[at] = error + DISCOUNT * SMOOTHING * goes_on[at] * found[at + 1]
    return found[:-1]


def softmax(scores: Array) -> Array:
    """Return probabilities, each row with the sum 1."""
    powers = np.exp(scores - scores.max(axis=1, keepdims=True))
    chances: Array = powers / powers.sum(axis=1, keepdims=True)
    return chances


def reduced(frames: Any) -> Array:
    """Return the means of blocks of each frame, as one row of numbers from 0 to 1."""
    side = SIDE // BLOCK
    blocks = frames.reshape(len(frames), side, BLOCK, side, BLOCK)
    means: Array = blocks.mean(axis=(2, 4), dtype=np.float32).reshape(len(frames), -1) / 255
    return means
