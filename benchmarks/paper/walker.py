"""Training of a two-legged walker by evolution strategies with `fiber.Pool` and real Box2D.

    python -m benchmarks.paper.walker --minutes 15

It writes walker.json, and a picture with the learning curve and a strip of frames.
A linear policy on Gymnasium's BipedalWalker-v3, trained as in augmented random search (Mania, Guy
and Recht, 2018): mirrored perturbations, observations scaled by their running mean and deviation,
and the better half of the directions moves the policy. Each worker has the environment; only
parameters and returns travel. In training a step's reward is at most 1 and at least -1, so that the
100 points that a fall costs do not teach the walker to stand still. All returns that are reported
are the environment's own.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from benchmarks.paper import packages, walker_picture
from benchmarks.session import ROOT

Array = npt.NDArray[np.float64]

RESULTS = "walker.json"
PICTURE = "walker.png"
ENVIRONMENT = packages.WALKER
OBSERVED, ACTIONS = 24, 4
POPULATION = 48
"""Episodes of a generation: 24 mirrored pairs."""
SIGMA = 0.2
RATE = 0.1
HORIZON = 1600
TESTS = 8
TEST_EVERY = 10
FIRST_TEST_SEED = 2**31


class Scale(NamedTuple):
    """Sums over observations, from which their mean and deviation follow."""

    number: float
    total: Array
    squares: Array

    def merged(self, others: Sequence[Scale]) -> Scale:
        """Return the sums over the observations of all."""
        return Scale(*(sum(parts[1:], parts[0]) for parts in zip(self, *others, strict=True)))

    def mean_and_deviation(self) -> tuple[Array, Array]:
        """Return what observations are shifted and divided by."""
        mean = self.total / self.number
        return mean, np.sqrt(np.maximum(self.squares / self.number - mean**2, 1e-4))


NOTHING_SEEN = Scale(1.0, np.zeros(OBSERVED), np.ones(OBSERVED))


class Episode(NamedTuple):
    """Episode that was played: returns, steps and observations."""

    trained: float
    own: float
    steps: int
    scale: Scale


class Test(NamedTuple):
    """Environment's own returns of the policy after so many generations."""

    generation: int
    minutes: float
    returns: list[float]

    @property
    def mean(self) -> float:
        """Return the mean of the returns."""
        return float(np.mean(self.returns))


@dataclass
class Results:
    """Results of a run, and the best tested policy: torques are `weights @ observation - offset`,
    at least -1 and at most 1."""

    command: str
    workers: int
    load_before: float
    load_after: float = 0.0
    generations: int = 0
    steps: int = 0
    minutes: float = 0.0
    tests: list[Test] = field(default_factory=list)
    weights: list[list[float]] = field(default_factory=list)
    offset: list[float] = field(default_factory=list)


def load(folder: Path) -> Results:
    """Return the results of an earlier run."""
    data = json.loads((folder / RESULTS).read_text(encoding="utf-8"))
    data["tests"] = [Test(*each) for each in data["tests"]]
    return Results(**data)


_env: Any = None


def prepare(name: str = ENVIRONMENT) -> None:
    """Make the worker's environment: the pool's initializer."""
    global _env
    _env = packages.walker(name).unwrapped


def play(theta: Array, scale: Scale, horizon: int, job: tuple[Array | None, int]) -> Episode:
    """Play one episode of the policy `theta`, perturbed if the job has a perturbation."""
    perturbation, seed = job
    weights = theta if perturbation is None else theta + perturbation
    mean, deviation = scale.mean_and_deviation()
    weights = weights / deviation
    offset = weights @ mean
    seen = np.empty((horizon, OBSERVED))
    observation, _ = _env.reset(seed=seed)
    trained = own = 0.0
    steps = 0
    for steps in range(1, horizon + 1):
        seen[steps - 1] = observation
        action = np.clip(weights @ observation - offset, -1, 1)
        observation, reward, over, _, _ = _env.step(action)
        trained += min(max(reward, -1.0), 1.0)
        own += reward
        if over:
            break
    seen = seen[:steps]
    sums = Scale(float(steps), seen.sum(axis=0), (seen**2).sum(axis=0))
    return Episode(trained, own, steps, sums)


