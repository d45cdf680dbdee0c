"""Work of the two phases: exploration on processors, robustification on a GPU, if there is one."""

from __future__ import annotations

import random

from vault import MOVES, TREASURE, State, step

import fiber

Path = tuple[int, ...]
"""Moves from the start of the vault."""
Values = dict[tuple[State, int], list[float]]
"""Value of each move, by the state and the move before."""
STICKY = 0.25
"""Probability that the vault repeats the move before, in the second phase."""
MOST_STEPS = 400


def explore(state: State, path: Path, seed: int) -> list[tuple[State, Path, int]]:
    """Go back to a state, which is one assignment here, and move about from it; return the ways."""
    rng, found = random.Random(seed), []
    move = rng.randrange(4)
    for _ in range(60):
        if rng.random() < 0.3:
            move = rng.randrange(4)
        state, reward, over = step(state, move)
        path = (*path, move)
        if over and reward == 0:
            break
        found.append((state, path, reward))
        if over:
            break
    return found


def play(values: Values | Path, seed: int) -> bool:
    """Return whether moves, or a policy, reach the treasure although moves stick."""
    rng, state, last = random.Random(seed), State(), 0
    for number in range(MOST_STEPS):
        if isinstance(values, tuple):
            move = values[min(number, len(values) - 1)]
        else:
            known = values.get((state, last), [0.0] * 4)
            move = known.index(max(known))
        last = last if rng.random() < STICKY else move
        state, reward, over = step(state, last)
        if over:
            return reward == TREASURE
    return False


@fiber.meta(gpu=1)
def robustify(path: Path, episodes: int, seed: int) -> tuple[Values, list[float]]:
    """Learn a policy from one way to the treasure; return it, and its successes as it learned.

    The backward algorithm (Salimans and Chen 2018): episodes start near the treasure at first, and
    earlier on the way once the policy succeeds. Q-learning stands for a network, which would use
    the GPU.
    """
    rng, values, curve = random.Random(seed), Values(), list[float]()
    way = [(State(), 0)]
    for move in path:
        way.append((step(way[-1][0], move)[0], move))
    start, successes = len(way) - 2, 0.0
    for episode in range(episodes):
        state, last = way[start]
        won = _learn(values, state, last, rng)
        successes += 0.1 * (won - successes)
        if successes > 0.7 and start > 0:
            start, successes = max(start - 2, 0), 0.4
        if episode % (episodes // 20) == 0:
            curve.append(sum(play(values, seed) for seed in range(40)) / 40)
    return values, curve


def _learn(values: Values, state: State, last: int, rng: random.Random) -> bool:
    """Play an episode, and learn from each of its moves."""
    for _ in range(MOST_STEPS):
        known = values.setdefault((state, last), [0.0] * len(MOVES))
        best = max(known)
        options = [move for move, value in enumerate(known) if value == best]
        move = rng.randrange(4) if rng.random() < 0.1 else rng.choice(options)
        last = last if rng.random() < STICKY else move
        state, reward, over = step(state, last)
        ahead = 0.0 if over else 0.98 * max(values.get((state, last), (0.0,)))
        known[move] += 0.3 * ((reward == TREASURE) + ahead - known[move])
        if over:
            return reward == TREASURE
    return False
