"""Picture: how pods become ready, and the operator's memory meanwhile."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

from benchmarks.operator_scale.cases import CASES, FIBER, SUBJECTS
from benchmarks.operator_scale.results import MEGA, Curve, Result, Trial
from matplotlib import pyplot as plt
from matplotlib.ticker import FuncFormatter

_MOST_MEMORY = 150
_SHADES = ("#d62728", "#ff9896", "#8c2d04")


def draw(known: Mapping[str, Result], path: Path) -> None:
    """Draw a panel for each case, and one for the operator's memory in all of them."""
    figure, panels = plt.subplots(1, len(known) + 1, figsize=(4.2 * (len(known) + 1), 4.4))
    for panel, (name, result) in zip(panels, known.items(), strict=False):
        _growth(panel, name, result)
    panels[0].set_ylabel("ready pods (dotted: created)")
    _memory(panels[-1], known)
    for panel in panels:
        panel.set_xlabel("seconds since the objects were made")
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(axis="y", color="#eeeeee")
    entries = {
        text: line
        for panel in panels[:-1]
        for line, text in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        entries.values(), entries.keys(), loc="outside lower center", ncols=2, frameon=False
    )
    figure.set_layout_engine("constrained")
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def _growth(panel: Any, name: str, result: Result) -> None:
    for subject in SUBJECTS:
        for trial in result.of(subject.name):
            style = {"color": subject.colour, "alpha": 0.85, "linewidth": 1.6}
            panel.step(
                *_until_settled(trial, trial.ready), where="post", label=subject.label, **style
            )
            panel.plot(*_until_settled(trial, trial.created), linestyle=":", **style)
    panel.set(title=CASES[name].title, xlim=(0, None), ylim=(0, None))
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))


def _until_settled(trial: Trial, curve: Curve) -> tuple[list[float], list[float]]:
    shown = [point for point in curve if point[0] <= trial.steps["settled"] + 0.5]
    return [at for at, _ in shown], [number for _, number in shown]


def _memory(panel: Any, known: Mapping[str, Result]) -> None:
    for colour, (name, result) in zip(_SHADES, known.items(), strict=False):
        for trial in result.of(FIBER.name)[:1]:
            if trial.operator:
                seconds = [at for at, _ in trial.operator.memory]
                sizes = [size / MEGA for _, size in trial.operator.memory]
                panel.plot(seconds, sizes, color=colour, linewidth=1.6)
                if sizes:
                    panel.annotate(
                        CASES[name].title,
                        (seconds[-1], sizes[-1]),
                        color=colour,
                        xytext=(-4, 5),
                        textcoords="offset points",
                        fontsize=9,
                        ha="right",
                    )
    panel.axhline(_MOST_MEMORY, color="#bbbbbb", linestyle="--", zorder=0)
    panel.set(title="The operator's memory (dashed: budget)", xlim=(0, None), ylim=(0, None))
    panel.set_ylabel("MB; made, halved, deleted")
