"""Number of agents that there should be, and the idle agents to release.

Pure: ``now`` is an argument.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

from fiber._engine.placement import Placement

LINGER = 2.0
"""Seconds for which agents that have not joined stay wanted once no child needs them.  Soon a pool
may replace a worker that died, or the program may start its next pool."""


class Desired(NamedTuple):
    """Number of agents wanted from now on, and the agents to release."""

    agents: int
    release: list[Any]
    """Agents that were idle for long enough and get no children from now on."""
    wake_at: float
    """Time to ask again at the latest; infinity if there is no need."""


class Demand:
    """Demand for agents by the children of ``placement``, ``maximum`` at most.

    More agents are wanted as soon as children wait for which the present agents have no room.  An
    agent is released after ``idle_timeout`` idle seconds.  The last ``floor`` agents stay,
    since others want them.  When they are overdue, this demand does not count them.  So it gives up
    only idle agents, by name, and agents that have not joined.
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
        """Release an agent as soon as it is idle, since another is to replace it."""
        self._placement.withhold(agent, "retired")
        self._retiring.add(agent)

    def decide(self, now: float) -> Desired:
        """Return the demand at ``now``; agents to release count as gone."""
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
        """Return when to ask again: when the next idle agent is due, or LINGER is over."""
        oldest = next(itertools.islice(self._placement.idle.values(), spared, None), math.inf)
        due = oldest + self._idle_timeout
        return due if self._less_since is None else min(due, self._less_since + LINGER)
