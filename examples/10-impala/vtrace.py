"""Policy and value function in one small network, and V-trace: NumPy alone."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
HIDDEN, DISCOUNT, RATE, ENTROPY, CRITIC, SCALE = 64, 0.99, 1e-3, 0.01, 0.5, 0.05


class Unroll(NamedTuple):
    """Steps of an actor in a row, and what it observed after the last of them."""

    actor: int
    version: int  # of the weights that it acted with
    returns: list[float]  # of the episodes that ended
    observations: Array  # one more than steps
    actions: Any
    likelihoods: Array  # of the actions, by the actor's policy
    rewards: Array
    over: Any  # where episodes ended


def new_weights(inputs: int, actions: int, seed: int) -> list[Array]:
    """Return random weights."""
    rng = np.random.default_rng(seed)
    return [rng.normal(size=(inputs + 1, HIDDEN)) * 0.5, np.zeros((HIDDEN + 1, actions + 1))]


def forward(weights: list[Array], observations: Array) -> tuple[Array, Array, Array]:
    """Return the hidden layer, the probability of each action, and the values."""
    ones = np.ones((*observations.shape[:-1], 1))
    hidden = np.tanh(np.concatenate([observations, ones], -1) @ weights[0])
    outputs = np.concatenate([hidden, ones], -1) @ weights[1]
    scores = np.exp(outputs[..., :-1] - outputs[..., :-1].max(-1, keepdims=True))
    return hidden, scores / scores.sum(-1, keepdims=True), outputs[..., -1]


def v_trace(values: Array, ratios: Array, rewards: Array, over: Any) -> tuple[Array, Array]:
    """Return targets for the values, and advantages, of steps that an older policy took.

    Ratios are the likelihoods of the actions now to those then (Espeholt et al. 2018, section 4).
    """
    clipped, discounts = np.minimum(ratios, 1), DISCOUNT * ~over
    errors = clipped * (rewards + discounts * values[1:] - values[:-1])
    targets, ahead = values.copy(), np.zeros(values.shape[1])
    for step in reversed(range(len(rewards))):
        ahead = errors[step] + discounts[step] * clipped[step] * ahead
        targets[step] += ahead
    return targets, clipped * (rewards + discounts * targets[1:] - values[:-1])


class Learner:
    """Weights, and Adam to train them."""

    def __init__(self, weights: list[Array]) -> None:
        self.weights, self.version = weights, 0
        self._moments = [np.zeros((2, *each.shape)) for each in weights]

    def learn(self, unrolls: list[Unroll]) -> None:
        """Improve the weights. Rewards are scaled: large values would drown the policy."""
        seen, actions, before, rewards, over = (
            np.stack([unroll[field] for unroll in unrolls], axis=1) for field in range(3, 8)
        )
        hidden, chances, values = forward(self.weights, seen)
        taken = np.eye(chances.shape[-1])[actions]
        now = (chances[:-1] * taken).sum(-1)
        targets, advantages = v_trace(values, now / before, SCALE * rewards, over)
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        surprise = np.log(chances[:-1] + 1e-8)
        surprise -= (chances[:-1] * surprise).sum(-1, keepdims=True)
        outputs = np.zeros((*actions.shape, chances.shape[-1] + 1))
        outputs[..., :-1] = (chances[:-1] - taken) * advantages[..., None]
        outputs[..., :-1] += ENTROPY * chances[:-1] * surprise
        outputs[..., -1] = CRITIC * (values - targets)[:-1]
        self.version += 1
        layer = outputs @ self.weights[1][:-1].T * (1 - hidden[:-1] ** 2)
        ones = np.ones((*actions.shape, 1))
        for at, (below, slopes) in enumerate(((seen, layer), (hidden, outputs))):
            inputs = np.concatenate([below[:-1], ones], -1)
            gradient = np.einsum("tni,tno->io", inputs, slopes) / actions.size
            mean, square = self._moments[at]
            mean += 0.1 * (gradient - mean)
            square += 0.001 * (gradient**2 - square)
            unbiased = mean / (1 - 0.9**self.version)
            spread = np.sqrt(square / (1 - 0.999**self.version))
            self.weights[at] = self.weights[at] - RATE * unbiased / (spread + 1e-8)
