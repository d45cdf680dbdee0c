"""Record how long real episodes and steps take: `python -m benchmarks.paper.record`.

The walker's episodes are those of a first generation, of random small policies on
BipedalWalkerHardcore-v3. Breakout's steps are random actions.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from benchmarks import machine
from benchmarks.paper import atari, packages, recording

EPISODES = 256
STEPS = 4096
HIDDEN = 40
_OBSERVED, _ACTIONS = 24, 4


def main(arguments: Sequence[str] | None = None) -> int:
    """Write both recordings; 1 if a package is missing."""
    parser = argparse.ArgumentParser("benchmarks.paper.record", description=__doc__)
    parser.add_argument("--episodes", type=int, default=EPISODES)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--output", type=Path, default=recording.FOLDER, metavar="FOLDER")
    parser.add_argument("--only", choices=(recording.WALKER, recording.BREAKOUT))
    options = parser.parse_args(arguments)
    if options.episodes < 1 or options.steps < 1:
        parser.error("--episodes and --steps must be at least 1")
    try:
        if options.only != recording.BREAKOUT:
            print(recording.write(recording.WALKER, _episodes(options.episodes), options.output))
        if options.only != recording.WALKER:
            print(recording.write(recording.BREAKOUT, _steps(options.steps), options.output))
    except packages.Missing as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def _episodes(count: int) -> recording.Recording:
    env = packages.walker(packages.HARDCORE)
    rng = np.random.default_rng(1)
    seconds, steps = zip(*(_episode(env, rng, seed) for seed in range(count)), strict=True)
    how = f"a random policy of {HIDDEN} hidden units for each episode"
    return _made(packages.HARDCORE, how, f"--episodes {count}", seconds, list(steps))


def _episode(env: object, rng: np.random.Generator, seed: int) -> tuple[float, int]:
    hidden = rng.standard_normal((HIDDEN, _OBSERVED)) / np.sqrt(_OBSERVED)
    output = rng.standard_normal((_ACTIONS, HIDDEN)) / np.sqrt(HIDDEN)
    begin, steps, over = time.thread_time(), 0, False
    observation, _ = env.reset(seed=seed)  # type: ignore[attr-defined]
    while not over:
        action = np.tanh(output @ np.tanh(hidden @ observation))
        observation, _, terminated, truncated, _ = env.step(action)  # type: ignore[attr-defined]
        over = terminated or truncated
        steps += 1
    return time.thread_time() - begin, steps


def _steps(count: int) -> recording.Recording:
    env = atari.Breakout()
    rng = np.random.default_rng(1)
    env.reset(seed=1)
    seconds = []
    for action in rng.integers(env.action_space.n, size=count):
        begin = time.thread_time()
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
        seconds.append(time.thread_time() - begin)
    how = "random actions, four frames a step; a step that ends a game includes the reset"
    return _made(packages.BREAKOUT, how, f"--steps {count}", seconds, [])


def _made(
    environment: str, how: str, options: str, seconds: Sequence[float], steps: list[int]
) -> recording.Recording:
    return recording.Recording(
        environment,
        how,
        f"python -m benchmarks.paper.record {options}",
        machine.processor(),
        [max(1, round(each * 1e6)) for each in seconds],
        steps,
    )


if __name__ == "__main__":
    sys.exit(main())
