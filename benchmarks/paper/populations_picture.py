"""Picture of the runs whose population grows and shrinks.

Demand is a line over steps of pods.  Below are the processor-seconds that the pods held until then.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks import figures
from benchmarks.paper.populations_results import (
    DYNAMIC,
    PICTURE,
    STATIC,
    TITLES,
    Results,
    Trace,
)
from benchmarks.samples import times
from matplotlib import pyplot as plt

_DYNAMIC, _STATIC, _DEMAND, _GPU, _GREY = "#0072B2", "#bbbbbb", "#D55E00", "#009E73", "#777777"


def draw(results: Results, folder: Path) -> None:
    """Write the picture, with two panels for each run."""
    names = [name for name in TITLES if name in results.traces]
    size = (8 * len(names), 7)
    figure, panels = plt.subplots(
        2, len(names), figsize=size, squeeze=False, sharex="col", height_ratios=(5, 2)
    )
    for pods, sums, name in zip(*panels, names, strict=True):
        _pods(pods, name, results.traces[name])
        _sums(sums, results.traces[name])
    figures.finish(figure, folder / PICTURE)


def _pods(panel: Any, name: str, both: dict[str, Trace]) -> None:
    dynamic, static = both[DYNAMIC], both[STATIC]
    _fill(panel, static, _STATIC, "pods, static allocation of the peak", 0.45)
    _fill(panel, dynamic, _DYNAMIC, "pods, dynamic pool", 0.55)
    if dynamic.gpu_seconds:
        _fill(panel, dynamic, _GPU, "pods with a GPU, dynamic pool", 0.9, gpu=True)
    panel.axvline(static.wall, color=_GREY, linestyle=":", label="end of the static run")
    panel.step(
        [0.0, *(each.at for each in dynamic.demand), dynamic.wall],
        [0, *(each.tasks for each in dynamic.demand), 0],
        where="post",
        color=_DEMAND,
        linewidth=1.4,
        label="open tasks, dynamic pool",
    )
    panel.set(
        title=_title(name, dynamic, static),
        ylabel="pods on nodes, open tasks",
        xlim=(0, 1.1 * max(dynamic.wall, static.wall)),
        ylim=(0, None),
    )


def _sums(panel: Any, both: dict[str, Trace]) -> None:
    """Draw the processor-seconds of both allocations."""
    for allocation, colour in ((STATIC, _GREY), (DYNAMIC, _DYNAMIC)):
        at, seconds = zip(*both[allocation].growth, strict=True)
        label = f"processor-seconds so far, {allocation}"
        panel.plot(at, seconds, color=colour, linewidth=1.8, label=label)
    panel.set(
        xlabel="seconds since the program's begin", ylabel="processor-seconds", ylim=(0, None)
    )


def _fill(
    panel: Any, trace: Trace, colour: str, label: str, alpha: float, *, gpu: bool = False
) -> None:
    """Fill the steps of the pods, of all of them or of those with a GPU."""
    heights = [each.gpu_pods if gpu else each.pods for each in trace.samples]
    panel.fill_between(
        [*(each.at for each in trace.samples), trace.until],
        [*heights, heights[-1]],
        step="post",
        color=colour,
        alpha=alpha,
        linewidth=0,
        label=label,
    )


def _title(name: str, dynamic: Trace, static: Trace) -> str:
    ratios = [f"{times(dynamic.processor_seconds / static.processor_seconds)} processor-seconds"]
    if static.gpu_seconds:
        ratios.append(f"{times(dynamic.gpu_seconds / static.gpu_seconds)} GPU-seconds")
    ratios.append(f"{times(dynamic.wall / static.wall)} wall time")
    return f"{TITLES[name]}: {', '.join(ratios)}"
