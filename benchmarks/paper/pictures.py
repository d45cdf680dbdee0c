"""Pictures in the layout of the paper's figure: three panels, and each panel alone with more."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks import figures, overhead
from benchmarks.contenders import BY_NAME
from benchmarks.model import Run
from benchmarks.paper import breakout, evolution
from benchmarks.samples import summary
from matplotlib import pyplot as plt

_GREY = "#777777"


def draw(runs: Mapping[str, Run], folder: Path) -> None:
    """Write a picture for each part that was measured, and one of all three side by side."""
    for name, paint in _PANELS.items():
        if name in runs:
            figure, panel = plt.subplots(figsize=(9, 5))
            paint(panel, runs[name])
            figures.finish(figure, folder / f"{name}.png")
    if all(name in runs for name in _PANELS):
        figure, panels = plt.subplots(1, 3, figsize=(16, 5))
        for letter, panel, (name, paint) in zip("abc", panels, _PANELS.items(), strict=True):
            paint(panel, runs[name])
            panel.set_title(f"({letter}) {panel.get_title()}")
        figures.finish(figure, folder / "results.png")


def _overhead(panel: Any, run: Run) -> None:
    """Draw groups of bars, a group for each duration of a task."""
    durations = [each for each in overhead.DURATIONS if _name(each) in run.values]
    present = [name for name in BY_NAME if any(name in run.values[_name(d)] for d in durations)]
    width = 0.84 / max(1, len(present))
    for place, name in enumerate(present):
        found = [
            summary(run.values[_name(each)].get(name, {}).get(overhead.TIME.name, []))
            for each in durations
        ]
        panel.bar(
            [x + (place - (len(present) - 1) / 2) * width for x in range(len(durations))],
            [each.median if each else 0 for each in found],
            width,
            color=BY_NAME[name].colour,
            label=BY_NAME[name].label,
        )
    panel.axhline(run.about["size"], color=_GREY, linestyle="--", zorder=0)
    panel.set(
        title="Framework overhead",
        xlabel="duration of a task",
        ylabel="time of the batch (dashed: no overhead)",
        yscale="log",
        xticks=range(len(durations)),
        xticklabels=[overhead.DURATIONS[each] for each in durations],
    )
    figures.unit(panel.yaxis, "s")


def _name(duration: float) -> str:
    return overhead.case_name(duration, "chunksize 1")


def _evolution(panel: Any, run: Run) -> None:
    cases = evolution.cases(run.about["size"])
    points = [(float(case.params["workers"]), case.name) for case in cases]
    bounds = [evolution.bound(**case.params) for case in cases]
    iterations = cases[0].params["iterations"]
    figures.lines(panel, run, points, evolution.TIME)
    panel.plot([x for x, _ in points], bounds, color=_GREY, linestyle="--", label="bound")
    panel.set(
        title="Evolution strategies",
        xlabel="workers (✗: did not finish)",
        ylabel=f"time of {iterations} iteration{'s' * (iterations != 1)}",
        yscale="log",
        xticks=[x for x, _ in points],
    )
    figures.counts(panel.xaxis)
    figures.unit(panel.yaxis, "s")


def _breakout(panel: Any, run: Run) -> None:
    cases = [
        case
        for case in breakout.cases(run.about["size"])
        if case.name == breakout.recorded(case.params["workers"])
    ]
    points = [(float(case.params["workers"]), case.name) for case in cases]
    figures.lines(panel, run, points, breakout.TIME)
    panel.set(
        title="PPO",
        xlabel="workers, one environment each",
        ylabel=f"time of {cases[0].params['steps']:,} steps",
        xticks=[x for x, _ in points],
    )
    figures.counts(panel.xaxis)


_PANELS = {"overhead": _overhead, "evolution": _evolution, "breakout": _breakout}
