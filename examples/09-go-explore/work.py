"""Tasks of the two phases: exploration on processors, robustification on GPUs."""

from __future__ import annotations

import random

from vault import START, TREASURE, State, step

import fiber

Way = tuple[int, ...]  # moves from the start
Policy = dict[tuple[State, int], list[float]]  # value of each move, by state and move before
STICKY = 0.25  # probability in the second phase that the move before is made again


def explore(state: State, way: Way, seed: int) -> list[tuple[State, Way, int]]:
    """Return to a state, which is an assignment here, and explore; list states, ways, rewards."""
    rng, found, move = random.Random(seed), [], 0
    for _ in range(60):
        move = rng.randrange(4) if rng.random() < 0.3 else move
        state, reward, over = step(state, move)
        way = (*way, move)
        if reward or not over:
            found.append((state, way, reward))
        if over:
            break
    return found


@fiber.meta(gpu=1)
def robustify(way: Way, episodes: int, seed: int) -> tuple[Policy, list[float]]:
    """Learn a policy from a way to the treasure; return it, and its success while it learned.

    Episodes start near the treasure, and earlier on the way once that succeeds.
    """
    rng, policy, curve, success = random.Random(seed), Policy(), list[float](), 0.0
    starts = [(START, 0)]
    for move in way[:-1]:
        starts.append((step(starts[-1][0], move)[0], move))
    for episode in range(episodes):
        success += 0.1 * (play(policy, rng, *starts[-1], rate=0.2) - success)
        if success > 0.5 and len(starts) > 1:
            del starts[max(len(starts) - 2, 1) :]
            success -= 0.2
        if episode % max(1, episodes // 20) == 0:
            curve.append(sum(play(policy, rng) for _ in range(40)) / 40)
    return policy, curve


def play(
    policy: Policy, rng: random.Random, state: State = START, last: int = 0, rate: float = 0.0
) -> bool:
    """Play an episode with sticky moves, and learn at this rate; return whether it succeeds."""
    for _ in range(400):
        values = policy.setdefault((state, last), [0.0] * 4)
        best = [move for move in range(4) if values[move] == max(values)]
        move = rng.choice(range(4) if rate and rng.random() < 0.05 else best)
        last = last if rng.random() < STICKY else move
        state, reward, over = step(state, last)
        ahead = 0.0 if over else 0.98 * max(policy.get((state, last), (0.0,)))
        values[move] += rate * ((reward == TREASURE) + ahead - values[move])
        if over:
            return reward == TREASURE
    return False
