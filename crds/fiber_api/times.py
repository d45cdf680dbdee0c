"""Points in time: unix seconds in Python, RFC 3339 in the API. Standard library only."""

from __future__ import annotations

import datetime

EARLIEST = datetime.datetime.min.replace(tzinfo=datetime.UTC).timestamp()
LATEST = datetime.datetime.max.replace(tzinfo=datetime.UTC, microsecond=0).timestamp()
"""First and last second that can be written."""


def parse_time(text: str) -> float:
    """Return the unix seconds of ``2026-11-21T14:56:13Z`` and the like; else raise
    ``ValueError``."""
    try:
        moment = datetime.datetime.fromisoformat(text)
        if moment.tzinfo is None:
            raise ValueError
        # A time of the year 10000 in UTC could be read and never be written.
        return moment.astimezone(datetime.UTC).timestamp()
    except (ValueError, OverflowError):
        raise ValueError(f"{text!r} is no time such as 2026-11-21T14:56:13Z") from None


def format_micro_time(seconds: float) -> str:
    """Return the same as a Lease has it, with microseconds."""
    moment = datetime.datetime.fromtimestamp(seconds, datetime.UTC)
    return moment.isoformat(timespec="microseconds").replace("+00:00", "Z")


def format_time(seconds: float) -> str:
    """Return the time in the API's words, in UTC, rounded down to the second.

    A time before the year 1 or after 9999 becomes the first or the last second between.
    """
    seconds = min(max(seconds, EARLIEST), LATEST)
    moment = datetime.datetime.fromtimestamp(seconds // 1, datetime.UTC)
    return moment.isoformat().replace("+00:00", "Z")
