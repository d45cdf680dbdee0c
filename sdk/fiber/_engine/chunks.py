"""How much work one message carries, and how many messages one worker is given ahead.

Pure: numbers in, numbers out.  A message should carry some milliseconds of work, so that its cost
disappears beside it: tasks of a second travel one by one, tasks of a microsecond by the thousand.
That a message may turn out to carry far more is the worker's business: it gives back what it has
not begun (``_agent/watchdog.py``).
"""

from __future__ import annotations

TARGET = 16e-3
"""Seconds of work that one message should carry."""

PROMPT = 4e-3
"""The same for tasks whose results are wanted one by one, as they are ready."""

FLOOR = 250e-6
"""Seconds of work that one message carries even where less would spread it more evenly."""

GROWTH = 8
"""A message carries at most this many times the tasks of the largest one that was measured."""

RESUMED = 64
"""What a function that ran before is trusted with at first, counted as a measured message."""

LIMIT = 1 << 12
"""Tasks in one message, however short they are."""

SLOW = 50e-3
"""Tasks of this many seconds do not queue behind another: the gap between two cannot be seen."""

SHORTEST = 1e-9
"""Seconds that a task takes at least; clocks are not better than that."""

STRIDE_SECONDS = 200e-6
STRIDE_LIMIT = 1024


class Pace:
    """Running estimate of the seconds that one task of a function takes."""

    __slots__ = ("largest", "seconds")

    def __init__(self, earlier: Pace | None = None) -> None:
        """Start from nothing, or from what was known of the same function, trusted a little."""
        self.seconds: float | None = earlier.seconds if earlier else None
        self.largest: int = min(earlier.largest, RESUMED) if earlier else 0

    def observe(self, tasks: int, seconds: float) -> None:
        """Take in that ``tasks`` of them took ``seconds`` together."""
        if not tasks:
            return
        # One very long task must not make the next thousand travel alone for long.
        each = min(max(seconds / tasks, SHORTEST), 4 * SLOW)
        self.seconds = each if self.seconds is None else (self.seconds + each) / 2
        self.largest = max(self.largest, tasks)

    def batch_size(self, waiting: int, workers: int, unit: int = 1, target: float = TARGET) -> int:
        """Tasks to send next: whole units of ``unit``, at least one, at most what is ``waiting``.

        About ``target`` seconds of work, but no more than half of a worker's fair share of what
        waits, so that all end together.
        """
        size = self.message_size(target)
        share = waiting // (2 * workers)
        if size > share and self.seconds is not None:
            size = min(size, max(share, int(FLOOR / self.seconds)))
        units = size // unit or 1
        return min(units * unit, waiting)

    def message_size(self, target: float = TARGET) -> int:
        """Tasks that one message carries where there are plenty."""
        seconds = self.seconds
        if seconds is None or seconds > target:
            return 1
        return min(int(target / seconds), GROWTH * self.largest, LIMIT)

    def may_queue(self, waiting: int) -> bool:
        """Whether to send something to a worker that has something to do already.

        Not slow tasks, which another worker may run sooner; and nothing that takes less time than
        its message: it waits for more, until a worker asks for it by being idle.
        """
        return self.seconds is None or FLOOR / waiting <= self.seconds < SLOW

    @property
    def short(self) -> bool:
        """Whether tasks are known to take less than what is worth a message."""
        return self.seconds is not None and self.seconds < FLOOR

    def stride(self) -> int:
        """Tasks that a worker runs for each note of where it is.

        The notes tell which task killed it.  Of several very short ones between two notes all
        are suspects, and running them again one by one costs nothing.
        """
        if self.seconds is None:
            return 1
        return min(max(int(STRIDE_SECONDS / self.seconds), 1), STRIDE_LIMIT)


def default_chunksize(tasks: int, workers: int) -> int:
    """The chunk that multiprocessing takes when the user gives none: four for each worker."""
    return -(-tasks // (4 * workers)) or 1
