"""How many agents there should be, and which of those that are idle can go.

Pure: ``now`` is an argument.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

from fiber._engine.placement import Placement

LINGER = 2.0
"""Seconds for which agents that have not joined yet are wanted after what they were wanted for is
gone: a worker that died is started again by its pool, a program goes on to its next pool."""


class Wish(NamedTuple):
    """What there should be from now on."""

    agents: int
    release: list[Any]
    """Agents that got no child for long enough and get none from now on."""
    wake_at: float
    """When to ask again at the latest; infinity if there is no need."""


class Demand:
    """The agents that the children of ``placement`` want: between ``minimum`` and ``maximum``.

    More are wanted as soon as children wait for whom those that are there have no room; an agent
    goes when it was idle for ``idle_timeout`` seconds.  So what is ever given up is an idle agent,
    by name, or one that has not joined.
    """

    def __init__(
        self,
        placement: Placement[Any, Any],
        *,
        minimum: int = 0,
        maximum: int,
        idle_timeout: float,
    ) -> None:
        self._placement = placement
        self._minimum = minimum
        self._maximum = maximum
        self._idle_timeout = idle_timeout
        self._wanted = minimum
        self._less_since: float | None = None

    def set_bounds(self, minimum: int, maximum: int) -> None:
        """Others from now on."""
        self._minimum, self._maximum = minimum, maximum

    def decide(self, now: float) -> Wish:
        """What there should be; who is to be released counts as gone."""
        release, wake_at = self._release(now)
        placement = self._placement
        joined = len(placement.loads)
        lacking = max(len(placement.waiting) - placement.room, 0)
        needed = joined + math.ceil(lacking / placement.slots)
        needed = min(max(needed, self._minimum), max(self._maximum, joined))
        kept = self._wanted - len(release)
        if needed >= kept:
            self._wanted, self._less_since = needed, None
        else:
            if self._less_since is None:
                self._less_since = now
            if now < self._less_since + LINGER:
                self._wanted = kept
                wake_at = min(wake_at, self._less_since + LINGER)
            else:
                self._wanted, self._less_since = needed, None
        return Wish(self._wanted, release, wake_at)

    def _release(self, now: float) -> tuple[list[Any], float]:
        placement = self._placement
        spare = len(placement.loads) - self._minimum
        idle = placement.idle
        longest_idle = itertools.islice(idle, max(spare, 0))
        overdue = list(
            itertools.takewhile(lambda agent: idle[agent] + self._idle_timeout <= now, longest_idle)
        )
        for agent in overdue:
            placement.remove(agent)
        oldest = next(iter(idle.values()), math.inf) if spare > len(overdue) else math.inf
        return overdue, oldest + self._idle_timeout
