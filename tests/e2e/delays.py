"""Seconds from an event to its effect, printed with the promise at the end of a run."""

from __future__ import annotations

from collections.abc import Iterator
from statistics import median

PROMISED = 1.0
"""Seconds within which half of all events of a session should be answered."""

measured: list[tuple[str, float]] = []
"""Each event of this session: its name and seconds."""


def record(what: str, seconds: float) -> None:
    """Add a figure to the report.  No test fails for it: a busy machine is slow."""
    measured.append((what, seconds))


def report() -> Iterator[str]:
    """Yield the lines of the report: the median beside the promise, then the slowest first."""
    middle = median(seconds for _, seconds in measured)
    yield f"{middle:6.2f}  median of {len(measured)}; {PROMISED:g} is promised"
    for what, seconds in sorted(measured, key=lambda found: -found[1]):
        yield f"{seconds:6.2f}  {what}"
