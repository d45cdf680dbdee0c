"""Place and time of a run of the benchmarks, for the tests of their pages."""

from __future__ import annotations

from typing import Any

_ABOUT = {
    "date": "2026-01-01 00:00 UTC",
    "command": "python benchmarks/run.py",
    "rounds": 1,
    "size": 1.0,
    "cores": 2,
    "processor": "a processor",
    "memory": "8.00 GB",
    "load": 0.0,
    "system": "Linux 6",
    "python": "3.11.0",
    "versions": {},
    "skipped": {},
}


def about(**differently: Any) -> dict[str, Any]:
    """Return the fields of ``Run.about``."""
    return {**_ABOUT, **differently}
