"""Picture of the learning curve."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

MEAN, EPISODE, GREY = "#c2410c", "#2563eb", "#94a3b8"
WINDOW = 50  # episodes in a mean


class Ended(NamedTuple):
    """End of an episode: after how many steps of training, and its return."""

    steps: int
    value: float


def write_curve(path: Path, title: str, ended: Sequence[Ended]) -> None:
    """Write a picture to `path`: the return of each episode, and their moving mean."""
    # Imported here, because the workers do not need it. A separate Figure draws without a display.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.6, 4.3), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    steps = [each.steps for each in ended]
    returns = np.array([each.value for each in ended])
    axes.scatter(steps, returns, s=8, color=EPISODE, alpha=0.25, lw=0, label="an episode")
    if len(returns) >= WINDOW:
        means = np.convolve(returns, np.ones(WINDOW) / WINDOW, mode="valid")
        axes.plot(
            steps[WINDOW - 1 :], means, color=MEAN, lw=2.4, label=f"mean of {WINDOW} episodes"
        )
    axes.set_title(title, loc="left", fontweight="bold")
    axes.set_xlabel("steps of all environments")
    axes.set_ylabel("return of an episode")
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color=GREY, alpha=0.25, lw=0.7)
    figure.savefig(path)
