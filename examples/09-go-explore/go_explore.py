"""Go-Explore in small: explore on processors, then robustify on GPUs (Ecoffet et al. 2021)."""

from __future__ import annotations

import argparse
import random
import sys
from pathlib import Path
from typing import Any

from vault import MAP, START, TREASURE, State
from work import Policy, Way, explore, play, robustify

import fiber

try:
    import numpy as np
    from matplotlib.figure import Figure
except ModuleNotFoundError as error:
    sys.exit(f"09-go-explore needs {error.name}: pip install --editable '.[rl]'")


def cell_of(state: State) -> tuple[int, int, bool]:
    """Return the cell: similar states are one."""
    return state.x // 2, state.y // 2, state.key


def phase_1(options: argparse.Namespace) -> tuple[dict[Any, int], Way]:
    """Explore from known cells; return the round that found each, and the way to the treasure."""
    rng, start = random.Random(options.seed), cell_of(START)
    archive: dict[Any, tuple[State, Way, int]] = {start: (START, (), 0)}
    visits, found_in, treasure = {start: 0}, {start: 0}, Way()
    with fiber.Pool(min_workers=1, max_workers=options.workers) as pool:
        for number in range(1, options.rounds + 1):
            weights = [(count + 1) ** -0.5 for count in visits.values()]
            chosen = rng.choices(list(visits), weights, k=32)
            tasks = [(*archive[cell][:2], rng.randrange(2**31)) for cell in chosen]
            for origin, found in zip(chosen, pool.starmap(explore, tasks), strict=True):
                visits[origin] += 1
                score = archive[origin][2]
                for state, way, reward in found:
                    cell, score = cell_of(state), score + reward
                    _, known, highest = archive.get(cell, (None, (), -1))
                    if (score, -len(way)) > (highest, -len(known)):
                        archive[cell], visits[cell] = (state, way, score), 0
                        found_in.setdefault(cell, number)
                    if reward == TREASURE and not 0 < len(treasure) <= len(way):
                        treasure = way
            if number % 10 == 0:
                print(f"round {number}: {len(archive)} cells, a way of {len(treasure)} moves")
    return found_in, treasure


def phase_2(way: Way, options: argparse.Namespace) -> tuple[Policy, list[list[float]]]:
    """Learn several policies from the way; return the best one, and all learning curves."""
    tasks = [(way, options.episodes, options.seed + number) for number in range(options.policies)]
    with fiber.Pool(options.policies) as pool:
        policies, curves = zip(*pool.starmap(robustify, tasks, chunksize=1), strict=True)
    return max(zip(policies, curves, strict=True), key=lambda each: each[1][-1])[0], list(curves)


def draw(path: Path, found_in: dict[Any, int], curves: list[list[float]]) -> None:
    """Draw when each cell was found, and how often the policies succeeded while they learned."""
    figure = Figure(figsize=(10, 3.6), dpi=150, layout="constrained")
    vault, success = figure.subplots(1, 2, width_ratios=(1.8, 1))
    vault.imshow([["^#".find(tile) for tile in row] for row in MAP], cmap="Greys", alpha=0.4)
    x, y, keys = map(np.array, zip(*found_in, strict=True))
    dots = vault.scatter(2 * x + 0.3 + 0.6 * keys, 2 * y + 0.5, c=[*found_in.values()], s=14)
    figure.colorbar(dots, ax=vault, label="found in round", shrink=0.7)
    success.plot(np.linspace(0, 100, len(curves[0]), False), np.transpose(curves))
    success.set(xlabel="training, percent", ylabel="success with sticky moves")
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=60, help="of exploration")
    parser.add_argument("--workers", type=int, default=8, help="at most, in the first phase")
    parser.add_argument("--policies", type=int, default=3, help="learned in the second phase")
    parser.add_argument("--episodes", type=int, default=10_000, help="of each policy")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("go-explore.png"), help="the picture")
    options = parser.parse_args()
    if min(options.rounds, options.workers, options.policies, options.episodes) < 1:
        parser.error("--rounds, --workers, --policies and --episodes must be at least 1")
    if not options.out.parent.is_dir():
        parser.error(f"--out {options.out}: there is no folder {options.out.parent}")
    if options.out.suffix not in (".png", ".pdf", ".svg"):
        parser.error(f"--out {options.out}: the name must end in .png, .pdf or .svg")
    found_in, way = phase_1(options)
    if not way:
        sys.exit("The treasure was not found. More --rounds, or another --seed, may find it.")
    policy, curves = phase_2(way, options)
    successes = sum(play(policy, random.Random(seed)) for seed in range(200))
    draw(options.out, found_in, curves)
    print(f"with sticky moves, {successes / 2:.0f}% of 200 episodes succeed: {options.out}")


if __name__ == "__main__":
    main()
