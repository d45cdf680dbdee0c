"""Small neural network, its gradient, and Adam: NumPy alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class Network:
    """Layers of so many numbers, tanh between them, and Adam to train them."""

    def __init__(
        self, sizes: Sequence[int], rng: np.random.Generator, last_scale: float = 1.0
    ) -> None:
        scales = [1.0] * (len(sizes) - 2) + [last_scale]
        self._parameters: list[Array] = []
        for inputs, outputs, scale in zip(sizes, sizes[1:], scales, strict=False):
            weights = rng.normal(size=(inputs, outputs))
            self._parameters += [scale * weights / np.sqrt(inputs), np.zeros(outputs)]
        self._first_moments = [np.zeros_like(each) for each in self._parameters]
        self._second_moments = [np.zeros_like(each) for each in self._parameters]
        self._steps = 0
        self._inputs: list[Array] = []

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(each.size for each in self._parameters)

    def __call__(self, batch: Array) -> Array:
        """Return the outputs for a batch of inputs, which `train` remembers."""
        self._inputs = []
        for layer in range(0, len(self._parameters), 2):
            if layer:
                batch = np.tanh(batch)
            self._inputs.append(batch)
            batch = batch @ self._parameters[layer] + self._parameters[layer + 1]
        return batch

    def train(self, gradient: Array, rate: float, largest: float = 0.5) -> None:
        """Take a step down the gradient of a loss by the outputs of the last call."""
        gradients: list[Array] = []
        for index in reversed(range(len(self._inputs))):
            inputs = self._inputs[index]
            gradients[:0] = [inputs.T @ gradient, gradient.sum(axis=0)]
            # Only for inputs of later layers, which came out of a tanh.
            gradient = gradient @ self._parameters[2 * index].T * (1 - inputs**2)
        length = np.sqrt(sum(float((each**2).sum()) for each in gradients))
        scale = min(1.0, largest / (length + 1e-8))
        self._adam([scale * each for each in gradients], rate)

    def _adam(self, gradients: Sequence[Array], rate: float) -> None:
        self._steps += 1
        for index, gradient in enumerate(gradients):
            first, second = self._first_moments[index], self._second_moments[index]
            first[:] = 0.9 * first + 0.1 * gradient
            second[:] = 0.999 * second + 0.001 * gradient**2
            unbiased = first / (1 - 0.9**self._steps)
            spread = np.sqrt(second / (1 - 0.999**self._steps))
            self._parameters[index] -= rate * unbiased / (spread + 1e-8)
