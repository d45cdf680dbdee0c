"""Picture of the learning curve."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

POLICY, POPULATION, RANDOM, GREY = "#c2410c", "#2563eb", "#64748b", "#94a3b8"


class Generation(NamedTuple):
    """Returns of the policy that a generation started from, and of the population around it."""

    tests: Sequence[float]
    population: Sequence[float]


class Outcome(NamedTuple):
    """Returns of many new episodes, by random actions and by the policy at the end."""

    random: Sequence[float]
    trained: Sequence[float]


def write_curve(
    path: Path, title: str, history: Sequence[Generation], outcome: Outcome | None
) -> None:
    """Write a picture to `path`: returns by generation and, if known, the outcome beside it."""
    # Imported here, because the workers do not need it. A separate Figure draws without a display.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.6, 4.3), dpi=150, layout="constrained")
    grid = figure.add_gridspec(1, 2, width_ratios=(3.4, 1))
    curve = figure.add_subplot(grid[0])
    _draw_history(curve, history)
    curve.set_title(title, loc="left", fontweight="bold")
    if outcome:
        random = float(np.mean(outcome.random))
        curve.axhline(random, color=RANDOM, ls="--", lw=1.2, zorder=1, label="random actions")
        _draw_outcome(figure.add_subplot(grid[1], sharey=curve), outcome)
    handles, labels = curve.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=4, frameon=False, fontsize=9)
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color=GREY, alpha=0.25, lw=0.7)
    figure.savefig(path)


def _draw_history(axes: Any, history: Sequence[Generation]) -> None:
    numbers = range(1, len(history) + 1)
    low, middle, high = np.percentile([g.population for g in history], [25, 50, 75], axis=1)
    axes.fill_between(
        numbers, low, high, color=POPULATION, alpha=0.15, lw=0, label="population, middle half"
    )
    axes.plot(numbers, middle, color=POPULATION, lw=1.2, label="population, median")
    tests = [np.mean(g.tests) for g in history]
    axes.plot(numbers, tests, color=POLICY, lw=2.4, label="the policy, without noise")
    axes.set_xlabel("generation")
    axes.set_ylabel("return of an episode")
    axes.margins(x=0.01)


def _draw_outcome(axes: Any, outcome: Outcome) -> None:
    spread = np.random.default_rng(0)  # sideways, so that equal returns do not hide each other
    for place, returns, colour in ((0, outcome.random, RANDOM), (1, outcome.trained, POLICY)):
        across = place + spread.uniform(-0.22, 0.22, len(returns))
        axes.scatter(across, returns, s=9, color=colour, alpha=0.45, lw=0)
        mean = float(np.mean(returns))
        axes.hlines(mean, place - 0.32, place + 0.32, color=colour, lw=2)
        axes.text(place + 0.36, mean, f"{mean:.0f}", color=colour, va="center", fontsize=9)
    axes.set_xlim(-0.6, 1.9)
    axes.set_xticks([0, 1], ["random", "trained"])
    axes.tick_params(labelleft=False)
    axes.set_title(f"{len(outcome.trained)} new episodes", fontsize=10)
