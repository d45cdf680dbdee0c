"""Functions of poet.py's workers."""

from __future__ import annotations

import functools
import random
from typing import Any

POPULATION = 8

thetas: Any = None
niches: Any = None
cache: dict[int, list[float]] = {}
cached_iteration = -1


def initialize_worker(shared_thetas: Any, shared_niches: Any) -> None:
    global thetas, niches
    thetas, niches = shared_thetas, shared_niches


def theta_of(iteration: int, niche: int) -> list[float]:
    """Fetch the value once for each iteration; keep the last one."""
    global cached_iteration
    if iteration != cached_iteration:
        cached_iteration = iteration
        cache.clear()
    if niche not in cache:
        cache[niche] = thetas[niche]
    return cache[niche]


@functools.lru_cache(maxsize=100)
def niche_of(iteration: int, niche: int) -> dict[str, float]:
    made: dict[str, float] = niches[niche]
    return made


def evaluate_batch(iteration: int, niche: int, seed: int) -> list[tuple[int, float]]:
    """Seeds of the noise, and how good it was."""
    theta, target = theta_of(iteration, niche), niche_of(iteration, niche)["target"]
    evaluated = []
    for offset in range(POPULATION):
        noise = noise_of(seed + offset, len(theta))
        tried = [value + part for value, part in zip(theta, noise, strict=True)]
        evaluated.append((seed + offset, -sum((value - target) ** 2 for value in tried)))
    return evaluated


def noise_of(seed: int, size: int) -> list[float]:
    generator = random.Random(seed)
    return [generator.gauss(0, 0.3) for _ in range(size)]
