"""Comparison of the values of two runs: numbers are equal to the last bit, or differ."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from published.runs import Value

Leaf = float | int | str | bool


def leaves(values: Mapping[str, Value]) -> dict[str, Leaf]:
    """Return all single values by the path to them."""
    return {path: leaf for name, value in values.items() for path, leaf in _below(name, value)}


def difference(expected: Mapping[str, Value], found: Mapping[str, Value]) -> str | None:
    """Return the first difference in words, or None if all values are the same."""
    theirs, ours = leaves(expected), leaves(found)
    for path in [*theirs, *(path for path in ours if path not in theirs)]:
        if path not in ours:
            return f"{path} is missing"
        if path not in theirs:
            return f"{path} is {ours[path]!r}, and multiprocessing has none"
        if not _same(theirs[path], ours[path]):
            return f"{path} is {ours[path]!r}, with multiprocessing {theirs[path]!r}"
    return None


def _same(one: Leaf, other: Leaf) -> bool:
    if isinstance(one, float) and isinstance(other, float) and math.isnan(one):
        return math.isnan(other)
    return type(one) is type(other) and one == other


def _below(path: str, value: Value) -> Iterator[tuple[str, Leaf]]:
    if isinstance(value, float | int | str | bool):
        yield path, value
        return
    for number, each in enumerate(value):
        yield from _below(f"{path}[{number}]", each)
