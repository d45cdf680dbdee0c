"""Program that uses a manager and a pool as POET does.

The initializer's arguments have managed dicts. Each worker caches their values by iteration.

    poet.py multiprocessing|fiber
"""

from __future__ import annotations

import importlib
import sys
from typing import Any

from poet_worker import evaluate_batch, initialize_worker, noise_of

NICHES, ITERATIONS, BATCHES = 3, 4, 4


def main() -> None:
    mp = importlib.import_module(sys.argv[1])
    with mp.Manager() as manager:
        shared_thetas, shared_niches = manager.dict(), manager.dict()
        for niche in range(NICHES):
            shared_thetas[niche] = [0.0, 0.0]
            shared_niches[niche] = {"target": float(niche)}
        arguments = shared_thetas, shared_niches
        with mp.Pool(2, initializer=initialize_worker, initargs=arguments) as pool:
            for iteration in range(ITERATIONS):
                evolve(pool, iteration, shared_thetas)
                shared_niches[0] = {"target": iteration + 1.0}
        for niche, theta in sorted(shared_thetas.items()):
            print(niche, *(f"{value:.6f}" for value in theta))


def evolve(pool: Any, iteration: int, shared_thetas: Any) -> None:
    """Move each niche's theta to the best that its batches found."""
    batches = {
        niche: [
            pool.apply_async(evaluate_batch, (iteration, niche, 1000 * iteration + 100 * batch))
            for batch in range(BATCHES)
        ]
        for niche in range(NICHES)
    }
    for niche, results in batches.items():
        evaluated = [one for result in results for one in result.get(60)]
        seed, _ = max(evaluated, key=lambda one: one[1])
        theta = shared_thetas[niche]
        noise = noise_of(seed, len(theta))
        shared_thetas[niche] = [value + part for value, part in zip(theta, noise, strict=True)]


if __name__ == "__main__":
    main()
