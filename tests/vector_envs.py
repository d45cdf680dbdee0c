"""Environments that tests step in workers: of any space, and such as fail."""

from __future__ import annotations

import os
import signal
import threading
import time
from copy import deepcopy
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

Step = tuple[Any, float, bool, bool, dict[str, Any]]


class Sampling(gymnasium.Env[Any, Any]):
    """Observations are samples of a space, in episodes of a few steps, with infos of any kind."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  # as Gymnasium has it

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any] | None = None,
        length: int = 4,
    ) -> None:
        self.observation_space = deepcopy(observation_space)  # and with it its generator
        self.action_space = spaces.Discrete(3) if action_space is None else action_space
        self.render_mode = "rgb_array"
        self.length = length
        self.steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {"begun": True, "options": str(options)}

    def step(self, action: Any) -> Step:
        if action not in self.action_space:
            raise ValueError(f"{action!r} is no action")
        self.steps += 1
        reward = float(self.np_random.normal())
        # Some steps have an info, and it is not the same in each.
        info: dict[str, Any] = {} if self.steps % 2 else {"steps": self.steps, "name": str(reward)}
        over = self.steps >= self.length
        return self.observation_space.sample(), reward, over and reward > 0, over, info

    def render(self) -> Any:
        return np.full((2, 2, 3), self.steps, np.uint8)


class Faulty(gymnasium.Env[Any, Any]):
    """Observes how many steps it has made; some actions end badly."""

    observation_space = spaces.Box(0, np.inf, (1,), np.float64)
    action_space = spaces.Discrete(9)

    GOOD, RAISE, EXIT, SEGFAULT, HANG, HANG_NATIVE, WAIT, UNPICKLABLE, SLOW = range(9)

    def __init__(self, gate: Path | None = None, *, last: Path | None = None) -> None:
        """``gate``: what ``WAIT`` waits for to exist; once ``last`` does, none can be made."""
        if last is not None and last.exists():
            os._exit(3)
        self._gate = gate
        self.steps = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if options and options.get("raise"):
            raise RuntimeError("no reset")
        self.steps = 0.0
        return np.array([self.steps]), {}

    def step(self, action: Any) -> Step:
        info: dict[str, Any] = {}
        match int(action):
            case self.RAISE:
                raise ArithmeticError("a bad action")
            case self.EXIT:
                os._exit(7)
            case self.SEGFAULT:
                os.kill(os.getpid(), signal.SIGSEGV)
            case self.HANG:
                time.sleep(1000)
            case self.HANG_NATIVE:
                os.kill(os.getpid(), signal.SIGSTOP)
            case self.WAIT:
                assert self._gate is not None
                while not self._gate.exists():
                    time.sleep(0.001)
            case self.SLOW:
                time.sleep(0.01)
            case self.UNPICKLABLE:
                info["it"] = threading.Lock()
        self.steps += 1
        return np.array([self.steps]), 1.0, False, False, info

    def pid(self) -> int:
        return os.getpid()

    def getenv(self, name: str) -> str | None:
        return os.environ.get(name)

    def exit(self, row: float) -> None:
        if self.steps == row:
            os._exit(4)


class Telling(Faulty):
    """Observes the same as text; what cannot be pickled is in the observation."""

    observation_space: Any = spaces.Text(10)

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        super().reset(**options)
        return "none", {}

    def step(self, action: Any) -> Step:
        _, *rest, info = super().step(action)
        observation = threading.Lock() if info else f"{self.steps:.0f}"
        return (observation, *rest, {})  # type: ignore[return-value]


class Noticing(Sampling):
    """Counts how often any of its kind was looked at, in the process."""

    looked = 0

    def __init__(self) -> None:
        super().__init__(spaces.Discrete(2))

    @property
    def unwrapped(self) -> Any:
        Noticing.looked += 1
        return self

    @property
    def looks(self) -> int:
        return Noticing.looked
