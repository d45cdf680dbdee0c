"""Picture of the error as it falls."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def draw(path: Path, errors: Sequence[float], members: int) -> None:
    """Write a picture to `path`: the error before each step."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.6), dpi=150, layout="constrained")
    axes = figure.subplots()
    axes.plot(range(len(errors)), errors, "o-", color="#c2410c", markersize=4)
    axes.axhline(1, color="#64748b", ls="--", lw=1, label="the noise of the data")
    axes.set(
        yscale="log",
        xlabel="steps",
        ylabel="mean squared error",
        title=f"Gradient descent, summed over a ring of {members}",
    )
    axes.legend(frameon=False)
    figure.savefig(path)
