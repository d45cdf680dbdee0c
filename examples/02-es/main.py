"""Evolution strategies on a Gymnasium task, with fiber.Pool.

The paper's second listing as a program: sample noise, evaluate the perturbed policies in the pool,
move the policy. Prints the returns as they rise and draws the learning curve.
"""

from __future__ import annotations

import argparse
import secrets
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from evolution import Evolution
from noise import NoiseTable
from plot import Generation, Outcome, write_curve
from policy import Policy, make_env
from progress import Progress
from rollout import baseline, evaluate, prepare, test

import fiber

NOISE_LENGTH = 1 << 24  # floats in the table: 64 MiB
TEST_SEEDS = range(2**31, 2**31 + 16)  # no training episode has these
FINAL_SEEDS = range(2**31 + 16, 2**31 + 116)


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, compare and draw; returns the exit status."""
    options = parse(arguments)
    rng = np.random.default_rng(options.seed)
    policy = Policy(make_env(options.env))
    table = NoiseTable(secrets.token_hex(8), options.seed, NOISE_LENGTH)
    history: list[Generation] = []
    outcome = None
    started = time.monotonic()
    try:
        search = Evolution(policy.initial(rng), table.open(), rng)
        print(
            f"{options.env}: {policy.size} parameters, {options.population} episodes a generation,"
            f" {options.workers} workers"
        )
        with fiber.Pool(options.workers, prepare, (options.env, table)) as pool:
            train(pool, search, options, history)
            print(f"trained in {time.monotonic() - started:.1f} s")
            outcome = compare(pool, search)
    except KeyboardInterrupt:
        print(f"interrupted after {len(history)} of {options.generations} generations")
    finally:
        table.remove()
    if history:
        write_curve(options.out, f"Evolution strategies on {options.env}", history, outcome)
        print(f"learning curve: {options.out}")
    return 0 if outcome else 130


def train(
    pool: Any, search: Evolution, options: argparse.Namespace, history: list[Generation]
) -> None:
    """Run the generations, adding each to `history` as it ends."""
    episodes = options.generations * (options.population + len(TEST_SEEDS))
    with Progress(episodes, "episodes") as progress:
        for number in range(1, options.generations + 1):
            tests = pool.map(partial(test, search.theta), TEST_SEEDS)
            progress.advance(len(tests))
            task = partial(evaluate, search.theta, search.sigma)
            returns: dict[int, tuple[float, float]] = {}
            for noise_index, pair in pool.imap_unordered(
                task, search.candidates(options.population // 2)
            ):
                returns[noise_index] = pair
                progress.advance(2)
            search.update(returns)
            history.append(Generation(tests, np.ravel([*returns.values()]).tolist()))
            progress.say(describe(number, history[-1]))


def describe(number: int, generation: Generation) -> str:
    """A generation in one line."""
    return (
        f"generation {number:3}   policy {np.mean(generation.tests):8.1f}   "
        f"population {np.mean(generation.population):8.1f}, best {max(generation.population):8.1f}"
    )


def compare(pool: Any, search: Evolution) -> Outcome:
    """Play new episodes, at random and by the policy as it is now, and print both."""
    outcome = Outcome(
        pool.map(baseline, FINAL_SEEDS), pool.map(partial(test, search.theta), FINAL_SEEDS)
    )
    print(f"return over {len(FINAL_SEEDS)} new episodes, mean and standard deviation:")
    for name, returns in zip(("random", "trained"), outcome, strict=True):
        print(f"  {name:8} {np.mean(returns):8.1f} ± {np.std(returns):.1f}")
    return outcome


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the options; report wrong ones before anything starts."""
    parser = argparse.ArgumentParser(description="Evolution strategies with fiber.Pool.")
    parser.add_argument("--workers", type=int, default=fiber.cpu_count())
    parser.add_argument("--generations", type=int, default=30)
    parser.add_argument("--population", type=int, default=128, help="even: they come in pairs")
    parser.add_argument("--env", default="Acrobot-v1", help="flat observations")
    parser.add_argument("--seed", type=int, default=4)
    parser.add_argument("--out", type=Path, default=Path("learning-curve.png"))
    options = parser.parse_args(arguments)
    if options.workers < 1 or options.generations < 1:
        parser.error("--workers and --generations must be at least 1")
    if options.population < 2 or options.population % 2:
        parser.error(f"--population must be even, 2 or more, not {options.population}")
    if options.seed < 0:
        parser.error(f"--seed must not be negative, as {options.seed} is")
    if not options.out.parent.is_dir():
        parser.error(f"--out {options.out}: there is no folder {options.out.parent}")
    try:
        Policy(make_env(options.env))
    except (gym.error.Error, ValueError) as error:
        parser.error(f"--env {options.env}: {error}")
    return options


if __name__ == "__main__":
    sys.exit(main())
