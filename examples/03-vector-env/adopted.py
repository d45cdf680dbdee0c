"""Gymnasium's own AsyncVectorEnv on Fiber's processes: adopted by one line, not edited."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import numpy.typing as npt
from environments import makers, parse, rate
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv, VectorEnv

import fiber


def main() -> None:
    """Step the same environments in this process and in their own, and print both rates."""
    options = parse(str(__doc__))
    fiber.adopt("gymnasium.vector.async_vector_env")
    print(f"{options.envs} x {options.env}, environment steps a second:")
    print(f"{'a step takes':>14}{'SyncVectorEnv':>16}{'AsyncVectorEnv':>16}{'ratio':>8}")
    for milliseconds in dict.fromkeys([0.0, options.ms]):
        makes = makers(options, milliseconds)
        alone, expected = run(SyncVectorEnv(makes), options)
        spread, seen = run(AsyncVectorEnv(makes), options)
        if not np.array_equal(expected, seen):
            raise SystemExit("the two saw different observations")
        took = f"{milliseconds:g} ms" if milliseconds else "what it takes"
        print(f"{took:>14}{alone:>16,.0f}{spread:>16,.0f}{spread / alone:>7.2f}x")
    print("observations: the same")


def run(
    envs: VectorEnv[Any, Any, Any], options: argparse.Namespace
) -> tuple[float, npt.NDArray[Any]]:
    """Return steps a second with random actions, and the observations that they led to."""
    envs.action_space.seed(0)
    envs.reset(seed=0)
    try:
        speed = rate(lambda: envs.step(envs.action_space.sample()), options)
        return speed, envs.step(envs.action_space.sample())[0]
    finally:
        envs.close()


if __name__ == "__main__":
    main()
