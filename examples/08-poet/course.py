"""Obstacle courses, and policies that learn to cross them: the part of the workers."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
LENGTH, STEPS = 120, 240  # columns of a course, and the steps that a runner has for them
SIGHT = 10  # columns that a runner sees
PARAMETERS = 2 * (SIGHT + 4)  # of a policy: for each of two actions a weight of each sense
HARDEST = (9.0, 3.0, 0.8)
NOISES, UPDATES, SIGMA, RATE = 12, 3, 0.1, 0.15  # of evolution strategies

pairs: Any = None  # the manager's dict of all pairs, in a worker


class Course(NamedTuple):
    """Course with gaps, walls and rough ground, of at most these sizes."""

    gap: float
    wall: float
    roughness: float
    seed: int

    def ground(self) -> Array:
        """Return the height of each column: with an obstacle every 12 columns."""
        rng = np.random.default_rng(self.seed)
        ground = rng.uniform(0, self.roughness, LENGTH + SIGHT + 2)
        for place in range(12, LENGTH, 12):
            size = rng.uniform(0.6, 1)
            if rng.random() < 0.5:
                ground[place : place + round(size * self.gap)] = -9
            else:
                ground[place : place + 2] += size * self.wall
        return ground

    def child(self, rng: np.random.Generator) -> Course:
        """Return a course that is most often a little harder, with other ground."""
        changed = np.array(self[:3]) + rng.uniform(-0.4, 1, 3) * (2, 0.5, 0.1)
        gap, wall, roughness = changed.clip(0, HARDEST).tolist()
        return Course(gap, wall, roughness, int(rng.integers(2**31)))


def play(course: Course, policies: Array) -> Array:
    """Return how much of the course a runner of each policy crosses, in percent."""
    ground, runners = course.ground(), len(policies)
    weights = policies.reshape(runners, 2, SIGHT + 4)
    x, y, forward, upward = np.zeros((4, runners))
    running: Any = np.ones(runners, bool)
    for _ in range(STEPS):
        column = x.astype(int)
        stands = y <= ground[column]
        ahead = ground[column[:, None] + np.arange(1, SIGHT + 1)] - y[:, None]
        seen = np.column_stack([ahead.clip(-2, 2), forward, upward, stands, np.ones(runners)])
        push, jump = np.tanh(np.einsum("rs,ras->ar", seen, weights))
        # A runner pushes and jumps where it stands, and walks up small steps without a jump.
        forward = np.where(stands, forward + 0.1 * push, forward).clip(0, 1)
        upward = np.where(stands, 0.8 * jump.clip(0), upward - 0.1)
        forward[ground[(x + forward).astype(int)] > y + upward.clip(0) + 0.3] = 0
        x = np.where(running, x + forward, x).clip(0, LENGTH)
        y = np.maximum(y + upward, ground[x.astype(int)])
        running &= (y > -2) & (x < LENGTH)
    return 100 * x / LENGTH


def share(managed: Any) -> None:
    """Keep the manager's dict of all pairs; the initializer of a worker."""
    global pairs
    pairs = managed


def improve(policy_of: int, course_of: int, seed: int) -> list[tuple[float, Array]]:
    """Return a pair's policy with its score on a course, then a better policy with its score."""
    policy, course = pairs[policy_of][1], pairs[course_of][0]
    rng, before = np.random.default_rng(seed), (play(course, policy[None])[0], policy)
    for _ in range(UPDATES):
        noise = rng.normal(size=(NOISES, PARAMETERS))
        scores = play(course, policy + SIGMA * np.concatenate([noise, -noise]))
        better, worse = np.split(scores.argsort().argsort() / len(scores), 2)
        policy = policy + RATE * (better - worse) @ noise / NOISES
    return [before, (play(course, policy[None])[0], policy)]
