"""Size of messages to workers, and whether a worker gets one ahead.

Pure: numbers in, numbers out.  A message should carry some milliseconds of work, so that the cost
of the message hardly counts.  Tasks of a second travel one by one, tasks of a microsecond by the
thousand.  If a message carries far more work than estimated, the worker gives back the tasks that
it has not begun (``_agent/worker.py``).
"""

from __future__ import annotations

TARGET = 16e-3
"""Seconds of work that one message should carry."""

PROMPT = 4e-3
"""Seconds of work of one message if results are wanted one by one, as they are ready."""

FLOOR = 250e-6
"""Seconds of work that one message carries even if less would spread the work more evenly."""

GROWTH = 8
"""Bound of a message's tasks, as a multiple of the largest message that was measured."""

RESUMED = 64
"""Upper bound of ``largest`` at the start of a job whose function ran in earlier jobs."""

LIMIT = 1 << 12
"""Bound of the tasks in one message, however short they are."""

SLOW = 50e-3
"""Seconds from which on tasks do not queue: the gap between two such tasks is negligible."""

SHORTEST = 1e-9
"""Lower bound of a task's seconds; clocks are not more exact."""

STRIDE_SECONDS = 200e-6
STRIDE_LIMIT = 1024


class TaskPace:
    """Running estimate of the seconds that one task of a function takes."""

    __slots__ = ("largest", "seconds")

    def __init__(self, earlier: TaskPace | None = None) -> None:
        """Start without an estimate, or with an earlier one of the same function."""
        self.seconds: float | None = earlier.seconds if earlier else None
        self.largest: int = min(earlier.largest, RESUMED) if earlier else 0

    def observe(self, tasks: int, seconds: float) -> None:
        """Update the estimate: ``tasks`` of them took ``seconds`` together."""
        if not tasks:
            return
        # A bound, so that after one very long task the next thousand do not travel alone for long.
        each = min(max(seconds / tasks, SHORTEST), 4 * SLOW)
        self.seconds = each if self.seconds is None else (self.seconds + each) / 2
        self.largest = max(self.largest, tasks)

    def batch_size(self, waiting: int, workers: int, unit: int = 1, target: float = TARGET) -> int:
        """Return how many tasks to send next: whole units, at least one, at most ``waiting`` tasks.

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
        """Return the tasks of one message if plenty are waiting."""
        seconds = self.seconds
        if seconds is None or seconds > target:
            return 1
        return min(int(target / seconds), GROWTH * self.largest, LIMIT)

    def may_queue(self, waiting: int) -> bool:
        """Return whether to send a message to a worker that is busy already.

        False for slow tasks, which another worker may run sooner.  False for tasks that take less
        time than their message: they wait for more tasks, or for an idle worker.
        """
        return self.seconds is None or FLOOR / waiting <= self.seconds < SLOW

    @property
    def short(self) -> bool:
        """True if a task is known to take less time than a message is worth."""
        return self.seconds is not None and self.seconds < FLOOR

    def stride(self) -> int:
        """Return the tasks that a worker runs between two notes of its progress.

        The notes tell which task killed the worker.  All tasks between two notes are suspects.
        They are very short, so running them again one by one costs little.
        """
        if self.seconds is None:
            return 1
        return min(max(int(STRIDE_SECONDS / self.seconds), 1), STRIDE_LIMIT)


def default_chunksize(tasks: int, workers: int) -> int:
    """Return multiprocessing's default chunk size, which makes four chunks for each worker."""
    return -(-tasks // (4 * workers)) or 1
