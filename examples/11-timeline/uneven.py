"""Simulations of uneven length, in chunks: the summary says where the time of the workers goes."""

from __future__ import annotations

import argparse
import random
import time

import fiber

SIMULATIONS = 48


def simulate(size: int) -> float:
    """Stand for a simulation, which takes longer the larger it is."""
    chance = random.Random(size)
    time.sleep(size * chance.uniform(0.005, 0.02))
    return chance.random()


def evaluate(score: float) -> float:
    """Stand for a short test of a result."""
    time.sleep(0.03)
    return score


def main() -> None:
    """Simulate, evaluate, and print the best score and the summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--chunksize", type=int, help="simulations in a chunk; default: Fiber's")
    parser.add_argument("--workers", type=int, default=4)
    arguments = parser.parse_args()
    with fiber.Pool(arguments.workers) as pool:
        scores = pool.map(simulate, range(SIMULATIONS), arguments.chunksize)
        print(f"best score: {max(pool.map(evaluate, scores)):.3f}")
    print(fiber.summary())


if __name__ == "__main__":
    main()
