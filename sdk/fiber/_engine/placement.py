"""Which agent runs the next child.

Pure: ``now`` is an argument.  No step's cost grows with the number of agents or children.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Hashable
from typing import Generic, TypeVar

Agent = TypeVar("Agent", bound=Hashable)
Child = TypeVar("Child", bound=Hashable)


class Placement(Generic[Agent, Child]):
    """Agents with ``slots`` places each, and the children that wait for one, in order.

    ``spread``: the agent with the fewest children takes the next one, and those that are
    ``expected`` are left their share.  Otherwise the one with the
    most that has room, so that others become idle and can go; an idle one is taken only if no other
    has room, and then the one that has been idle for the shortest time.
    """

    def __init__(self, slots: float, *, spread: bool) -> None:
        self.slots = slots
        self.expected = 0
        """How many agents are about to join."""
        # From the front an ordinary dict passes over all that was ever deleted there.
        self.waiting: OrderedDict[Child, None] = OrderedDict()
        self.children = 0
        """How many children run on agents."""
        self.loads: dict[Agent, int] = {}
        """How many each agent has."""
        self.idle: OrderedDict[Agent, float] = OrderedDict()
        """Agents without children and since when, the longest idle first."""
        self._spread = spread
        self._withheld: dict[Agent, set[str]] = {}
        """Those that are given none, and why: each for a reason or more."""
        self._with_room: dict[int, OrderedDict[Agent, None]] = {}
        """Those that can be given children, by how many they have."""
        self._room = 0.0

    @property
    def room(self) -> float:
        """How many more children could be placed now."""
        return self._room if self._with_room else 0.0

    # Agents

    def add(self, agent: Agent, now: float) -> None:
        """It has joined."""
        self.loads[agent] = 0
        self.idle[agent] = now
        self._list(agent)

    def remove(self, agent: Agent) -> None:
        """It is gone, and its children with it."""
        self._unlist(agent)
        self._withheld.pop(agent, None)
        self.children -= self.loads.pop(agent)
        self.idle.pop(agent, None)

    def withhold(self, agent: Agent, why: str) -> None:
        """Give it no children for as long as there is this reason, or another one."""
        self._unlist(agent)
        self._withheld.setdefault(agent, set()).add(why)

    def restore(self, agent: Agent, why: str) -> None:
        """This is no reason any more."""
        reasons = self._withheld.get(agent)
        if reasons is None:
            return
        reasons.discard(why)
        if not reasons:
            del self._withheld[agent]
            self._list(agent)

    # Children

    def wait(self, child: Child) -> None:
        """It waits for a place."""
        self.waiting[child] = None

    def leave(self, child: Child) -> bool:
        """It waits no longer; False if it did not."""
        return self.waiting.pop(child, self) is None

    def place(self) -> tuple[Child, Agent] | None:
        """The child that has waited longest, and its agent from now on; None if none has room."""
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
        """One of its children is gone."""
        self._change(agent, -1)
        if not self.loads[agent]:
            self.idle[agent] = now

    def _best(self) -> Agent:
        load = min(self._with_room) if self._spread else max(self._with_room)
        agents = self._with_room[load]
        return next(iter(agents)) if load or self._spread else next(reversed(agents))

    def _share(self) -> int:
        """How many children each agent has once the expected ones are there."""
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
