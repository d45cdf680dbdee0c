"""How soon the operator did or said what an event asks for: asserted, and shown at the end."""

from __future__ import annotations

LIMIT = 10.0
"""Seconds.  About one is promised; the rest is for a machine that has much else to do, since a test
that fails when the machine is busy says nothing.  What was measured is shown at the end of a run.
"""

measured: list[tuple[str, float]] = []
"""What was measured in this session: what, and seconds."""


def prompt(what: str, seconds: float) -> None:
    """Take note, and fail if it took too long."""
    measured.append((what, seconds))
    assert seconds < LIMIT, f"{what}: {seconds:.2f} s, which is more than {LIMIT:g}"
