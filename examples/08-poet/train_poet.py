"""POET in small: the program invents courses, and policies that cross them (Wang et al. 2019)."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import fiber

try:
    import numpy as np
    from course import HARDEST, PARAMETERS, Array, Course, improve, play, share
    from matplotlib.figure import Figure
except ModuleNotFoundError as error:
    sys.exit(f"08-poet needs {error.name}: pip install --editable '.[rl]'")

MASTERED, TOO_HARD, TOO_EASY = 90, 15, 85  # scores; the last two are the minimal criterion
CHILDREN, ADMITTED, NEIGHBOURS, TRANSFER_EVERY = 8, 2, 3, 6


class Poet:
    """POET with its pairs of a course and a policy. As a manager has them, tasks are small."""

    def __init__(self, pool: Any, pairs: Any, most: int, seed: int) -> None:
        self.pool, self.pairs, self.most = pool, pairs, most
        self.rng = np.random.default_rng(seed)
        self.archive, self.scores = list[Course](), dict[int, float]()
        self.add(Course(1.0, 0.3, 0.05, seed), self.rng.normal(size=PARAMETERS) * 0.1, 0.0)

    def add(self, course: Course, policy: Array, score: float) -> None:
        """Add a pair; where they are too many, the oldest one goes."""
        self.pairs[len(self.archive)], self.scores[len(self.archive)] = (course, policy), score
        self.archive.append(course)
        if len(self.scores) > self.most:
            del self.pairs[min(self.scores)], self.scores[min(self.scores)]

    def improved(self, pairs: list[tuple[int, int]]) -> Any:
        """Improve policies on courses, side by side; return the courses and the results."""
        tasks = [(*pair, int(self.rng.integers(2**31))) for pair in pairs]
        return zip(tasks, self.pool.starmap(improve, tasks, chunksize=1), strict=True)

    def optimize(self) -> None:
        """Improve each policy on its own course."""
        for (_, number, _), (_, (score, policy)) in self.improved([(n, n) for n in self.scores]):
            self.settle(number, score, policy)

    def settle(self, number: int, score: float, policy: Array) -> None:
        self.scores[number], self.pairs[number] = score, (self.archive[number], policy)

    def transfer(self) -> None:
        """Move policies to courses on which they, or what they become there, do better."""
        pairs = [(one, other) for other in self.scores for one in self.scores if one != other]
        for (_, number, _), results in self.improved(pairs):
            score, policy = max(results, key=lambda result: result[0])
            if score > self.scores[number]:
                self.settle(number, score, policy)

    def reproduce(self) -> None:
        """Give mastered courses children; admit the newest that are neither too hard nor easy."""
        parents = [number for number, score in self.scores.items() if score >= MASTERED]
        chosen = self.rng.choice(parents, CHILDREN).tolist() if parents else []
        born = [(self.archive[each].child(self.rng), self.pairs[each][1]) for each in chosen]
        scores = self.pool.starmap(play, [(course, policy[None]) for course, policy in born])
        fit = [(*born[at], each) for at, (each,) in enumerate(scores) if TOO_HARD < each < TOO_EASY]
        for child in sorted(fit, key=self.novelty, reverse=True)[:ADMITTED]:
            self.add(*child)

    def novelty(self, child: tuple[Course, Array, float]) -> float:
        apart = (np.array([earlier[:3] for earlier in self.archive]) - child[0][:3]) / HARDEST
        return float(np.sort(np.linalg.norm(apart, axis=1))[:NEIGHBOURS].mean())


def draw(path: Path, history: list[tuple[dict[int, float], int]]) -> None:
    """Draw the score of each pair over the iterations, and the sizes of population and pool."""
    scores = np.full((max(history[-1][0]) + 1, len(history)), np.nan)
    for iteration, (pairs, _) in enumerate(history):
        scores[list(pairs), iteration] = list(pairs.values())
    figure = Figure(figsize=(8.6, 5.4), dpi=150, layout="constrained")
    lives, sizes = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    figure.colorbar(lives.pcolormesh(scores), ax=lives, label="crossed, percent of the course")
    lives.set(title="Score of each pair", ylabel="pair, oldest below")
    sizes.step(range(1, len(history) + 1), [(len(pairs), count) for pairs, count in history])
    sizes.set(xlabel="iteration", ylabel="number")
    sizes.legend(["pairs", "workers"], frameon=False)
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=30)
    parser.add_argument("--pairs", type=int, default=8, help="at most, and as many workers")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("poet.png"), help="the picture")
    options = parser.parse_args()
    if min(options.iterations, options.pairs) < 1 or options.seed < 0:
        parser.error("--iterations and --pairs must be at least 1, --seed at least 0")
    if not options.out.parent.is_dir():
        parser.error(f"--out {options.out}: there is no folder {options.out.parent}")
    if options.out.suffix not in (".png", ".pdf", ".svg"):
        parser.error(f"--out {options.out}: the name must end in .png, .pdf or .svg")
    history: list[tuple[dict[int, float], int]] = []
    with fiber.Manager() as manager:
        pairs, sizes = manager.dict(), {"min_workers": 1, "max_workers": options.pairs}
        with fiber.Pool(None, share, (pairs,), idle_timeout=2, **sizes) as pool:
            poet = Poet(pool, pairs, options.pairs, options.seed)
            for iteration in range(1, options.iterations + 1):
                poet.optimize()
                if iteration % TRANSFER_EVERY == 0:
                    poet.transfer()
                    poet.reproduce()
                history.append((dict(poet.scores), len(pool.workers())))
                mastered = sum(score >= MASTERED for score in poet.scores.values())
                print(f"iteration {iteration}: {len(poet.scores)} pairs, {mastered} mastered")
    draw(options.out, history)
    print(f"{len(poet.archive)} courses were invented; picture: {options.out}")


if __name__ == "__main__":
    main()
