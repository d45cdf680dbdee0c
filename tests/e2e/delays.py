"""How soon the operator did or said what an event asks for: asserted, and shown at the end."""

from __future__ import annotations

from statistics import median

PROMISED = 1.0
"""Seconds; what half of all events of a session must keep to."""

LIMIT = 10.0
"""Seconds for any one of them: a test that fails when the machine is busy for a moment says
nothing.  What was measured is shown at the end of a run.
"""

_FEW = 5

measured: list[tuple[str, float]] = []
"""What was measured in this session: what, and seconds."""


def prompt(what: str, seconds: float) -> None:
    """Take note, and fail if it took too long."""
    measured.append((what, seconds))
    assert seconds < LIMIT, f"{what}: {seconds:.2f} s, which is more than {LIMIT:g}"


def complaint() -> str | None:
    """What is wrong with all of them together, if there were enough to say."""
    middle = median(seconds for _, seconds in measured) if len(measured) >= _FEW else 0.0
    if middle <= PROMISED:
        return None
    return f"half of what the operator does took {middle:.2f} s and more, not {PROMISED:g} s"
