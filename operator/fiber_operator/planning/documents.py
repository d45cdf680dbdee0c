"""Readers of JSON that may hold anything: each returns a value of its type and never raises."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from fiber_api.times import parse_time


def mapping(value: object, *path: str) -> Mapping[str, Any]:
    """Return the object at ``path`` below ``value``; an empty one if there is none."""
    for name in path:
        value = value.get(name) if isinstance(value, Mapping) else None
    return value if isinstance(value, Mapping) else {}


def items(value: object) -> Iterator[Mapping[str, Any]]:
    """Yield the objects in a list and skip its other items."""
    if isinstance(value, list | tuple):
        for item in value:
            if isinstance(item, Mapping):
                yield item


def text(value: object) -> str:
    """Return ``value`` if it is a string, else an empty string."""
    return value if isinstance(value, str) else ""


def whole(value: object, default: int = 0) -> int:
    """Return ``value`` if it is an integer, else ``default``."""
    return value if isinstance(value, int) and not isinstance(value, bool) else default


CLUSTER_SKEW = 60.0
"""Seconds by which the clocks of a cluster may differ."""


def unless_ahead(time: float | None, now: float) -> float | None:
    """Return ``time``; None if it is over CLUSTER_SKEW ahead, as the operator did not write it."""
    return None if time is None or time > now + CLUSTER_SKEW else time


def seconds(value: object) -> float:
    """Return the unix time of a timestamp of the API; 0.0 if it is none."""
    try:
        return parse_time(value) if isinstance(value, str) else 0.0
    except ValueError:
        return 0.0
