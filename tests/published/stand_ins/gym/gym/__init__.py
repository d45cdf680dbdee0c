"""The parts of gym 0.15 that the published programs use, over gymnasium's environments.

An environment's `step` returns four values, `reset` returns the observation, and `seed` seeds.
Programs of that time also use names that numpy 2 has removed.
"""

import sys

import gymnasium
import numpy as np

from gym import spaces as spaces
from gym import utilities as utils

np.product = np.prod
sys.modules["gym.utils"] = utils
sys.modules["gym.utils.seeding"] = utils.seeding


class Env:
    """Environment with the interface of that time."""

    metadata = None
    spec = None
    observation_space = None
    action_space = None
    reward_range = (-float("inf"), float("inf"))

    def seed(self, seed=None):
        """Accept a seed."""
        return [seed]

    def close(self):
        """Release nothing."""

    @property
    def unwrapped(self):
        """The environment below all wrappers."""
        return self


class Wrapper(Env):
    """Environment that changes what another one returns."""

    def __init__(self, env):
        self.env = env
        self.observation_space = env.observation_space
        self.action_space = env.action_space
        self.spec = env.spec

    def __getattr__(self, name):
        if name == "env" or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.env, name)

    def reset(self, **options):
        """Reset the environment below."""
        return self.env.reset(**options)

    def step(self, action):
        """Step the environment below."""
        return self.env.step(action)

    def seed(self, seed=None):
        """Seed the environment below."""
        return self.env.seed(seed)

    def close(self):
        """Close the environment below."""
        self.env.close()

    @property
    def unwrapped(self):
        """The environment below all wrappers."""
        return self.env.unwrapped


class ObservationWrapper(Wrapper):
    """Wrapper with a method that changes observations."""

    def reset(self, **options):
        """Return the changed first observation."""
        return self.observation(self.env.reset(**options))

    def step(self, action):
        """Return the changed observation with the other values."""
        observation, *others = self.env.step(action)
        return self.observation(observation), *others


class RewardWrapper(Wrapper):
    """Wrapper with a method that changes rewards."""

    def step(self, action):
        """Return the changed reward with the other values."""
        observation, reward, *others = self.env.step(action)
        return observation, self.reward(reward), *others


class _Made(Env):
    """Environment of gymnasium, with the interface of that time and its limit of steps."""

    def __init__(self, name):
        if name.endswith("-v4"):
            import ale_py

            gymnasium.register_envs(ale_py)
        # Deterministic environments skip three frames of four, and repeat no action by chance.
        options = {"frameskip": 4} if "Deterministic" in name else {}
        known = name.replace("Deterministic", "NoFrameskip")
        self._env = gymnasium.make(known, disable_env_checker=True, **options).unwrapped
        self._limit = self._env.spec.max_episode_steps
        self._elapsed_steps = 0
        self._seed = None
        self.np_random = np.random.RandomState(0)
        self.spec = self._env.spec
        self.observation_space = self._env.observation_space
        self.action_space = self._env.action_space

    def __getattr__(self, name):
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._env, name)

    def seed(self, seed=None):
        """Seed the generator, and the environment at its next reset."""
        self._seed = seed
        self.np_random = np.random.RandomState(seed)
        return [seed]

    def reset(self):
        """Return the first observation."""
        self._elapsed_steps = 0
        seed, self._seed = self._seed, None
        return self._env.reset(seed=seed)[0]

    def step(self, action):
        """Return observation, reward, end and information."""
        self._elapsed_steps += 1
        observation, reward, terminated, truncated, info = self._env.step(action)
        late = self._limit is not None and self._elapsed_steps >= self._limit
        return observation, reward, terminated or truncated or late, info

    def close(self):
        """Close gymnasium's environment."""
        self._env.close()


def make(name):
    """Make an environment by its registered name."""
    return _Made(name)
