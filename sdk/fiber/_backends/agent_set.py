"""Agents of one shape and the children that wait for them, for loopback agents and for pods."""

from __future__ import annotations

import weakref
from collections.abc import Callable

from fiber import _logs
from fiber._agent.interface import Cause, ChildObserver, ChildSpec, ExitReport
from fiber._backends.blobs import Fanout
from fiber._backends.remote import RemoteAgent, RemoteChild
from fiber._engine.placement import Placement
from fiber._hub.hub import Hub
from fiber._logs import OutputWriter
from fiber._transport.link import Link
from fiber._transport.loop import EventLoop


class AgentSet:
    """Set of agents that gives each child an agent: at once, or as soon as one has room.

    ``on_change`` is called when the number of wanted agents may have changed.  ``on_lost`` gets a
    lost agent and the reason, before its children end.  ``on_leaving`` gets an agent that takes no
    new work.  ``fanout`` lets agents serve blobs to each other.  Any thread may call ``child``.
    All else runs on the loop thread.
    """

    def __init__(
        self,
        loop: EventLoop,
        hub: Hub,
        output: OutputWriter,
        placement: Placement[RemoteAgent, RemoteChild],
        *,
        fanout: Fanout | None = None,
        on_change: Callable[[], None] = lambda: None,
        on_lost: Callable[[RemoteAgent, str], None] = lambda agent, reason: None,
        on_leaving: Callable[[RemoteAgent], None] = lambda agent: None,
    ) -> None:
        self.loop = loop
        self.placement = placement
        """Placement of children on agents.  Other objects only read it, except Demand."""
        self.agents: dict[str, RemoteAgent] = {}
        """Agents that have joined and are not lost, by name."""
        self.joined = 0
        """Number of agents that ever joined."""
        self.error: Exception | None = None
        """Reason why no agent will come."""
        self._successor: Callable[[], AgentSet] | None = None
        self._hub = hub
        self._output = output
        self._fanout = fanout
        self._on_change = on_change
        self._on_lost = on_lost
        self._on_leaving = on_leaving
        self._not_started: weakref.WeakSet[RemoteChild] = weakref.WeakSet()

    @property
    def children(self) -> int:
        """Number of children, including those that wait or are not started yet."""
        placement = self.placement
        return placement.children + len(placement.waiting) + len(self._not_started)

    def child(self, spec: ChildSpec, observer: ChildObserver) -> RemoteChild:
        """Return a child, not started yet."""
        child = RemoteChild(self, spec, observer)
        self._not_started.add(child)
        return child

    def start(self, child: RemoteChild) -> None:
        """Give a child an agent, now or as soon as one has room."""
        self._not_started.discard(child)
        if self._successor is not None:
            child.move(self._successor())
            return
        if self.error is not None and not self.placement.loads:
            _refuse(child, self.error)
            return
        self.placement.wait(child)
        self._place()

    def withdraw(self, child: RemoteChild) -> bool:
        """Withdraw a child; return False if it has an agent already."""
        waited = self.placement.leave(child)
        if waited:
            self._on_change()
        return waited

    def join(self, host: str, link: Link) -> RemoteAgent:
        """Add an agent that has dialed in."""
        agent = RemoteAgent(host, link, self.loop, self._hub, self._output, self, self._fanout)
        _logs.debug("agent %s has joined", host)
        self.agents[host] = agent
        self.joined += 1
        self.error = None
        self.placement.add(agent, self.loop.now())
        link.attach(agent)
        self._place()
        return agent

    def set_slots(self, slots: int) -> None:
        """Set the number of children that each agent runs, before the first agent joins."""
        self.placement.slots = slots

    def expect(self, agents: int) -> None:
        """Expect so many agents to join soon."""
        if agents != self.placement.expected:
            self.placement.expected = agents
            self._place()

    def fail(self, error: Exception) -> None:
        """Note that no agent will come.  If there is none, refuse the waiting children."""
        self.error = error
        if not self.placement.loads:
            self.refuse_waiting(error)

    def hand_over(self, successor: Callable[[], AgentSet]) -> None:
        """Give waiting and later children to ``successor``, since no agent comes here."""
        self._successor = successor
        for child in self._take_waiting():
            self.start(child)
        self._on_change()

    def refuse_waiting(self, error: Exception) -> None:
        """Refuse all waiting children with ``error``."""
        for child in self._take_waiting():
            _refuse(child, error)
        self._on_change()

    def _take_waiting(self) -> list[RemoteChild]:
        waiting = list(self.placement.waiting)
        self.placement.waiting.clear()
        return waiting

    def _place(self) -> None:
        while (placed := self.placement.place()) is not None:
            child, agent = placed
            agent.start(child)
        self._on_change()

    # Ends of agents

    def lost(self, agent: RemoteAgent, reason: str) -> None:
        """Note that an agent is lost."""
        _logs.debug("agent %s is lost: %s", agent.host, reason)
        del self.agents[agent.host]
        if agent in self.placement.loads:
            self.placement.remove(agent)
        self._on_lost(agent, reason)
        if self.error is not None and not self.placement.loads:
            self.refuse_waiting(self.error)  # they waited for room on the lost agent
        else:
            self._on_change()

    def leaving(self, agent: RemoteAgent) -> None:
        """Place no more children on an agent that is about to leave."""
        _logs.debug("agent %s leaves: %s", agent.host, agent.leaving)
        if agent in self.placement.loads:
            self.placement.remove(agent)
        self._on_leaving(agent)
        self._on_change()

    def child_gone(self, agent: RemoteAgent) -> None:
        """Note that a child of an agent has ended, so there is room for another."""
        if agent in self.placement.loads:
            self.placement.ended(agent, self.loop.now())
            self._place()

    def suspected(self, agent: RemoteAgent, suspect: bool) -> None:
        """Give an agent no children while it is silent."""
        _logs.debug("agent %s is %s", agent.host, "silent" if suspect else "back")
        self.withhold(agent, suspect, "silent")

    def withhold(self, agent: RemoteAgent, withheld: bool, why: str) -> None:
        """Withhold children from an agent for this reason, or give it children again."""
        if agent not in self.placement.loads:
            return
        if withheld:
            self.placement.withhold(agent, why)
        else:
            self.placement.restore(agent, why)
        self._place()


def _refuse(child: RemoteChild, error: Exception) -> None:
    child.start_error = error
    child.end(ExitReport(1, f"could not be started: {error}", cause=Cause.NO_HOST))
