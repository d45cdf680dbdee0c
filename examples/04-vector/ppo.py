"""Proximal policy optimization (Schulman et al. 2017), for actions that are numbers."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from network import Array, Network

DISCOUNT, SMOOTHING = 0.98, 0.8
CLIP, RATE = 0.2, 1e-3
EPOCHS, MINIBATCH = 10, 256


class Experience(NamedTuple):
    """Data of a rollout: by step, then by environment."""

    observations: Array
    actions: Any
    log_likelihoods: Array
    values: Array
    rewards: Array
    over: Any
    """True where the episode ended with this step."""
    cut_short: Array
    """Value of the last state of an episode that only ran out of time; else 0."""
    last_values: Array
    """Value of the state that the last step led to."""


class Learner:
    """Policy, estimates of the value of states, and how both learn."""

    def __init__(self, inputs: int, actions: int, rng: np.random.Generator) -> None:
        self._rng = rng
        self._policy = Network([inputs, 64, 64, actions], rng, last_scale=0.01)
        self._critic = Network([inputs, 64, 64, 1], rng)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self._policy.size + self._critic.size

    def act(self, observations: Array) -> tuple[Any, Array, Array]:
        """Return an action for each observation, its likelihood (a logarithm), and the state's
        value."""
        logs = _log_softmax(self._policy(observations))
        # The largest of logarithm and noise: a draw from the distribution (Gumbel).
        actions = np.argmax(logs + self._rng.gumbel(size=logs.shape), axis=1)
        return actions, logs[np.arange(len(logs)), actions], self.values(observations)

    def values(self, observations: Array) -> Array:
        """Return the values of states."""
        return self._critic(observations)[:, 0]

    def learn(self, experience: Experience, share_left: float) -> None:
        """Improve by this experience, the less the less training is left."""
        advantages = _advantages(experience)
        targets = (advantages + experience.values).ravel()
        observations = experience.observations.reshape(targets.size, -1)
        actions, before = experience.actions.ravel(), experience.log_likelihoods.ravel()
        flat = advantages.ravel()
        for _ in range(EPOCHS):
            order = self._rng.permutation(targets.size)
            for chosen in np.split(order, range(MINIBATCH, order.size, MINIBATCH)):
                advantage = flat[chosen]
                advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                self._improve_policy(
                    observations[chosen], actions[chosen], before[chosen], advantage, share_left
                )
                error = self.values(observations[chosen]) - targets[chosen]
                self._critic.train(error[:, None] / error.size, RATE * share_left)

    def _improve_policy(
        self, observations: Array, actions: Any, before: Array, advantage: Array, share_left: float
    ) -> None:
        logs = _log_softmax(self._policy(observations))
        rows, likelihoods = np.arange(len(logs)), np.exp(logs)
        ratio = np.exp(logs[rows, actions] - before)
        # Where the ratio is clipped and the advantage would move it on, there is no gradient.
        clip = CLIP * share_left
        moved = np.where(advantage > 0, ratio > 1 + clip, ratio < 1 - clip)
        weight = np.where(moved, 0.0, -advantage * ratio)
        gradient = -likelihoods * weight[:, None]
        gradient[rows, actions] += weight
        self._policy.train(gradient / len(logs), RATE * share_left)


def _advantages(experience: Experience) -> Array:
    """Return how much better each action was than expected (generalized advantage estimation)."""
    advantages = np.zeros_like(experience.rewards)
    following, next_values = np.zeros_like(experience.last_values), experience.last_values
    for step in reversed(range(len(advantages))):
        goes_on = 1.0 - experience.over[step]
        surprise = (
            experience.rewards[step]
            + DISCOUNT * (next_values * goes_on + experience.cut_short[step])
            - experience.values[step]
        )
        following = surprise + DISCOUNT * SMOOTHING * goes_on * following
        advantages[step], next_values = following, experience.values[step]
    return advantages


def _log_softmax(logits: Array) -> Array:
    shifted = logits - logits.max(axis=1, keepdims=True)
    result: Array = shifted - np.log(np.exp(shifted).sum(axis=1, keepdims=True))
    return result
