"""Points in time: unix seconds in Python, RFC 3339 in the API.  Standard library only."""

from __future__ import annotations

import datetime


def parse_time(text: str) -> float:
    """The unix seconds of ``2026-11-21T14:56:13Z`` or its like; else ``ValueError``."""
    try:
        moment = datetime.datetime.fromisoformat(text)
        if moment.tzinfo is None:
            raise ValueError
        return moment.timestamp()
    except (ValueError, OverflowError):
        raise ValueError(f"{text!r} is no time such as 2026-11-21T14:56:13Z") from None


def format_time(seconds: float) -> str:
    """The same in the API's words, in UTC, to the second below."""
    moment = datetime.datetime.fromtimestamp(seconds // 1, datetime.UTC)
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")
