"""Picture of a program's timeline, by matplotlib: a row for each child, tasks a second below.

The picture has few artists, however many workers there are: one collection for each colour.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from math import ceil
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from fiber._runtime.trace_events import (
    NO_HOST,
    RUNNING,
    STARTING,
    UNFINISHED,
    WAITING,
    host_numbers,
    phases,
)

Facts = dict[str, Any]

_WIDTH = 11.0
"""Inches."""

_RATES_HEIGHT = 1.1
_LEAST_ROWS, _MOST_ROWS = 1.0, 8.0
"""Inches of all rows together."""

_ROW = 0.3
"""Inches of a row where there is room."""

_NAMED_ROWS = 40
"""Rows that have labels of their own."""

_COLOURS = ("#0f766e", "#d97706", "#4f46e5", "#be185d", "#65a30d", "#0891b2", "#7c3aed", "#a16207")
_OTHERS = "#64748b"
_PHASE_COLOURS = {
    WAITING: "#e2e8f0",
    STARTING: "#94a3b8",
    RUNNING: "#a5b4fc",
    UNFINISHED: "#fda4af",
}
_PHASE_LABELS = {RUNNING: "process", UNFINISHED: "unfinished tasks"}
_LIFE = "#f1f5f9"
_DEATH = "#dc2626"
_INK = "#334155"
_FRAME = "#94a3b8"
_RATE = "#94a3b8"
_IDLE = "idle"
_HALF = 0.42
"""Half of the height of a bar, in rows."""

_LONGEST_NAME = 34
_LETTERS, _SPACE = 170, 8
"""Letters of a line of the legend, and those that the mark of an entry takes."""


_CELLS = 3000
"""Parts of the time axis that a picture can show.  Spans of one colour in one cell become one."""

_VECTORS = 8000
"""Bars that a vector format gets as shapes.  More become an image within it."""


class Bar(NamedTuple):
    """Bar in a row."""

    row: int
    begin: float
    end: float


def draw(snapshot: Facts, name: str) -> Figure:
    """Return the picture of a snapshot; ``name``: that of the program."""
    hosts = host_numbers(snapshot["children"])
    children = sorted(snapshot["children"], key=lambda one: (hosts[one["host"]], one["id"]))
    height = min(max(_ROW * len(children), _LEAST_ROWS), _MOST_ROWS)
    figure = Figure(figsize=(_WIDTH, height + _RATES_HEIGHT + 1.3), dpi=150, layout="constrained")
    rows, rates = figure.subplots(
        2, 1, sharex=True, gridspec_kw={"height_ratios": (height, _RATES_HEIGHT)}
    )
    unit, size = _time_unit(snapshot["now"])
    legend = _draw_rows(rows, snapshot, children, size)
    _draw_rates(rates, snapshot, size)
    rates.set_xlabel(f"{unit} since the program's first use of Fiber", color=_INK, fontsize=9)
    rates.set_xlim(0, max(snapshot["now"], 1e-3) / size)
    figure.suptitle(_title(snapshot, name), x=0.008, ha="left", color=_INK, fontsize=11)
    _draw_legend(figure, legend)
    for axes in (rows, rates):
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(_FRAME)
        axes.tick_params(colors=_INK, labelsize=8, length=2)
    return figure


def _draw_legend(figure: Figure, entries: list[Patch | Line2D]) -> None:
    if entries:
        room = sum(len(str(entry.get_label())) + _SPACE for entry in entries)
        figure.legend(
            handles=entries[::-1],
            loc="outside lower left",
            ncols=ceil(len(entries) / ceil(room / _LETTERS)),
            fontsize=8,
            frameon=False,
            labelcolor=_INK,
            handlelength=1.2,
            columnspacing=1.4,
        )


def _time_unit(seconds: float) -> tuple[str, float]:
    """Return the unit of the time axis, and its seconds."""
    for unit, size in (("hours", 3600.0), ("minutes", 60.0)):
        if seconds > 3 * size:
            return unit, size
    return "seconds", 1.0


def _title(snapshot: Facts, name: str) -> str:
    children = snapshot["children"]
    hosts = len({child["host"] for child in children if child["started"] is not None})
    failed = f", {snapshot['failed']:,} failed" if snapshot["failed"] else ""
    parts = [
        name,
        f"{snapshot['tasks']:,} tasks{failed}",
        f"{len(children):,} {'process' if len(children) == 1 else 'processes'}",
        f"{hosts:,} {'host' if hosts == 1 else 'hosts'}",
        f"{snapshot['now']:.3g} s",
    ]
    if snapshot["forgotten"]:
        parts.append(f"{snapshot['forgotten']:,} earlier processes are left out")
    return "  ·  ".join(parts)


# ---- rows -------------------------------------------------------------------------------------


def _draw_rows(
    axes: Axes, snapshot: Facts, children: list[Facts], size: float
) -> list[Patch | Line2D]:
    """Draw the rows; return the entries of the legend."""
    colours = _colours(snapshot["functions"])
    bars: dict[str, list[Bar]] = defaultdict(list)
    now, busy = snapshot["now"], dict(snapshot["busy"])
    for row, child in enumerate(children):
        for kind, begin, end in _kinds(child, now, busy.get(child["id"]), colours):
            bars[kind].append(Bar(row, begin, end))
    legend: list[Patch | Line2D] = []
    for kind in [_IDLE, *reversed(_PHASE_COLOURS), _OTHERS, *reversed(colours.values())]:
        if kind in bars:
            colour = _PHASE_COLOURS.get(kind, _LIFE if kind == _IDLE else kind)
            _add_bars(axes, bars[kind], colour, now, size)
            legend.append(Patch(color=colour, label=_label(kind, colours)))
    if deaths := _draw_deaths(axes, children, size):
        legend.append(deaths)
    if not children:
        axes.text(0.5, 0.5, "no process yet", transform=axes.transAxes, ha="center", color=_INK)
    axes.set_ylim(max(len(children), 1) - 0.5, -0.5)
    _label_rows(axes, children)
    return legend


def _colours(functions: Iterable[Facts]) -> dict[str, str]:
    """Return the colours of the functions with the most work."""
    by_work = sorted(functions, key=lambda one: float(one["work"]), reverse=True)
    return {
        one["name"]: colour for one, colour in zip(by_work, _COLOURS, strict=False) if one["tasks"]
    }


def _kinds(
    child: Facts, now: float, busy_since: float | None, colours: dict[str, str]
) -> Iterator[tuple[str, float, float]]:
    """Yield kind, begin and end of the bars of a child; the kind of a function is its colour."""
    if child["ready"] is not None:
        yield _IDLE, child["ready"], now if child["ended"] is None else child["ended"]
    yield from phases(child, now, busy_since)
    yield from _work(child["spans"], colours, now / _CELLS)


def _work(
    spans: Iterable[list[Any]], colours: dict[str, str], gap: float
) -> Iterator[tuple[str, float, float]]:
    """Yield kind, begin and end of work; neighbours of a kind that are ``gap`` apart as one."""
    kind, begin, end = "", 0.0, 0.0
    for next_begin, next_end, function, _, tasks, _ in spans:
        next_kind = colours.get(function, _OTHERS) if tasks else UNFINISHED
        if next_kind != kind or next_begin - end > gap:
            if kind:
                yield kind, begin, end
            kind, begin = next_kind, next_begin
        end = next_end
    if kind:
        yield kind, begin, end


def _label(kind: str, colours: dict[str, str]) -> str:
    if kind in _PHASE_COLOURS or kind == _IDLE:
        return _PHASE_LABELS.get(kind, kind)
    names = {colour: name for name, colour in colours.items()}
    return _shortened(names.get(kind, "several or other functions"))


def _shortened(name: str) -> str:
    return name if len(name) <= _LONGEST_NAME else f"…{name[1 - _LONGEST_NAME :]}"


def _add_bars(axes: Axes, bars: list[Bar], colour: str, now: float, size: float) -> None:
    least = now / _CELLS
    kept = list(_joined(bars, least))
    corners = [
        [(begin, row - _HALF), (begin, row + _HALF), (end, row + _HALF), (end, row - _HALF)]
        for row, begin, end in (
            (bar.row, bar.begin / size, max(bar.end, bar.begin + least) / size) for bar in kept
        )
    ]
    axes.add_collection(
        PolyCollection(corners, facecolors=colour, linewidths=0, rasterized=len(kept) > _VECTORS),
        autolim=False,
    )


def _joined(bars: Iterable[Bar], gap: float) -> Iterator[Bar]:
    """Yield the bars; those of a row that are closer than ``gap`` as one."""
    last: Bar | None = None
    for bar in bars:
        if last is not None and bar.row == last.row and bar.end - last.begin <= gap:
            last = last._replace(end=max(last.end, bar.end))
            continue
        if last is not None:
            yield last
        last = bar
    if last is not None:
        yield last


def _draw_deaths(axes: Axes, children: list[Facts], size: float) -> Line2D | None:
    dead = [(row, child) for row, child in enumerate(children) if child["reason"]]
    if not dead:
        return None
    (marks,) = axes.plot(
        [child["ended"] / size for _, child in dead],
        [row for row, _ in dead],
        "X",
        color=_DEATH,
        markeredgecolor="white",
        markersize=8 if len(children) <= _NAMED_ROWS else 6,
        clip_on=False,
        label="death",
    )
    return marks


def _label_rows(axes: Axes, children: list[Facts]) -> None:
    firsts = [
        row
        for row, child in enumerate(children)
        if row == 0 or child["host"] != children[row - 1]["host"]
    ]
    if 1 < len(firsts) <= _NAMED_ROWS:
        axes.hlines(
            [row - 0.5 for row in firsts[1:]],
            0,
            1,
            transform=axes.get_yaxis_transform(),
            colors=_FRAME,
            linewidths=0.6,
        )
    if 0 < len(children) <= _NAMED_ROWS:
        several = len(firsts) > 1
        names = [
            f"{child['host'] or NO_HOST}  {child['name']}" if several else child["name"]
            for child in children
        ]
        axes.set_yticks(range(len(children)), [_shortened(name) for name in names])
    elif 1 < len(firsts) <= _NAMED_ROWS:
        axes.set_yticks(firsts, [_shortened(children[row]["host"] or NO_HOST) for row in firsts])
    elif children:
        axes.set_ylabel("processes", color=_INK, fontsize=9)
        axes.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=8))
    else:
        axes.set_yticks([])


# ---- tasks a second ---------------------------------------------------------------------------


def _draw_rates(axes: Axes, snapshot: Facts, size: float) -> None:
    rates = snapshot["rates"]
    width, count = rates["width"], len(rates["done"])
    edges = [min(at * width, max(snapshot["now"], width)) / size for at in range(count + 1)]
    if count:
        done = [number / width for number in rates["done"]]
        axes.stairs(done, edges, fill=True, color=_RATE)
        if any(rates["failed"]):
            failed = [number / width for number in rates["failed"]]
            axes.stairs(failed, edges, fill=True, color=_DEATH, label="failed")
            axes.legend(fontsize=8, frameon=False, loc="upper right", labelcolor=_INK)
    axes.set_ylim(bottom=0)
    axes.set_ylabel("tasks a second", color=_INK, fontsize=9)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=3))
