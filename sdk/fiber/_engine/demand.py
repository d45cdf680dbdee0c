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


class Desired(NamedTuple):
    """What there should be from now on."""

    agents: int
    release: list[Any]
    """Agents that got no child for long enough and get none from now on."""
    wake_at: float
    """When to ask again at the latest; infinity if there is no need."""


class Demand:
    """The agents that the children of ``placement`` want, ``maximum`` at most.

    More are wanted as soon as children wait for whom those that are there have no room; an agent
    goes when it was idle for ``idle_timeout`` seconds, but for the last ``floor`` ones, which
    somebody else wants: they stay and are not asked for.  So what is ever given up is an idle
    agent, by name, or one that has not joined.
    """

    def __init__(
        self, placement: Placement[Any, Any], *, maximum: int, idle_timeout: float, floor: int = 0
    ) -> None:
        self.floor = floor
        self.maximum = maximum
        self._placement = placement
        self._idle_timeout = idle_timeout
        self._retiring: set[Any] = set()
        self._wanted = 0
        self._less_since: float | None = None

    def retire(self, agent: Any) -> None:
        """Another is to take its place: let it go as soon as it is idle."""
        self._placement.withhold(agent, "retired")
        self._retiring.add(agent)

    def decide(self, now: float) -> Desired:
        """What there should be; who is to be released counts as gone."""
        release = self._release_retired()
        overdue = self._overdue(now)
        spare = max(len(self._placement.loads) - self.floor, 0)
        release += overdue[:spare]
        for agent in overdue[:spare]:
            self._placement.remove(agent)
        spared = len(overdue[spare:])
        agents = self._decide_agents(now, len(release), spared)
        return Desired(agents, release, self._wake_at(spared))

    def _decide_agents(self, now: float, released: int, spared: int) -> int:
        placement = self._placement
        used = len(placement.loads) - spared
        lacking = max(len(placement.waiting) - placement.room, 0)
        needed = min(used + math.ceil(lacking / placement.slots), max(self.maximum, used))
        kept = self._wanted - released
        if needed >= kept or (self._less_since is not None and now >= self._less_since + LINGER):
            self._wanted, self._less_since = needed, None
        else:
            self._wanted = kept
            self._less_since = now if self._less_since is None else self._less_since
        return self._wanted

    def _release_retired(self) -> list[Any]:
        placement = self._placement
        self._retiring &= placement.loads.keys()
        gone = [agent for agent in self._retiring if agent in placement.idle]
        for agent in gone:
            placement.remove(agent)
        return gone

    def _overdue(self, now: float) -> list[Any]:
        idle = self._placement.idle
        return list(
            itertools.takewhile(lambda agent: idle[agent] + self._idle_timeout <= now, idle)
        )

    def _wake_at(self, spared: int) -> float:
        """When to look again: at the next idle agent, or when what lingers is given up."""
        oldest = next(itertools.islice(self._placement.idle.values(), spared, None), math.inf)
        due = oldest + self._idle_timeout
        return due if self._less_since is None else min(due, self._less_since + LINGER)