def improved(theta: Array, noise: Array, returns: Array) -> Array:
    """Return the parameters after a generation with these perturbations and mirrored returns.

    `returns` has a row of two for each perturbation: of `theta` plus and minus it.
    """
    best = np.argsort(-returns.max(axis=1))[: max(1, len(returns) // 2)]
    chosen = returns[best]
    gradient = np.tensordot(chosen[:, 0] - chosen[:, 1], noise[best], axes=1) / len(best)
    moved: Array = theta + RATE * gradient / (chosen.std() + 1e-8)
    return moved


def horizon_of(generation: int) -> int:
    """Return the steps that an episode of this generation may take: short at first."""
    return min(HORIZON, 400 + 4 * generation)


class Search:
    """State of the training: parameters, scale of the observations, random numbers."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.theta: Array = np.zeros((ACTIONS, OBSERVED))
        self.scale = NOTHING_SEEN

    def generation(self, pool: Any, horizon: int) -> int:
        """Play a population, move the parameters, and return the steps that were played."""
        noise = self.rng.standard_normal((POPULATION // 2, ACTIONS, OBSERVED))
        seeds = self.rng.integers(2**31, size=len(noise))
        jobs = [
            (sign * SIGMA * each, int(seed))
            for each, seed in zip(noise, seeds, strict=True)
            for sign in (1, -1)
        ]
        task = partial(play, self.theta, self.scale, horizon)
        episodes: list[Episode] = pool.map(task, jobs, 1)
        returns = np.array([episode.trained for episode in episodes]).reshape(-1, 2)
        self.theta = improved(self.theta, noise, returns)
        self.scale = self.scale.merged([episode.scale for episode in episodes])
        return sum(episode.steps for episode in episodes)

    def policy(self) -> tuple[list[list[float]], list[float]]:
        """Return weights and offset of the policy, for observations as they are."""
        mean, deviation = self.scale.mean_and_deviation()
        weights = self.theta / deviation
        return weights.tolist(), (weights @ mean).tolist()

    def test(self, pool: Any) -> list[float]:
        """Return the environment's own returns of the policy in episodes never trained on."""
        jobs = [(None, FIRST_TEST_SEED + number) for number in range(TESTS)]
        task = partial(play, self.theta, self.scale, HORIZON)
        return [episode.own for episode in pool.map(task, jobs, 1)]


def train(results: Results, minutes: float, workers: int, seed: int) -> None:
    """Train for so many minutes, and note in `results` what happened and the best policy."""
    import fiber

    search, begin = Search(seed), time.monotonic()
    best = -np.inf
    with fiber.Pool(workers, prepare) as pool:
        while True:
            if results.generations % TEST_EVERY == 0:
                returns = search.test(pool)
                results.minutes = (time.monotonic() - begin) / 60
                test = Test(results.generations, results.minutes, returns)
                results.tests.append(test)
                print(_in_words(test), flush=True)
                if test.mean > best:
                    best = test.mean
                    results.weights, results.offset = search.policy()
                if results.minutes >= minutes:
                    return
            results.steps += search.generation(pool, horizon_of(results.generations))
            results.generations += 1


def _in_words(test: Test) -> str:
    return (
        f"generation {test.generation:4}  {test.minutes:5.1f} minutes  return {test.mean:7.1f}  "
        f"({min(test.returns):.0f} to {max(test.returns):.0f})"
    )


def minutes_of(text: str) -> float:
    """Return the minutes of an option, which are finite.  With 0 the policy is only tested."""
    with contextlib.suppress(ValueError):
        if math.isfinite(minutes := float(text)) and minutes >= 0:
            return minutes
    raise argparse.ArgumentTypeError(f"{text} is not a number of minutes, 0 or more")


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, and write the results and the picture; 1 if Box2D is missing."""
    parser = argparse.ArgumentParser("benchmarks.paper.walker")
    parser.add_argument("--minutes", type=minutes_of, default=15.0)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "paper", metavar="FOLDER")
    options = parser.parse_args(arguments)
    if options.workers < 1:
        parser.error(f"--workers must be at least 1, not {options.workers}")
    try:
        packages.walker(ENVIRONMENT).close()
    except packages.Missing as error:
        print(error, file=sys.stderr)
        return 1
    words = ["--minutes", f"{options.minutes:g}", "--seed", str(options.seed)]
    command = shlex.join(["python", "-m", "benchmarks.paper.walker", *words])
    results = Results(command, options.workers, round(os.getloadavg()[0], 2))
    train(results, options.minutes, options.workers, options.seed)
    results.load_after = round(os.getloadavg()[0], 2)
    options.output.mkdir(parents=True, exist_ok=True)
    text = json.dumps(asdict(results), separators=(",", ":")) + "\n"
    (options.output / RESULTS).write_text(text, encoding="utf-8")
    walker_picture.draw(results, options.output / PICTURE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
