"""Choice of the agent that runs the next child, and the number of agents that there should be.

Pure: ``now`` is an argument.  No step's cost grows with the number of agents or children."""

from __future__ import annotations

import itertools
import math
from collections import OrderedDict
from collections.abc import Hashable
from typing import Any, Generic, NamedTuple, TypeVar

Agent = TypeVar("Agent", bound=Hashable)
Child = TypeVar("Child", bound=Hashable)


LINGER = 10.0
"""Seconds for which agents that have not joined stay wanted once no child needs them: about as long
as a pod takes to join.  Soon a pool may replace a worker that died, or the program may start its
next pool.  An ``idle_timeout`` below it counts instead."""


class Placement(Generic[Agent, Child]):
    """Agents with ``slots`` places each, and the children that wait for one, in order.

    ``spread``: the agent with the fewest children gets the next one, and agents that are
    ``expected`` will get their share.  Otherwise the agent with room that has the most children
    gets it, so that others become idle and can be released.  Then an idle agent gets a child only
    if no other agent has room; among idle ones the last to become idle is chosen.
    """

    def __init__(self, slots: float, *, spread: bool) -> None:
        self.slots = slots
        self.expected = 0
        """Number of agents that are about to join."""
        # Not a dict: its iteration passes over every entry that was deleted at the front.
        self.waiting: OrderedDict[Child, None] = OrderedDict()
        self.children = 0
        """Number of children that run on agents."""
        self.loads: dict[Agent, int] = {}
        """Number of children of each agent."""
        self.idle: OrderedDict[Agent, float] = OrderedDict()
        """Agents without children, each with the time since when; the longest idle first."""
        self._spread = spread
        self._withheld: dict[Agent, set[str]] = {}
        """Agents that get no children, with their reasons: at least one each."""
        self._with_room: dict[int, OrderedDict[Agent, None]] = {}
        """Agents that have room for children, by the number of children that they have."""
        self._room = 0.0

    @property
    def room(self) -> float:
        """Number of further children that could be placed now."""
        return self._room if self._with_room else 0.0

    # Agents

    def add(self, agent: Agent, now: float) -> None:
        """Add an agent that has joined."""
        self.loads[agent] = 0
        self.idle[agent] = now
        self._list(agent)

    def remove(self, agent: Agent) -> None:
        """Remove an agent that is gone, with its children."""
        self._unlist(agent)
        self._withheld.pop(agent, None)
        self.children -= self.loads.pop(agent)
        self.idle.pop(agent, None)

    def withhold(self, agent: Agent, why: str) -> None:
        """Give the agent no children until ``restore`` was called for each reason."""
        self._unlist(agent)
        self._withheld.setdefault(agent, set()).add(why)

    def restore(self, agent: Agent, why: str) -> None:
        """End a reason of ``withhold``."""
        reasons = self._withheld.get(agent)
        if reasons is None:
            return
        reasons.discard(why)
        if not reasons:
            del self._withheld[agent]
            self._list(agent)

    # Children

    def wait(self, child: Child) -> None:
        """Add a child that waits for an agent."""
        self.waiting[child] = None

    def leave(self, child: Child) -> bool:
        """Remove a waiting child; return False if it does not wait."""
        return self.waiting.pop(child, self) is None

    def place(self) -> tuple[Child, Agent] | None:
        """Place the child that has waited longest; return it and its agent, or None."""
        if not self.waiting or not self._with_room:
            return None
        agent = self._best()
        if self.expected and self._spread and self.loads[agent] >= self._share():
            return None
        child = next(iter(self.waiting))
        del self.waiting[child]
        self.idle.pop(agent, None)
        self._change(agent, 1)
        return child, agent

    def ended(self, agent: Agent, now: float) -> None:
        """Note that one of the agent's children is gone."""
        self._change(agent, -1)
        if not self.loads[agent]:
            self.idle[agent] = now

    def _best(self) -> Agent:
        load = min(self._with_room) if self._spread else max(self._with_room)
        agents = self._with_room[load]
        return next(iter(agents)) if load or self._spread else next(reversed(agents))

    def _share(self) -> int:
        """Return how many children each agent gets once the expected agents have joined."""
        agents = len(self.loads) + self.expected
        return -(-(self.children + len(self.waiting)) // agents)

    def _change(self, agent: Agent, by: int) -> None:
        self._unlist(agent)
        self.loads[agent] += by
        self.children += by
        if agent not in self._withheld:
            self._list(agent)

    def _list(self, agent: Agent) -> None:
        load = self.loads[agent]
        if load < self.slots:
            self._with_room.setdefault(load, OrderedDict())[agent] = None
            self._room = math.inf if self.slots == math.inf else self._room + self.slots - load

    def _unlist(self, agent: Agent) -> None:
        load = self.loads[agent]
        agents = self._with_room.get(load)
        if agents is not None and agent in agents:
            del agents[agent]
            if not agents:
                del self._with_room[load]
            if self.slots != math.inf:
                self._room -= self.slots - load


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
    because the pool keeps so many by itself.  Once they have been idle for that time, the demand
    does not count them.  So a smaller demand takes away only idle agents, which ``release`` names,
    and agents that have not joined.
    """

    def __init__(
        self, placement: Placement[Any, Any], *, maximum: int, idle_timeout: float, floor: int = 0
    ) -> None:
        self.floor = floor
        self.maximum = maximum
        self._placement = placement
        self._idle_timeout = idle_timeout
        self._linger = min(LINGER, idle_timeout)
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
        since = self._less_since
        if needed >= kept or (since is not None and now >= since + self._linger):
            self._wanted, self._less_since = needed, None
        else:
            self._wanted = kept
            self._less_since = now if since is None else since
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
        """Return when to ask again: when the next idle agent is due, or the linger is over."""
        oldest = next(itertools.islice(self._placement.idle.values(), spared, None), math.inf)
        due = oldest + self._idle_timeout
        return due if self._less_since is None else min(due, self._less_since + self._linger)
