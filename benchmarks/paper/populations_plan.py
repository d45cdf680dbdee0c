"""Work of the two runs whose population grows and shrinks: tasks, as seconds, by phase and wave.

A task plays episodes one after the other. An episode takes as long as a recorded one of
BipedalWalkerHardcore.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from benchmarks.paper import recording

POET, GO_EXPLORE = "poet", "go-explore"
ENVIRONMENTS = (2, 2, 3, 4, 6, 8, 10, 12, 12, 10, 8, 6, 4, 3, 2, 2)
"""POET's environments in each generation."""
EPISODES = 30
"""Episodes of a task: mean 6 s."""
ROBUSTIFIED = 120
"""Episodes of a task that robustifies: mean 24 s."""
CELLS, AT_ONCE, ROUNDS = 2, 12, 9
"""Go-Explore's cells at first, the most that one round explores, and its rounds."""
POLICIES = 2
"""Policies that Go-Explore robustifies, each on a GPU."""


@dataclass(frozen=True)
class Phase:
    """Waves of tasks that begin one after the other, on workers with or without a GPU."""

    gpu: bool
    waves: list[list[float]]

    @property
    def peak(self) -> int:
        """Return the largest number of tasks that are open at the same time."""
        return max(map(len, self.waves))

    @property
    def work(self) -> float:
        """Return the seconds that the tasks take together."""
        return sum(map(sum, self.waves))

    @property
    def bound(self) -> float:
        """Return the least seconds in which the waves can end: those of their longest tasks."""
        return sum(map(max, self.waves))


Plan = list[Phase]


def plans(size: float) -> dict[str, Plan]:
    """Return the work of both runs: all of it at size 1; below, fewer episodes and waves."""
    return {POET: poet(size), GO_EXPLORE: go_explore(size)}


def poet(size: float) -> Plan:
    """Return a wave for each generation, with a task for each environment."""
    sizes = _some(ENVIRONMENTS, size)
    return [
        Phase(
            gpu=False,
            waves=[
                [_task((number, generation), _scaled(EPISODES, size)) for number in alive]
                for generation, alive in enumerate(populations(sizes))
            ],
        )
    ]


def go_explore(size: float) -> Plan:
    """Return rounds that explore from known cells, and then a wave that robustifies on GPUs."""
    known = [min(CELLS * 2**number, AT_ONCE) for number in range(ROUNDS)]
    rounds = [
        [_task((100 + cell, number), _scaled(EPISODES, size)) for cell in range(cells)]
        for number, cells in enumerate(_some(known, size))
    ]
    policies = [_task((200 + number, 0), _scaled(ROBUSTIFIED, size)) for number in range(POLICIES)]
    return [Phase(gpu=False, waves=rounds), Phase(gpu=True, waves=[policies])]


def populations(sizes: Sequence[int]) -> Iterator[list[int]]:
    """Yield the numbers of the environments in each generation.

    Environments are added up to the generation's size; above it the oldest ones are dropped.
    """
    alive: deque[int] = deque()
    born = 0
    for size in sizes:
        while len(alive) < size:
            alive.append(born)
            born += 1
        while len(alive) > size:
            alive.popleft()
        yield list(alive)


def _task(seed: tuple[int, int], episodes: int) -> float:
    """Return the seconds of so many recorded episodes, drawn anew for each seed."""
    seconds = recording.read(recording.WALKER).seconds
    return round(sum(random.Random(f"{seed}").choices(seconds, k=episodes)), 3)


def _some(sizes: Sequence[int], size: float) -> Sequence[int]:
    """Return evenly spaced ones of the sizes: a share of them, the greatest included."""
    count = max(3, round(len(sizes) * size))
    if count >= len(sizes):
        return sizes
    middle = sizes.index(max(sizes))
    places = {round(place * (len(sizes) - 1) / (count - 1)) for place in range(count)}
    return [sizes[place] for place in sorted({*places, middle})]


def _scaled(count: int, size: float) -> int:
    return max(1, round(count * size))
