"""Pictures: one for each measure, with the same colour and marker for a contender in all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

from benchmarks import (
    agents,
    coldstart,
    endings,
    executors,
    jax_start,
    large_messages,
    latency,
    overhead,
    parallel_loops,
    pipes,
    sharing,
    startup,
    throughput,
    vector,
    workers,
)
from benchmarks.contenders import BY_NAME
from benchmarks.model import Case, Metric, Run
from benchmarks.samples import Summary, in_words, summary
from matplotlib import pyplot as plt
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

_NARROW = 1000
Points = Sequence[tuple[float, str]]


def _overhead(run: Run, path: Path) -> None:
    figure, panels = plt.subplots(1, 2, figsize=(12, 5), sharey=True)
    for panel, chunks in zip(panels, overhead.CHUNKS, strict=True):
        points = [
            (duration, overhead.case_name(duration, chunks)) for duration in overhead.DURATIONS
        ]
        panel.axhline(run.about["size"], color="#bbbbbb", linestyle="--", zorder=0)
        lines(panel, run, points, overhead.TIME)
        panel.invert_xaxis()
        panel.set(title=chunks[0].upper() + chunks[1:], xlabel="duration of a task")
        unit(panel.xaxis, "s", list(overhead.DURATIONS))
    panels[0].set_ylabel("time to finish (dashed: no overhead; ✗: not finished)")
    finish(figure, path)


def _throughput(run: Run, path: Path) -> None:
    figure, panels = plt.subplots(1, 2, figsize=(12, 5.5), width_ratios=(3, 2))
    names = [case.name for case in throughput.cases(run.about["size"])]
    rates = [name for name in names if name.startswith(("map", "imap", "apply"))]
    _rows(panels[0], run, rates, throughput.RATE)
    panels[0].set(title="No-op tasks: further right is better", xlabel="tasks a second")
    _rows(panels[1], run, [name for name in names if name not in rates], throughput.TIME)
    panels[1].set(title="Batches: further left is better", xlabel="time of the batch")
    finish(figure, path)


def _latency(run: Run, path: Path) -> None:
    figure, panel = plt.subplots(figsize=(9, 4))
    present = [name for name in BY_NAME if _found(run, latency.NAME, name, latency.P50)]
    for row, name in enumerate(present):
        middle, slow = (
            _found(run, latency.NAME, name, metric) for metric in (latency.P50, latency.P95)
        )
        if middle and slow:
            colour, marker = BY_NAME[name].colour, BY_NAME[name].marker
            panel.plot(
                [middle.median, slow.median],
                [row, row],
                color=colour,
                marker=marker,
                markersize=8,
                markevery=[0],
            )
            panel.plot(slow.median, row, color=colour, marker="|", markersize=14)
    panel.set(
        yticks=range(len(present)),
        yticklabels=[BY_NAME[name].label for name in present],
        xscale="log",
        xlabel="time of one apply: p50 (marker) to p95 (bar)",
    )
    panel.invert_yaxis()
    unit(panel.xaxis, "s")
    finish(figure, path, legend=False)


def _pipes(run: Run, path: Path) -> None:
    figure, panels = plt.subplots(2, 2, figsize=(12, 9))
    messages = [name for name, _, _ in pipes.MESSAGES]
    _pipe_panel(panels[0, 0], run, messages, messages, "where the kernel puts both")
    for panel, place in zip((panels[0, 1], panels[1, 0]), pipes.PLACES, strict=True):
        cases = [pipes.placed(name, place) for name in messages]
        _pipe_panel(panel, run, messages, cases, f"on {place}")
    steps = [case.name for case in pipes.cases(run.about["size"]) if case.group == pipes.STEPS]
    lines(panels[1, 1], run, list(enumerate(steps)), pipes.STEP, log_x=False)
    panels[1, 1].set(
        title="One step of Gymnasium's AsyncVectorEnv",
        ylabel="time",
        xticks=range(len(steps)),
        xticklabels=steps,
        xlim=(-0.5, len(steps) - 0.5),
    )
    finish(figure, path)


def _sharing(run: Run, path: Path) -> None:
    figure, panels = plt.subplots(1, 2, figsize=(13, 5), width_ratios=(2, 1))
    arrays = [sharing.array(megabytes) for megabytes in sharing.MEGABYTES]
    cases = sharing.cases(run.about["size"])
    calls = [case.name for case in cases if sharing.CALL in case.metrics]
    _rows(panels[0], run, [name for name in calls if name not in arrays], sharing.CALL)
    panels[0].set(title="Calls: further left is better", xlabel="time of one")
    _rows(panels[1], run, arrays, sharing.CALL)
    panels[1].set(title="Arrays, written there and read here", xlabel="time of one")
    finish(figure, path)


def _pipe_panel(
    panel: Any, run: Run, messages: Sequence[str], cases: Sequence[str], where: str
) -> None:
    lines(panel, run, list(enumerate(cases)), pipes.ROUND_TRIP, log_x=False)
    panel.set(
        title=f"Round trip through a Pipe, {where}",
        xlabel="message",
        ylabel="time",
        xticks=range(len(messages)),
        xticklabels=messages,
        xlim=(-0.5, len(messages) - 0.5),
    )


def _vector(run: Run, path: Path) -> None:
    figure, grid = plt.subplots(2, 3, figsize=(15, 9.5))
    *panels, spare = grid.flat
    for panel, (ending, title) in zip(panels, vector.PANELS.items(), strict=True):
        points = [(float(count), f"{count:,} {ending}") for count in vector.COUNTS]
        lines(panel, run, points, vector.RATE)
        panel.set(title=title[0].upper() + title[1:], xlabel="environments", xticks=vector.COUNTS)
        counts(panel.xaxis)
    for panel in (grid[0, 0], grid[1, 0]):
        panel.set_ylabel("environment steps a second (✗: not finished)")
    spare.set_axis_off()
    finish(figure, path)


def _executors(run: Run, path: Path) -> None:
    _rates(run, path, executors.cases(run.about["size"]), executors.RATE, height=4)


def _parallel_loops(run: Run, path: Path) -> None:
    _rates(run, path, parallel_loops.cases(run.about["size"]), parallel_loops.RATE, height=5)


def _rates(run: Run, path: Path, cases: Sequence[Case], rate: Metric, *, height: float) -> None:
    figure, panel = plt.subplots(figsize=(10, height))
    _rows(panel, run, [case.name for case in cases], rate)
    panel.set(title="Further right is better", xlabel="tasks a second")
    finish(figure, path)


def _startup(run: Run, path: Path) -> None:
    figure, panels = plt.subplots(1, 3, figsize=(14, 5))
    points = [(float(count), startup.workers(count)) for count in startup.WORKERS]
    for panel, metric, title in (
        (panels[0], startup.START, "Until all workers work"),
        (panels[1], startup.MEMORY, "Memory of all of them"),
        (panels[2], startup.STOP, "Until all are gone"),
    ):
        lines(panel, run, points, metric)
        panel.set(title=title, xlabel="workers", xticks=startup.WORKERS, xlim=(0.7, 1500))
        counts(panel.xaxis)
    finish(figure, path)


def _coldstart(run: Run, path: Path) -> None:
    figure, panels = plt.subplots(1, 2, figsize=(12, 4), sharey=True)
    names = [case.name for case in coldstart.cases(run.about["size"])]
    for panel, metric, title in (
        (panels[0], coldstart.READY, "Until all workers are ready"),
        (panels[1], coldstart.MAP, "Until the first map has returned"),
    ):
        _rows(panel, run, names, metric)
        panel.set(title=title, xlabel="time since the interpreter was started")
    finish(figure, path)


def _jax_start(run: Run, path: Path) -> None:
    figure, panels = plt.subplots(1, 2, figsize=(12, 3.5), sharey=True)
    names = [case.name for case in jax_start.cases(run.about["size"])]
    for panel, metric in zip(panels, (jax_start.FIRST, jax_start.SECOND), strict=True):
        _rows(panel, run, names, metric)
        panel.set(title=f"The {metric.label} of a program", xlabel="time to its first map")
    finish(figure, path)


def _workers(run: Run, path: Path) -> None:
    figure, panel = plt.subplots(figsize=(9, 4))
    points = [(float(count), workers.workers(count)) for count in workers.WORKERS]
    lines(panel, run, points, workers.COST)
    panel.set(
        title="The master's processor time to start a worker",
        xlabel="workers of the pool",
        xticks=workers.WORKERS,
    )
    counts(panel.xaxis)
    finish(figure, path)


def _endings(run: Run, path: Path) -> None:
    figure, panel = plt.subplots(figsize=(9, 4))
    _rows(panel, run, [case.name for case in endings.cases(run.about["size"])], endings.TIME)
    panel.set(title="Further left is better", xlabel="time to end")
    finish(figure, path)


def _large_messages(run: Run, path: Path) -> None:
    figure, grid = plt.subplots(2, 4, figsize=(16, 8), sharey="row")
    sizes = large_messages.SIZES
    for row, metric in zip(grid, (large_messages.RATE, large_messages.BESIDE), strict=True):
        for panel, way in zip(row, large_messages.WAYS, strict=True):
            points = [
                (float(n), large_messages.case_name(label, way)) for label, n in sizes.items()
            ]
            lines(panel, run, points, metric)
            panel.set(title=f"{way}: {metric.label}", xlabel="message")
            panel.set_xticks(list(sizes.values()), list(sizes))
            panel.xaxis.set_minor_formatter(NullFormatter())
    finish(figure, path)


def _agents(run: Run, path: Path) -> None:
    figure, panels = plt.subplots(1, 3, figsize=(14, 5))
    points = [(float(count), agents.agents(count)) for count in agents.AGENTS]
    for panel, metric, title in (
        (panels[0], agents.JOINED, "Until all have joined"),
        (panels[1], agents.MEMORY, "Memory of the master for a link"),
        (panels[2], agents.DEFAULT, "No-op tasks a second, default chunks"),
    ):
        lines(panel, run, points, metric)
        panel.set(title=title, xlabel="agents", xticks=agents.AGENTS)
        counts(panel.xaxis)
    finish(figure, path)


DRAW: Mapping[str, Callable[[Run, Path], None]] = {
    "overhead": _overhead,
    "throughput": _throughput,
    "latency": _latency,
    "executors": _executors,
    "parallel_loops": _parallel_loops,
    "pipes": _pipes,
    "large_messages": _large_messages,
    "vector": _vector,
    "sharing": _sharing,
    "startup": _startup,
    "coldstart": _coldstart,
    "jax_start": _jax_start,
    "workers": _workers,
    "agents": _agents,
    "endings": _endings,
}


def lines(panel: Any, run: Run, points: Points, metric: Metric, *, log_x: bool = True) -> None:
    """Draw a line for each contender, whose bars reach from the least to the greatest of the
    rounds."""
    for name, contender in BY_NAME.items():
        found = [(x, value) for x, case in points if (value := _found(run, case, name, metric))]
        style = {"color": contender.colour, "marker": contender.marker, "label": contender.label}
        if found:
            panel.errorbar(
                [x for x, _ in found],
                [value.median for _, value in found],
                yerr=_bars([value for _, value in found]),
                capsize=2,
                markersize=6,
                **style,
            )
        for x, case in points:
            if name in (failed := list(run.failures.get(case, {}))):
                # Side by side along the top, because several may fail at the same point.
                panel.annotate(
                    "✗",
                    (x, 0.96),
                    xycoords=panel.get_xaxis_transform(),
                    xytext=(-11 * failed.index(name), 0),
                    textcoords="offset points",
                    color=contender.colour,
                    fontsize=12,
                    horizontalalignment="center",
                )
    if not panel.lines:
        return  # no values: a logarithmic axis needs some
    panel.margins(y=0.12)
    if log_x:
        panel.set_xscale("log")
    panel.set_yscale("log")
    unit(panel.yaxis, metric.unit)
    panel.grid(axis="y", color="#eeeeee")


def _rows(panel: Any, run: Run, cases: Sequence[str], metric: Metric) -> None:
    """Draw a row for each case with a marker for each contender."""
    for name, contender in BY_NAME.items():
        found = [
            (row, value)
            for row, case in enumerate(cases)
            if (value := _found(run, case, name, metric))
        ]
        if found:
            # Fiber's marker on top, where markers meet.
            panel.errorbar(
                [value.median for _, value in found],
                [row for row, _ in found],
                xerr=_bars([value for _, value in found]),
                linestyle="",
                marker=contender.marker,
                color=contender.colour,
                label=contender.label,
                markersize=8,
                capsize=2,
                zorder=4 if name.startswith("fiber") else 3,
            )
    panel.set(
        yticks=range(len(cases)), yticklabels=cases, xscale="log", ylim=(len(cases) - 0.5, -0.5)
    )
    panel.grid(axis="y", color="#eeeeee")
    unit(panel.xaxis, metric.unit)


def _found(run: Run, case: str, contender: str, metric: Metric) -> Summary | None:
    return summary(run.values.get(case, {}).get(contender, {}).get(metric.name, []))


def _bars(found: Sequence[Summary]) -> list[list[float]]:
    return [
        [each.median - each.least for each in found],
        [each.greatest - each.median for each in found],
    ]


def unit(axis: Any, name: str, ticks: Sequence[float] | None = None) -> None:
    """Label an axis with numbers of this unit, at these ticks if they are given."""
    low, high = axis.get_view_interval()
    if ticks:
        axis.set_ticks(ticks)
    elif high < _NARROW * low:
        # Ticks at decades alone would leave one number or none on an axis of a decade or two.
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: _short(value, name)))
    axis.set_minor_formatter(NullFormatter())


def counts(axis: Any) -> None:
    """Label an axis with whole numbers."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    axis.set_minor_formatter(NullFormatter())


def _short(value: float, unit: str) -> str:
    """Return a tick: "1 ms", "10,000"."""
    number, _, name = in_words(value, unit).partition(" ")
    short = number.rstrip("0").rstrip(".") if "." in number else number
    return short if unit == "1/s" else f"{short} {name}"


def finish(figure: Any, path: Path, *, legend: bool = True) -> None:
    """Add one legend for all panels, and write the picture."""
    for panel in figure.axes:
        panel.spines[["top", "right"]].set_visible(False)
    if legend:
        entries = {
            text: line
            for panel in figure.axes
            for line, text in zip(*panel.get_legend_handles_labels(), strict=True)
        }
        figure.legend(
            entries.values(), entries.keys(), loc="outside lower center", ncols=5, frameon=False
        )
    figure.set_layout_engine("constrained")
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)
