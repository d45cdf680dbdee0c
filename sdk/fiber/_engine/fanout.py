"""Plan by which a large blob reaches many agents: the agents that have it serve the others.

The master sends the first copies.  Each agent that has the blob serves ``WIDTH`` others at a time,
so the number of sources grows with each round, and the master's part does not grow with the number
of agents.  The plan is a tree whose shape depends on who is ready first.

An agent that dies or leaves is gone round: its receivers get another source.  A receiver that
``TRIES`` sources have failed gets the blob from the master.  If no agent reaches another one, the
master sends all copies.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Hashable, Iterable, Iterator
from typing import Generic, NamedTuple, TypeVar

WORTH = 1 << 20
"""Bytes from which on a blob goes from agent to agent.  A smaller one costs the master less than
the messages about its way."""

COPIES = 4
"""Copies that the master sends while agents can serve others."""

WIDTH = 2
"""Receivers that one source serves at a time."""

TRIES = 2
"""Agents that a receiver tries before the master serves it."""

UNREACHABLE = 3
"""Failures without any success after which agents count as unable to reach each other."""

_Agent = TypeVar("_Agent", bound=Hashable)


class Transfer(NamedTuple, Generic[_Agent]):
    """Order: ``receiver`` gets the blob from ``source``, or from the master if that is None.

    It replaces an earlier order for the receiver.
    """

    receiver: _Agent
    source: _Agent | None
    number: int
    """Number of the order, by which a report names it."""


class Spread(Generic[_Agent]):
    """Spread of one blob.  Each method returns the orders that follow from the event.

    ``reachable``: False if it is known that agents do not reach each other.  ``numbers``: the
    numbers of the orders.  ``retired``: the agents that will end; they serve no new receiver.
    """

    def __init__(
        self,
        *,
        reachable: bool = True,
        numbers: Iterator[int] | None = None,
        retired: Collection[_Agent] = frozenset(),
    ) -> None:
        self.reachable = reachable
        """False once agents count as unable to reach each other."""
        self._waiting: dict[_Agent, None] = {}
        """Receivers without a source, in their order."""
        self._under_way: dict[_Agent, Transfer[_Agent]] = {}
        self._serving: dict[_Agent | None, int] = {}
        """Sources, and the number of receivers that each serves; None is the master."""
        self._holders: dict[_Agent, None] = {}
        """Agents that have the blob and serve others."""
        self._failures: dict[_Agent, set[_Agent]] = {}
        """Sources that have failed, and the receivers that reported it."""
        self._retired = retired
        self._copies = 0
        self._numbers = numbers or itertools.count(1)
        self._in_vain = 0
        """Failures before the first success, and agents that cannot serve."""
        self._proven = False
        """True once an agent has got the blob from another one."""

    @property
    def idle(self) -> bool:
        """True if no agent waits for the blob or receives it."""
        return not self._waiting and not self._under_way

    def want(self, agent: _Agent) -> list[Transfer[_Agent]]:
        """Note that an agent needs the blob."""
        if agent not in self._under_way:
            self._waiting[agent] = None
        return self._assign()

    def is_under_way(self, agent: _Agent, number: int) -> bool:
        """Tell whether this is the order in force for ``agent``."""
        return self._in_force(agent, number) is not None

    def arrived(self, agent: _Agent, number: int, *, serves: bool) -> list[Transfer[_Agent]]:
        """Note that an order is carried out; ``serves``: the agent can serve others."""
        transfer = self._in_force(agent, number)
        if transfer is None:
            return []  # a later order has replaced it, or the agent has lost the blob
        self._end(agent)
        if transfer.source is not None:
            self._proven = True
        if not serves:
            self._count_in_vain()
        else:
            self._holders[agent] = None
        return self._assign()

    def failed(self, agent: _Agent, number: int) -> list[Transfer[_Agent]]:
        """Note that an order has failed, for the receiver's sake or the source's."""
        transfer = self._in_force(agent, number)
        if transfer is None:
            return []  # a later order has replaced it
        self._end(agent)
        if transfer.source is not None:
            reporters = self._failures.setdefault(transfer.source, set())
            reporters.add(agent)
            if len(reporters) >= TRIES:  # more than one receiver's fault
                self._holders.pop(transfer.source, None)
            self._count_in_vain()
        return [*self._put_first([agent]), *self._assign()]

    def gone(self, agent: _Agent) -> list[Transfer[_Agent]]:
        """Note that an agent is lost, or has lost the blob."""
        self._waiting.pop(agent, None)
        self._holders.pop(agent, None)
        self._end(agent)
        served = [one.receiver for one in self._under_way.values() if one.source == agent]
        for receiver in served:
            self._end(receiver)
        self._serving.pop(agent, None)
        self._failures.pop(agent, None)
        return [*self._put_first(served), *self._assign()]

    def _in_force(self, agent: _Agent, number: int) -> Transfer[_Agent] | None:
        transfer = self._under_way.get(agent)
        return transfer if transfer is not None and transfer.number == number else None

    def _end(self, receiver: _Agent) -> None:
        transfer = self._under_way.pop(receiver, None)
        if transfer is not None:
            self._serving[transfer.source] -= 1

    def _count_in_vain(self) -> None:
        self._in_vain += 1
        if self._in_vain >= UNREACHABLE and not self._proven:
            self.reachable = False

    def _put_first(self, receivers: Iterable[_Agent]) -> list[Transfer[_Agent]]:
        """Let receivers whose source failed go first; the master serves those that tried enough."""
        orders: list[Transfer[_Agent]] = []
        first: dict[_Agent, None] = {}
        for receiver in receivers:
            if self._tried(receiver) >= TRIES:
                orders.append(self._begin(receiver, None))
            else:
                first[receiver] = None
        self._waiting = {**first, **self._waiting}
        return orders

    def _tried(self, receiver: _Agent) -> int:
        return sum(receiver in reporters for reporters in self._failures.values())

    def _assign(self) -> list[Transfer[_Agent]]:
        """Give waiting receivers the sources that are free."""
        orders: list[Transfer[_Agent]] = []
        free = self._free_holders()
        for receiver in list(self._waiting):
            if not free and not self._master_is_free():
                break
            source = next((one for one in free if self._may_serve(one, receiver)), None)
            if source is None and not self._master_is_free():
                continue
            del self._waiting[receiver]
            orders.append(self._begin(receiver, source))
            if source is not None and self._serving[source] >= WIDTH:
                free.remove(source)
        return orders

    def _free_holders(self) -> list[_Agent]:
        if not self.reachable or not self._waiting:
            return []
        free = [
            one
            for one in self._holders
            if one not in self._retired and self._serving.get(one, 0) < WIDTH
        ]
        return sorted(free, key=lambda one: self._serving.get(one, 0))

    def _may_serve(self, source: _Agent, receiver: _Agent) -> bool:
        return source != receiver and receiver not in self._failures.get(source, ())

    def _master_is_free(self) -> bool:
        if not self.reachable:
            return True
        if self._serving.get(None, 0) >= WIDTH:
            return False
        return self._copies < COPIES or not self._under_way

    def _begin(self, receiver: _Agent, source: _Agent | None) -> Transfer[_Agent]:
        transfer = Transfer(receiver, source, next(self._numbers))
        self._under_way[receiver] = transfer
        self._serving[source] = self._serving.get(source, 0) + 1
        if source is None:
            self._copies += 1
        return transfer
