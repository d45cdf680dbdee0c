"""Picture of the scores that the searches have seen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np


def draw(path: Path, grid: Any, study: Any) -> None:
    """Write a picture to `path`: the scores of the grid, and of the study as it went on."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.8), dpi=150, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.1, 1))
    c, gamma = grid.param_grid["C"], grid.param_grid["gamma"]
    scores = grid.cv_results_["mean_test_score"].reshape(len(c), len(gamma))
    mesh = left.pcolormesh(gamma, c, scores, cmap="viridis", shading="nearest")
    left.plot(
        [trial.params["gamma"] for trial in study.trials],
        [trial.params["C"] for trial in study.trials],
        "o",
        color="white",
        markeredgecolor="black",
        markersize=4,
        label="trials of the study",
    )
    left.set(xscale="log", yscale="log", xlabel="gamma", ylabel="C", title="The grid")
    left.legend(loc="lower right", fontsize=8)
    figure.colorbar(mesh, ax=left, label="digits recognized")
    values = [trial.value for trial in study.trials]
    numbers = range(1, len(values) + 1)
    right.plot(numbers, values, "o", color="#64748b", markersize=4, label="a trial")
    right.plot(
        numbers, np.maximum.accumulate(values), color="#c2410c", lw=2, label="the best until then"
    )
    right.axhline(grid.best_score_, color="#2563eb", ls="--", lw=1, label="the best of the grid")
    right.set(xlabel="trial", ylabel="digits recognized", title="The study")
    right.legend(loc="lower right", fontsize=8)
    figure.savefig(path)
