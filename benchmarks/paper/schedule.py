"""The least time in which list scheduling finishes tasks of known lengths."""

from __future__ import annotations

import heapq
from collections.abc import Sequence


def list_schedule(seconds: Sequence[float], workers: int) -> float:
    """Return when the last task ends if each idle worker takes the next task of the list at once.

    No pool that hands out these tasks in this order can be faster, except by luck in the order of
    workers that become idle at the same moment. So this time divided by a pool's is its efficiency.
    """
    if workers < 1:
        raise ValueError(f"the number of workers must be at least 1, not {workers}")
    idle_at = [0.0] * min(workers, len(seconds))
    for each in seconds:
        heapq.heapreplace(idle_at, idle_at[0] + each)
    return max(idle_at, default=0.0)
