"""Statistics over rounds, and numbers in words: arithmetic without a clock or a file."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.model import Series

IDLE = 0.05
_TIMES = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"))
_SIZES = ((1e9, "GB"), (1e6, "MB"), (1e3, "kB"))


@dataclass(frozen=True)
class Summary:
    """Median, least and greatest of the rounds that gave a value."""

    median: float
    least: float
    greatest: float
    rounds: int


def summary(values: Series) -> Summary | None:
    """Return the spread; None if no round gave a value."""
    present = [value for value in values if value is not None]
    if not present:
        return None
    return Summary(statistics.median(present), min(present), max(present), len(present))


def ratio(values: Series, baseline: Series) -> Summary | None:
    """Return the ratio of each round in which both have a value, then its median and spread.

    Dividing within a round cancels what slows down the whole machine for a while; dividing two
    medians would not.
    """
    pairs = zip(values, baseline, strict=False)
    return summary([a / b for a, b in pairs if a is not None and b])


def percentile(values: Sequence[float], percent: float) -> float:
    """Return the value below which `percent` of the values lie, without interpolation; needs a
    value."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(len(ordered) * percent / 100))]


def is_idle(in_use: Sequence[float]) -> bool:
    """Tell whether other programs never used more than 5 % of the processors' time."""
    return max(in_use) <= IDLE


def in_words(value: float, unit: str) -> str:
    """Return a number with three significant digits and a fitting unit: 0.00131 s is "1.31 ms"."""
    if unit == "s":
        return _scaled(value, _TIMES)
    if unit == "B":
        return _scaled(value, _SIZES)
    if unit == "B/s":
        return f"{_scaled(value, _SIZES)}/s"
    return f"{_digits(value)} /s"


def times(value: float) -> str:
    """Return a ratio in words: "0.65x", "21.3x"; finer near one, as the budgets are."""
    fine = value < 0.1 or 0.9 <= value < 1.1
    digits = 3 if fine else 2 if value < 10 else 1 if value < 100 else 0
    return f"{value:,.{digits}f}x"


def _scaled(value: float, steps: Sequence[tuple[float, str]]) -> str:
    scale, name = next((step for step in steps if value >= step[0]), steps[-1])
    return f"{_digits(value / scale)} {name}"


def _digits(value: float) -> str:
    digits = 2 if value < 10 else 1 if value < 100 else 0
    return f"{value:,.{digits}f}"
