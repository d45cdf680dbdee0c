"""Policy network that plays, and one episode of it.

To evolution strategies a policy is a flat vector of floats. This module gives such a vector its
meaning in a Gymnasium environment.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

Vector = npt.NDArray[np.float32]
Act = Callable[[Any], Any]

HIDDEN = 16  # units of the one hidden layer: plenty for classic control


def make_env(name: str) -> gym.Env[Any, Any]:
    """Make the environment, without Gymnasium's checker, which takes longer than a step."""
    return gym.make(name, disable_env_checker=True)


class Policy:
    """Meaning of a vector of `size` parameters in `env`.

    Raises ValueError for an environment that does not observe a flat vector, or whose actions are
    neither a choice (Discrete) nor a bounded vector (Box).
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        seen = env.observation_space
        if not isinstance(seen, gym.spaces.Box) or len(seen.shape) != 1:
            raise ValueError(
                f"its observations are {seen}, and this example needs flat vectors, "
                "as of Acrobot-v1, CartPole-v1 or Pendulum-v1"
            )
        # Observations are divided by their bounds, which every worker knows from the start. A
        # running mean would have to travel, and would depend on which worker played what.
        bound = np.maximum(np.abs(seen.low), np.abs(seen.high))
        self._scale = np.where((bound > 0) & (bound < 1e3), bound, 1).astype(np.float32)
        self._to_action, outputs = _decoder(env.action_space)
        inputs = seen.shape[0]
        self._shapes = [(HIDDEN, inputs), (HIDDEN,), (outputs, HIDDEN), (outputs,)]
        self._ends = np.cumsum([np.prod(shape) for shape in self._shapes])
        self.size = int(self._ends[-1])

    def initial(self, rng: np.random.Generator) -> Vector:
        """Return where training starts: a random hidden layer, and outputs close to zero."""
        theta = rng.standard_normal(self.size, dtype=np.float32)
        hidden, hidden_bias, output, output_bias = self._split(theta)
        hidden /= np.sqrt(np.float32(hidden.shape[1]))
        output *= np.float32(0.1)
        hidden_bias[:] = output_bias[:] = 0
        return theta

    def act(self, theta: Vector) -> Act:
        """Return the policy with the parameters `theta`: a function from observation to action."""
        hidden, hidden_bias, output, output_bias = self._split(theta)
        hidden = hidden / self._scale
        to_action = self._to_action

        def act(observation: Vector) -> Any:
            return to_action(output @ np.tanh(hidden @ observation + hidden_bias) + output_bias)

        return act

    def _split(self, theta: Vector) -> list[Vector]:
        """Return the layers, as views into `theta`."""
        parts = np.split(theta, self._ends[:-1])
        return [part.reshape(shape) for part, shape in zip(parts, self._shapes, strict=True)]


def _decoder(actions: gym.Space[Any]) -> tuple[Callable[[Vector], Any], int]:
    """Return how outputs become an action, and the number of outputs that this takes."""
    if isinstance(actions, gym.spaces.Discrete):
        first = actions.start
        return (lambda outputs: first + outputs.argmax()), int(actions.n)
    if isinstance(actions, gym.spaces.Box) and len(actions.shape) == 1 and actions.is_bounded():
        middle, reach = (actions.high + actions.low) / 2, (actions.high - actions.low) / 2
        return (lambda outputs: middle + reach * np.tanh(outputs)), actions.shape[0]
    raise ValueError(f"its actions are {actions}, and this example knows Discrete and bounded Box")


def play(env: gym.Env[Any, Any], act: Act, seed: int) -> float:
    """Return the return of one episode; `seed` decides how it starts."""
    observation, _ = env.reset(seed=seed)
    total, over = 0.0, False
    while not over:
        observation, reward, terminated, truncated, _ = env.step(act(observation))
        total += float(reward)
        over = terminated or truncated
    return total


def play_randomly(env: gym.Env[Any, Any], seed: int) -> float:
    """Return the return of one episode of random actions, to compare training with."""
    env.action_space.seed(seed)
    return play(env, lambda _: env.action_space.sample(), seed)
