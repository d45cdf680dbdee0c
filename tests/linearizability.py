"""Search for an order of operations that explains what several processes saw of an object.

The search of Wing and Gong (Testing and verifying concurrent objects, 1993): the next operation in
order is one of those that began before any other that is left had ended, and the object's model
must allow what it saw.  Where that leads nowhere, another is tried; no situation is tried twice.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterable
from typing import Any, NamedTuple


class Operation(NamedTuple):
    """Operation of a process, with its result."""

    name: str
    argument: Hashable
    result: Any
    start: int
    """Time of the clock that all processes of a machine share, in ns."""
    end: int


Model = Callable[[Any, Operation], Any]
"""The state after an operation; None if it cannot have seen this."""


def call(name: str, action: Callable[..., Any], *arguments: Any) -> Operation:
    """Do it, and note when and what came of it."""
    start = time.monotonic_ns()
    result = action(*arguments)
    return Operation(name, arguments, result, start, time.monotonic_ns())


def is_linearizable(history: Iterable[Operation], model: Model, state: Hashable) -> bool:
    """Return whether some order that respects the clock explains all."""
    operations = sorted(history, key=lambda operation: operation.start)
    left = frozenset(range(len(operations)))
    seen = {(left, state)}
    stack = [(left, state)]
    while stack:
        left, state = stack.pop()
        if not left:
            return True
        first_end = min(operations[number].end for number in left)
        for number in left:
            if operations[number].start > first_end:
                continue
            after = model(state, operations[number])
            situation = left - {number}, after
            if after is not None and situation not in seen:
                seen.add(situation)
                stack.append(situation)
    return False


def semaphore(maximum: int) -> Model:
    """Model of a semaphore or lock; its state is the number of free tokens."""

    def model(tokens: int, operation: Operation) -> int | None:
        if operation.name == "release":
            return tokens + 1 if tokens < maximum else None
        if operation.result:
            return tokens - 1 if tokens else None
        return None if tokens else tokens

    return model


def queue(items: tuple[Hashable, ...], operation: Operation) -> tuple[Hashable, ...] | None:
    """Model of a queue; its state is its items."""
    if operation.name == "put":
        return (*items, operation.argument)
    if items and items[0] == (operation.result,):
        return items[1:]
    return None
