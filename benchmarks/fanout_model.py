"""Model of a network in which a plan of `fiber._engine.fanout` carries one blob to many agents.

Each host sends and receives at most so many bytes a second. The transfers from one host share its
line equally. An agent may die at a given moment, and the planner learns of it after `DETECTED`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from fiber._engine.fanout import Spread, Transfer

DETECTED = 1.0
"""Seconds from the death of an agent until the master knows it."""

SET_UP = 0.02
"""Seconds from an order to the first byte: two messages of the link and a handshake."""

Order = Transfer[int]


@dataclass
class Outcome:
    """Result of one run."""

    seconds: float
    copies: float
    """Blobs that the master sent, in fractions: also those that did not arrive."""
    arrived: set[int] = field(default_factory=set)


@dataclass
class _Flow:
    order: Order
    rest: float
    """Bytes to go."""
    starts: float


class Network:
    """Network of `agents` agents and a master, with lines of `rate` bytes a second.

    `deaths` maps agents to the moments at which they die. `passing_on`: agents serve each other.
    """

    def __init__(
        self,
        agents: int,
        size: int,
        rate: float,
        *,
        passing_on: bool = True,
        deaths: dict[int, float] | None = None,
    ) -> None:
        self._size, self._rate = size, rate
        self._spread: Spread[int] = Spread(reachable=passing_on)
        self._now = 0.0
        self._flows: dict[int, _Flow] = {}
        self._dead: set[int] = set()
        events = [(when, agent, False) for agent, when in (deaths or {}).items()]
        events += [(when + DETECTED, agent, True) for when, agent, _ in events]
        self._events = sorted(events)
        self._outcome = Outcome(0.0, 0.0)
        for agent in range(agents):
            self._obey(self._spread.want(agent))

    def run(self) -> Outcome:
        """Run until no agent waits, and return the result."""
        while not self._spread.idle:
            rates = self._rates()
            due = {one: self._due(flow, rates[one]) for one, flow in self._flows.items()}
            receiver = min(due, key=due.__getitem__, default=None)
            if self._events and (receiver is None or self._events[0][0] <= due[receiver]):
                self._pass_time(self._events[0][0], rates)
                _, agent, known = self._events.pop(0)
                self._die(agent, known=known)
            elif receiver is None:
                raise RuntimeError("agents wait, and nothing is under way")
            else:
                self._pass_time(due[receiver], rates)
                self._finish(receiver)
        self._outcome.seconds = self._now
        return self._outcome

    def _rates(self) -> dict[int, float]:
        """Return the bytes a second of each flow; 0 while it is set up or its source is dead."""
        users: dict[int | None, int] = {}
        for flow in self._flows.values():
            users[flow.order.source] = users.get(flow.order.source, 0) + 1
        rates = {}
        for receiver, flow in self._flows.items():
            source = flow.order.source
            rates[receiver] = 0.0 if source in self._dead else self._rate / users[source]
        return rates

    def _due(self, flow: _Flow, rate: float) -> float:
        return max(flow.starts, self._now) + flow.rest / rate if rate else float("inf")

    def _pass_time(self, until: float, rates: dict[int, float]) -> None:
        for receiver, flow in self._flows.items():
            moved = rates[receiver] * max(until - max(flow.starts, self._now), 0.0)
            flow.rest = max(flow.rest - moved, 0.0)
            if flow.order.source is None:
                self._outcome.copies += moved / self._size
        self._now = until

    def _finish(self, receiver: int) -> None:
        flow = self._flows.pop(receiver)
        self._outcome.arrived.add(receiver)
        self._obey(self._spread.arrived(receiver, flow.order.number, serves=True))

    def _die(self, agent: int, *, known: bool) -> None:
        if known:
            self._obey(self._spread.gone(agent))
        else:
            self._dead.add(agent)
            self._flows.pop(agent, None)
            self._outcome.arrived.discard(agent)

    def _obey(self, orders: list[Order]) -> None:
        for order in orders:
            if order.receiver not in self._dead:
                self._flows[order.receiver] = _Flow(order, self._size, self._now + SET_UP)
