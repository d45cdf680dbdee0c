"""Evolution strategies (Salimans et al. 2017), without processes or environments.

Each generation asks for the returns of pairs of mirrored perturbations, theta + sigma * noise and
theta - sigma * noise, and moves theta to where the returns are higher.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Vector = npt.NDArray[np.float32]


class Candidate(NamedTuple):
    """Mirrored pair to evaluate: where its noise starts in the table, and the episode's seed.

    Both halves play the same episode, so that only the noise makes a difference.
    """

    noise_index: int
    episode_seed: int


class Evolution:
    """Search distribution and its movement: ask for `candidates`, then `update`."""

    def __init__(
        self,
        theta: Vector,
        noise: Vector,
        rng: np.random.Generator,
        *,
        sigma: float = 0.2,
        learning_rate: float = 0.07,
    ) -> None:
        self.theta = theta
        self.sigma = sigma
        self._noise = noise
        self._rng = rng
        self._adam = Adam(theta.size, learning_rate)

    def candidates(self, pairs: int) -> list[Candidate]:
        """Return the pairs of the next generation, each with other noise."""
        starts = self._noise.size - self.theta.size + 1
        indices = self._rng.choice(starts, pairs, replace=False)
        seeds = self._rng.integers(2**31, size=pairs)
        return [Candidate(int(i), int(s)) for i, s in zip(indices, seeds, strict=True)]

    def update(self, returns: Mapping[int, tuple[float, float]]) -> None:
        """Move theta, given the returns (plus, minus) of each noise index.

        The order in which the returns arrive makes no difference, not even in the last bit.
        """
        indices = sorted(returns)
        shaped = centred_ranks(np.array([returns[index] for index in indices]))
        gradient = np.zeros_like(self.theta)
        for index, (plus, minus) in zip(indices, shaped, strict=True):
            gradient += (plus - minus) * self._noise[index : index + gradient.size]
        self.theta = self.theta + self._adam.step(gradient / (shaped.size * self.sigma))


def centred_ranks(returns: npt.NDArray[np.float64]) -> Vector:
    """Replace returns by their ranks, from -0.5 for the worst to 0.5 for the best.

    Ranks make the update independent of the scale of the returns and of outliers. Equal returns get
    equal ranks, because two episodes that ran out of time cannot be compared.
    """
    _, position, counts = np.unique(returns, return_inverse=True, return_counts=True)
    ranks = np.cumsum(counts) - (counts + 1) / 2
    centred = ranks[position.reshape(returns.shape)] / (returns.size - 1) - 0.5
    return centred.astype(np.float32)


class Adam:
    """Adam (Kingma and Ba 2015), upwards, with a short memory because training is short."""

    def __init__(self, size: int, learning_rate: float) -> None:
        self._rate = learning_rate
        self._decay_mean, self._decay_square = 0.9, 0.99
        self._mean = np.zeros(size, dtype=np.float32)
        self._square = np.zeros(size, dtype=np.float32)
        self._steps = 0

    def step(self, gradient: Vector) -> Vector:
        """Return the step to add to the parameters."""
        self._steps += 1
        self._mean += (1 - self._decay_mean) * (gradient - self._mean)
        self._square += (1 - self._decay_square) * (gradient**2 - self._square)
        mean = self._mean / (1 - self._decay_mean**self._steps)
        square = self._square / (1 - self._decay_square**self._steps)
        root: Vector = np.sqrt(square)
        step: Vector = self._rate * mean / (root + np.float32(1e-8))
        return step
