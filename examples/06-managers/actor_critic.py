"""Learner: a policy and a value function, both linear in a few features, in NumPy.

It knows no processes: it gets observations, gives actions, and learns from the outcome.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

GAMMA = 0.98
"""Weight of a reward one step earlier."""
POLICY_RATE, VALUE_RATE = 0.2, 0.1


class ActorCritic:
    """Actor for many environments at once, which learns from experience."""

    def __init__(self, observation_size: int, actions: int, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._policy = np.zeros((_features(np.zeros((1, observation_size))).shape[1], actions))
        self._value = np.zeros(len(self._policy))
        self._updates = 0

    def act(self, observations: Array) -> Array:
        """Return an action for each observation, drawn from the policy."""
        below = np.cumsum(self._probabilities(_features(observations)), axis=1)
        drawn = self._rng.random((len(below), 1))
        chosen: Array = (drawn > below[:, :-1]).sum(axis=1)
        return chosen

    def update(self, observations: Array, actions: Array, rewards: Array, over: Array) -> None:
        """Learn from some steps of all environments; the observations have one step more.

        The first index of each is the step, the second the environment.
        """
        values = _features(observations) @ self._value
        returns = np.empty_like(rewards)
        ahead = values[-1]
        for step in reversed(range(len(rewards))):
            ahead = rewards[step] + GAMMA * np.where(over[step], 0.0, ahead)
            returns[step] = ahead
        features = _features(observations[:-1])
        surprise = returns - values[:-1]
        scale = np.mean(features**2)
        self._value += VALUE_RATE * np.mean(surprise[..., None] * features, axis=(0, 1)) / scale
        advantage = (surprise - surprise.mean()) / (surprise.std() + 1e-8)
        taken = np.eye(self._policy.shape[1])[actions]
        towards = advantage[..., None] * (taken - self._probabilities(features))
        gradient = np.einsum("tef,tea->fa", features, towards) / rewards.size
        self._updates += 1
        rate = POLICY_RATE / np.sqrt(self._updates)
        self._policy += rate * gradient / np.sqrt(np.mean(gradient**2) + 1e-12)

    def _probabilities(self, features: Array) -> Array:
        scores = features @ self._policy
        weights = np.exp(scores - scores.max(axis=-1, keepdims=True))
        probabilities: Array = weights / weights.sum(axis=-1, keepdims=True)
        return probabilities


def _features(observations: Array) -> Array:
    """Return the numbers of an observation, their squares, and one."""
    ones = np.ones((*observations.shape[:-1], 1))
    return np.concatenate([observations, observations**2, ones], axis=-1)
