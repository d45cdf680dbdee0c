"""Waiting tasks: slices of a job, kept whole so that a million tasks cost as much as one."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

COMPACT = 1024
"""Given-out items at the front of a growing list above which the list is trimmed."""


class Span:
    """Tasks ``start``, ``start + 1``, ... with their ``items``.

    ``alone``: each travels in a separate message; ``pin``: only one certain worker may run them.
    """

    __slots__ = ("alone", "items", "pin", "start")

    def __init__(
        self, start: int, items: Sequence[Any], alone: bool = False, pin: bool = False
    ) -> None:
        self.start = start
        self.items = items
        self.alone = alone
        self.pin = pin

    def part(self, first: int, stop: int, *, alone: bool = False) -> Span:
        """Return the tasks from ``first`` to before ``stop``, as indexes of the job."""
        items = self.items[first - self.start : stop - self.start]
        return Span(first, items, alone or self.alone, self.pin)

    def singly(self) -> list[Span]:
        """Return each task as a span that travels alone."""
        first = self.start
        return [self.part(at, at + 1, alone=True) for at in range(first, first + len(self.items))]

    def around(self, suspects: range) -> list[Span]:
        """Return in pieces: tasks before the suspects, each suspect alone, tasks after them."""
        if not suspects:
            return [self] if len(self.items) else []
        pieces, stop = [], self.start + len(self.items)
        if self.start < suspects.start:
            pieces.append(self.part(self.start, suspects.start))
        pieces += self.part(suspects.start, suspects.stop).singly()
        if suspects.stop < stop:
            pieces.append(self.part(suspects.stop, stop))
        return pieces


class _Stock:
    """Span that is given out from its front, and grows at its end while tasks come in."""

    __slots__ = ("alone", "items", "position", "start")

    def __init__(self, span: Span) -> None:
        self.start = span.start
        self.items = span.items
        self.alone = span.alone
        self.position = 0

    def __len__(self) -> int:
        return len(self.items) - self.position

    def cut(self, size: int) -> Span:
        position = self.position
        span = Span(self.start + position, self.items[position : position + size], self.alone)
        self.position = position + size
        return span

    def grow(self, span: Span) -> bool:
        """Append ``span`` if it fits on without a copy of the items; return whether it does."""
        if (
            not isinstance(self.items, list)
            or self.alone != span.alone
            or self.start + len(self.items) != span.start
        ):
            return False
        if self.position > COMPACT and 2 * self.position > len(self.items):
            del self.items[: self.position]
            self.start += self.position
            self.position = 0
        self.items.extend(span.items)
        return True


class Waiting:
    """Waiting tasks of one job, in the order in which they will be given out."""

    __slots__ = ("_count", "_stocks")

    def __init__(self) -> None:
        self._stocks: deque[_Stock] = deque()
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def items(self) -> Iterator[Any]:
        """Yield the items of the waiting tasks."""
        for stock in self._stocks:
            yield from stock.items[stock.position :]

    def first(self) -> int:
        """Return the index of the next task."""
        stock = self._stocks[0]
        return stock.start + stock.position

    def first_alone(self) -> bool:
        """Return whether the next task travels alone."""
        return self._stocks[0].alone

    def append(self, span: Span) -> None:
        """Add tasks behind all others."""
        self._count += len(span.items)
        if not self._stocks or not self._stocks[-1].grow(span):
            self._stocks.append(_Stock(span))

    def appendleft(self, span: Span) -> None:
        """Add tasks that come back ahead of all others."""
        self._count += len(span.items)
        self._stocks.appendleft(_Stock(span))

    def take(self, size: int) -> Span:
        """Take the next tasks: at most ``size``, contiguous, one if it travels alone."""
        stock = self._stocks[0]
        span = stock.cut(1 if stock.alone else min(size, len(stock)))
        if not len(stock):
            self._stocks.popleft()
        self._count -= len(span.items)
        return span
