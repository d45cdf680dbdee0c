"""Readers of JSON that may hold anything: each returns a value of its type and never raises."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from fiber_api.times import parse_time


def mapping(value: object, *path: str) -> Mapping[str, Any]:
    """The object at ``path`` below ``value``; an empty one where there is none."""
    for name in path:
        value = value.get(name) if isinstance(value, Mapping) else None
    return value if isinstance(value, Mapping) else {}


def items(value: object) -> Iterator[Mapping[str, Any]]:
    """The objects in a list; what else stands in it is left out."""
    if isinstance(value, list | tuple):
        for item in value:
            if isinstance(item, Mapping):
                yield item


def text(value: object) -> str:
    """A string; an empty one for anything else."""
    return value if isinstance(value, str) else ""


def whole(value: object, default: int = 0) -> int:
    """An integer; ``default`` for anything else."""
    return value if isinstance(value, int) and not isinstance(value, bool) else default


SKEW = 60.0
"""Seconds that the clocks of a cluster may differ by."""


def past(time: float | None, now: float) -> float | None:
    """A time that the operator wrote; None if it has not come yet: then it is none of ours."""
    return None if time is None or time > now + SKEW else time


def seconds(value: object) -> float:
    """The unix time that a timestamp of the API tells; 0.0 where it tells none."""
    try:
        return parse_time(value) if isinstance(value, str) else 0.0
    except ValueError:
        return 0.0
