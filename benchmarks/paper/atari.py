"""Breakout as the experiment plays it, and an environment that only takes as long.

A frame is grey, without the frame of the screen, and every second pixel in each direction: 80x80.
"""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import numpy as np
from benchmarks.paper import packages, recording

SIDE = 80
ACTIONS = 4
SHAPE = (SIDE, SIDE, 1)
_FIELD = (slice(34, 194, 2), slice(0, 160, 2))


class _Frames(gymnasium.Env[Any, Any]):
    observation_space = gymnasium.spaces.Box(0, 255, SHAPE, np.uint8)
    action_space = gymnasium.spaces.Discrete(ACTIONS)


class Breakout(_Frames):
    """Atari's Breakout, four frames of the game a step."""

    def __init__(self) -> None:
        self._game = packages.breakout()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin a game."""
        super().reset(seed=seed)
        frame, _ = self._game.reset(seed=seed)
        return _reduced(frame), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Play four frames."""
        frame, reward, terminated, truncated, _ = self._game.step(int(action))
        return _reduced(frame), float(reward), terminated, truncated, {}


class Recorded(_Frames):
    """Environment whose steps take as long as recorded ones of Breakout, without a processor.

    It shows a dark picture with one bright row, which moves.
    """

    def __init__(self) -> None:
        self._seconds = recording.read(recording.BREAKOUT).seconds
        self._number = 0
        self._frame = np.zeros(SHAPE, np.uint8)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin somewhere in the recording."""
        super().reset(seed=seed)
        self._number = int(self.np_random.integers(len(self._seconds)))
        return self._frame, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take as long as the next recorded step."""
        self._frame[self._number % SIDE] = 0
        self._number = (self._number + 1) % len(self._seconds)
        self._frame[self._number % SIDE] = 255
        time.sleep(self._seconds[self._number])
        return self._frame, float(self._number % 50 == 0), False, False, {}


def _reduced(frame: Any) -> Any:
    return np.ascontiguousarray(frame[_FIELD])[..., None]
